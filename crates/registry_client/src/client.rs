//! One connection to a policy server, and the questions that can be asked over it.

use std::net::IpAddr;
use std::path::Path;
use std::time::Duration;

use caudata_proto::registry::question::Facts;
use caudata_proto::registry::{
    AuditPage, LabelName, LabelState, ListPage, MAX_PUBLISH_CHUNK_BYTES, Manifest, ManifestRequest,
    NONCE_BYTES, Overview, Published, QuarantineState, RobotReport, SetLabel, SignedFreshness,
    StreamName,
};
use caudata_proto::wire::registry as wire;
use caudata_proto::wire::registry::policy_registry_client::PolicyRegistryClient;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};

use crate::call::{all_of, answer, within};
use crate::error::ClientError;
use crate::limits::{CALL_TIMEOUT, CONNECT_TIMEOUT, Patience};
use crate::watch::Watch;

fn certificates(folder: &Path) -> Result<ClientTlsConfig, ClientError> {
    let read = |name: &str| {
        let path = folder.join(name);
        std::fs::read(&path).map_err(|error| ClientError::Certificates {
            reason: format!("{}: {error}", path.display()),
        })
    };
    // The names are those of `caudata pki` and of Kubernetes' secrets.
    Ok(ClientTlsConfig::new()
        .ca_certificate(Certificate::from_pem(read("ca.crt")?))
        .identity(Identity::from_pem(read("tls.crt")?, read("tls.key")?)))
}

/// Whether an address, with or without a scheme, is one of this host, whatever a name server says.
pub fn is_loopback(address: &str) -> bool {
    let host = address.split_once("://").map_or(address, |(_, host)| host);
    let host = host.rsplit_once(':').map_or(host, |(host, _)| host);
    let ip = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || ip.parse().is_ok_and(|ip: IpAddr| ip.is_loopback())
}

/// A connection to one policy server; cloning shares it. Reconnects by itself.
#[derive(Clone, Debug)]
pub struct RegistryClient {
    pub(crate) address: String,
    /// How long it bears with the server.
    pub patience: Patience,
    pub(crate) inner: PolicyRegistryClient<Channel>,
}

impl RegistryClient {
    /// A client for `address` (`host:port`) on this host, without encryption. Connects with the first call,
    /// so a server that starts later is fine.
    ///
    /// # Errors
    /// [`ClientError::Address`].
    pub fn new(address: &str) -> Result<Self, ClientError> {
        Self::with_tls(address, None)
    }

    /// A client for `address`: `https://host:port` is encrypted and both sides show certificates, ours from
    /// `tls_dir`, a folder with `ca.crt`, `tls.crt` and `tls.key` (`caudata pki`); `host:port` is plain, and on
    /// this host only.
    ///
    /// # Errors
    /// [`ClientError::Address`], also for `https://` without certificates; [`ClientError::Plain`];
    /// [`ClientError::Certificates`].
    pub fn with_tls(address: &str, tls_dir: Option<&Path>) -> Result<Self, ClientError> {
        if !address.starts_with("https://") && !is_loopback(address) {
            return Err(ClientError::Plain { address: address.to_owned() });
        }
        Self::to_any_host(address, tls_dir)
    }

    /// As [`RegistryClient::with_tls`], and plain beyond this host as well: for who has asked whether that may be.
    ///
    /// # Errors
    /// As there, but for [`ClientError::Plain`].
    pub fn to_any_host(address: &str, tls_dir: Option<&Path>) -> Result<Self, ClientError> {
        let bad = || ClientError::Address { address: address.to_owned() };
        let (encrypted, host) = match address.strip_prefix("https://") {
            Some(host) => (true, host),
            None => (false, address.strip_prefix("http://").unwrap_or(address)),
        };
        let port = host.rsplit_once(':').map(|(_, port)| port.parse::<u16>());
        if !matches!(port, Some(Ok(_))) {
            return Err(bad());
        }
        let scheme = if encrypted { "https" } else { "http" };
        let mut endpoint = Endpoint::from_shared(format!("{scheme}://{host}"))
            .map_err(|_| bad())?
            .connect_timeout(CONNECT_TIMEOUT)
            .http2_keep_alive_interval(Duration::from_secs(20))
            .keep_alive_timeout(Duration::from_secs(10));
        if encrypted {
            let folder = tls_dir.ok_or_else(|| ClientError::Certificates {
                reason: format!(
                    "{address} is encrypted: give a folder of certificates (--tls-dir)"
                ),
            })?;
            endpoint = endpoint.tls_config(certificates(folder)?).map_err(|error| {
                ClientError::Certificates { reason: format!("{}: {error}", folder.display()) }
            })?;
        }
        Ok(Self {
            address: host.to_owned(),
            patience: Patience::default(),
            inner: PolicyRegistryClient::new(endpoint.connect_lazy()),
        })
    }

    /// Where the server is expected.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Publishes one file. Safe to repeat: the same version with the same bytes is stored once.
    pub async fn publish(
        &mut self,
        manifest: Manifest,
        bytes: &[u8],
    ) -> Result<Published, ClientError> {
        let sent = manifest.clone();
        let header = wire::PublishRequest {
            part: Some(wire::publish_request::Part::Header(manifest.into())),
        };
        let pieces = bytes.chunks(MAX_PUBLISH_CHUNK_BYTES).map(|piece| wire::PublishRequest {
            part: Some(wire::publish_request::Part::Data(piece.to_vec())),
        });
        let messages: Vec<_> = std::iter::once(header).chain(pieces).collect();
        let call = self.inner.publish(tokio_stream::iter(messages));
        let published: Published = answer("publish", &self.address, call).await?;
        Facts::from(&sent).answered_by(&published.manifest)?;
        Ok(published)
    }

    /// Manifests of `stream` (`None`: of all), newest first, at most `limit` (0: the server's limit).
    pub async fn list(
        &mut self,
        stream: Option<&StreamName>,
        limit: u32,
        below_version: Option<u64>,
    ) -> Result<ListPage, ClientError> {
        let call =
            self.inner.list(wire::ListRequest { stream: name(stream), limit, below_version });
        let page: ListPage = answer("list", &self.address, call).await?;
        all_of(stream, &page.manifests)?;
        Ok(page)
    }

    /// One manifest; `None`: the newest.
    ///
    /// # Errors
    /// See [`ClientError`]; [`ClientError::is_not_found`] where there is none.
    pub async fn manifest(
        &mut self,
        stream: &StreamName,
        version: Option<u64>,
    ) -> Result<Manifest, ClientError> {
        self.get_manifest(stream, version, None).await
    }

    /// The manifest that `label` leads to.
    ///
    /// # Errors
    /// See [`ClientError`]; [`ClientError::is_not_found`] where it leads nowhere.
    pub async fn labelled(
        &mut self,
        stream: &StreamName,
        label: &LabelName,
    ) -> Result<Manifest, ClientError> {
        self.get_manifest(stream, None, Some(label)).await
    }

    async fn get_manifest(
        &mut self,
        stream: &StreamName,
        version: Option<u64>,
        label: Option<&LabelName>,
    ) -> Result<Manifest, ClientError> {
        let request = ManifestRequest { stream: stream.clone(), version, label: label.cloned() };
        let call = self.inner.get_manifest(wire::GetManifestRequest::from(request));
        let manifest: Manifest = answer("get manifest", &self.address, call).await?;
        // A manifest does not say which labels lead to it; `freshness` does.
        let asked = Facts { version, ..Facts::of_stream(stream) };
        asked.answered_by(&manifest)?;
        Ok(manifest)
    }

    /// Moves a label, if it is still as the caller saw it.
    ///
    /// # Errors
    /// See [`ClientError`]; [`tonic::Code::Aborted`] where somebody else was faster.
    pub async fn set_label(&mut self, wanted: SetLabel) -> Result<LabelState, ClientError> {
        let call = self.inner.set_label(wire::SetLabelRequest::from(wanted.clone()));
        let state: LabelState = answer("set label", &self.address, call).await?;
        let asked = Facts {
            version: Some(wanted.version),
            label: Some(&wanted.label),
            ..Facts::of_stream(&wanted.stream)
        };
        asked.answered_by(&state)?;
        Ok(state)
    }

    /// Publishes the bytes of an older version again, as `manifest` says
    /// ([`caudata_proto::registry::reverting`]).
    pub async fn revert(
        &mut self,
        manifest: Manifest,
        reason: &str,
    ) -> Result<Published, ClientError> {
        let call = self.inner.revert(wire::RevertRequest {
            manifest: Some(manifest.clone().into()),
            reason: reason.to_owned(),
        });
        let published: Published = answer("revert", &self.address, call).await?;
        Facts::from(&manifest).answered_by(&published.manifest)?;
        Ok(published)
    }

    /// Takes a version out of use.
    pub async fn quarantine(
        &mut self,
        stream: &StreamName,
        version: u64,
        reason: &str,
    ) -> Result<QuarantineState, ClientError> {
        let call = self.inner.quarantine(wire::QuarantineRequest {
            stream: stream.to_string(),
            version,
            reason: reason.to_owned(),
        });
        let state: QuarantineState = answer("quarantine", &self.address, call).await?;
        let asked = Facts { version: Some(version), ..Facts::of_stream(stream) };
        asked.answered_by(&state)?;
        Ok(state)
    }

    /// Tells what became of a version on a robot.
    pub async fn report(&mut self, report: RobotReport) -> Result<(), ClientError> {
        let went_well = report.state.went_well();
        let report = wire::RobotReport::from(report);
        let call = async {
            if went_well { self.inner.ack(report).await } else { self.inner.nack(report).await }
        };
        within("report", CALL_TIMEOUT, &self.address, call).await?;
        Ok(())
    }

    /// Asks where a label leads, bound to `nonce`. The answer is one to this question; the caller checks who
    /// signed it.
    pub async fn freshness(
        &mut self,
        nonce: [u8; NONCE_BYTES],
        stream: &StreamName,
        label: &LabelName,
    ) -> Result<SignedFreshness, ClientError> {
        let call = self.inner.freshness(wire::FreshnessRequest {
            nonce: nonce.to_vec(),
            stream: stream.to_string(),
            label: label.to_string(),
        });
        let signed: SignedFreshness = answer("freshness", &self.address, call).await?;
        let asked = Facts { label: Some(label), nonce: Some(&nonce), ..Facts::of_stream(stream) };
        asked.answered_by(&signed.said)?;
        Ok(signed)
    }

    /// Labels, quarantine and reports of `stream` (`None`: of all).
    pub async fn overview(&mut self, stream: Option<&StreamName>) -> Result<Overview, ClientError> {
        let call = self.inner.overview(wire::OverviewRequest { stream: name(stream) });
        let overview: Overview = answer("overview", &self.address, call).await?;
        all_of(stream, &overview.labels)?;
        all_of(stream, &overview.quarantined)?;
        all_of(stream, overview.reports.iter().map(|r| Facts::of_stream(&r.stream)))?;
        Ok(overview)
    }

    /// Who changed what, newest first; entries before number `before` (0: from the newest on).
    pub async fn audit(&mut self, limit: u32, before: u64) -> Result<AuditPage, ClientError> {
        let call = self.inner.audit(wire::AuditRequest { limit, before });
        answer("audit", &self.address, call).await
    }

    /// Follows changes of `stream` from a generation on (0: a snapshot first).
    pub async fn watch(
        &mut self,
        stream: Option<&StreamName>,
        since_generation: u64,
    ) -> Result<Watch, ClientError> {
        let call = self.inner.watch(wire::WatchRequest { stream: name(stream), since_generation });
        let answer = within("watch", CALL_TIMEOUT, &self.address, call).await?;
        Ok(Watch {
            address: self.address.clone(),
            stream: stream.cloned(),
            events: answer.into_inner(),
        })
    }
}

/// An empty name asks for all streams.
fn name(stream: Option<&StreamName>) -> String {
    stream.map(ToString::to_string).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_need_a_port() {
        assert!(RegistryClient::new("127.0.0.1").is_err());
        assert!(RegistryClient::new("robot:x").is_err());
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _context = runtime.enter();
        for (address, here) in [
            ("192.0.2.1:7401", false),
            ("http://policies.lab:7401", false),
            ("0.0.0.0:7401", false),
            ("127.0.0.1.evil.org:7401", false),
            ("localhost:7401", true),
            ("http://[::1]:7401", true),
        ] {
            assert_eq!(RegistryClient::new(address).is_ok(), here, "{address}");
        }
        let client = RegistryClient::new("http://127.0.0.1:7401").unwrap();
        assert_eq!(client.address(), "127.0.0.1:7401");
    }

    #[test]
    fn nobody_there_is_told_in_one_line() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            // Port 1 is reserved and closed on any machine that runs tests.
            let mut client = RegistryClient::new("127.0.0.1:1").unwrap();
            let error = client.list(None, 0, None).await.unwrap_err();
            assert!(matches!(error, ClientError::Unreachable { .. }), "{error:?}");
            assert!(error.is_transient());
            assert!(error.to_string().contains("127.0.0.1:1"), "{error}");
        });
    }
}
