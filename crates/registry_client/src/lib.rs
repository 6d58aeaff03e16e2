//! Typed client of the policy server: publish, list, fetch with resume, watch.
//!
//! Every answer is checked (`caudata-proto`) before a caller sees it, every call has a deadline, and a fetch that is cut
//! goes on where it stopped. The bytes that [`RegistryClient::fetch`] returns hash to what was asked for.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

mod steps;

use std::path::Path;
use std::time::{Duration, Instant};

use caudata_policy::PolicyFile;
use caudata_proto::registry::{
    AuditPage, LabelName, LabelState, ListPage, MAX_PUBLISH_CHUNK_BYTES, Manifest, ManifestRequest,
    NONCE_BYTES, Overview, Published, QuarantineState, RegistryError, RobotReport, SetLabel,
    SignedFreshness, StreamName, WatchEvent,
};
use caudata_proto::wire::registry as wire;
use caudata_proto::wire::registry::policy_registry_client::PolicyRegistryClient;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Code, Status};

/// Time to reach the server.
pub const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Time for one call that is not a stream.
pub const CALL_TIMEOUT: Duration = Duration::from_secs(30);
/// Longest silence within a fetch.
pub const FETCH_IDLE_MAX: Duration = Duration::from_secs(15);
/// How often a cut fetch is taken up again.
pub const FETCH_RETRIES: u32 = 5;
/// First pause before a retry; doubles each time.
pub const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// Longest pause before a retry.
pub const RETRY_PAUSE_MAX: Duration = Duration::from_secs(5);
/// Least bytes per second of a fetch, over [`RATE_WINDOW`]: a server that drips holds nobody for ever.
pub const RATE_MIN: u64 = 4 << 10;
/// Over how long the rate is judged.
pub const RATE_WINDOW: Duration = Duration::from_secs(30);
/// Longest time for one file, whatever the rate.
pub const FETCH_MAX: Duration = Duration::from_secs(600);
/// A watch that is silent for this long is dead: the server sends progress every 10 s.
pub const WATCH_IDLE_MAX: Duration = Duration::from_secs(35);

/// How long a fetch bears with a server, and how fast that one must be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patience {
    /// See [`FETCH_IDLE_MAX`].
    pub idle_max: Duration,
    /// See [`FETCH_MAX`].
    pub whole_max: Duration,
    /// See [`RATE_WINDOW`].
    pub rate_window: Duration,
    /// See [`RETRY_PAUSE`].
    pub retry_pause: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self {
            idle_max: FETCH_IDLE_MAX,
            whole_max: FETCH_MAX,
            rate_window: RATE_WINDOW,
            retry_pause: RETRY_PAUSE,
        }
    }
}

/// What a call to the policy server can end with.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The address is not one.
    #[error("`{address}` is not an address like 127.0.0.1:7401")]
    Address {
        /// What was given.
        address: String,
    },
    /// The certificates are not there, or do not work.
    #[error("certificates: {reason}")]
    Certificates {
        /// What is wrong.
        reason: String,
    },
    /// Nobody answers.
    #[error("policy server {address} does not answer: {reason}; is it running?")]
    Unreachable {
        /// Where it was expected.
        address: String,
        /// What the network said.
        reason: String,
    },
    /// The server answered with a refusal.
    #[error("policy server refuses ({code:?}): {message}")]
    Refused {
        /// gRPC status code.
        code: Code,
        /// The server's words.
        message: String,
    },
    /// An answer that does not pass the checks.
    #[error("policy server sent a bad answer: {0}")]
    BadAnswer(#[from] RegistryError),
    /// A fetch that broke the rules: too many bytes, or bytes of another file.
    #[error("fetched bytes are not those asked for: {reason}")]
    WrongBytes {
        /// What is wrong.
        reason: String,
    },
    /// Bytes come, but too few.
    #[error("policy server sends less than {RATE_MIN} bytes per second; is the network that slow?")]
    TooSlow,
    /// The call took too long.
    #[error("policy server did not finish {what} in time; try again")]
    TimedOut {
        /// Which call.
        what: &'static str,
    },
}

impl ClientError {
    /// True where the same call may succeed later.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Unreachable { .. } | Self::TimedOut { .. } => true,
            Self::Refused { code, .. } => matches!(
                code,
                Code::Unavailable
                    | Code::DeadlineExceeded
                    | Code::Aborted
                    | Code::Cancelled
                    | Code::Unknown
            ),
            _ => false,
        }
    }

    /// True where somebody else changed the same thing first: look again and decide anew.
    #[must_use]
    pub fn is_lost_race(&self) -> bool {
        matches!(
            self,
            Self::Refused {
                code: Code::Aborted,
                ..
            }
        )
    }

    /// True where the server does not hold what was asked for.
    #[must_use]
    pub fn is_not_found(&self) -> bool {
        matches!(
            self,
            Self::Refused {
                code: Code::NotFound,
                ..
            }
        )
    }
}

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

/// A connection to one policy server; cloning shares it. Reconnects by itself.
#[derive(Clone, Debug)]
pub struct RegistryClient {
    address: String,
    patience: Patience,
    inner: PolicyRegistryClient<Channel>,
}

impl RegistryClient {
    /// A client for `address` (`host:port`) on this host, without encryption. Connects with the first call, so a server that
    /// starts later is fine.
    ///
    /// # Errors
    /// [`ClientError::Address`].
    pub fn new(address: &str) -> Result<Self, ClientError> {
        Self::with_tls(address, None)
    }

    /// A client for `address`: `https://host:port` is encrypted and both sides show certificates, ours from `tls_dir`, a folder with
    /// `ca.crt`, `tls.crt` and `tls.key` (`caudata pki`); `host:port` is plain, which servers accept on their own host only.
    ///
    /// # Errors
    /// [`ClientError::Address`], also for `https://` without certificates; [`ClientError::Certificates`].
    pub fn with_tls(address: &str, tls_dir: Option<&Path>) -> Result<Self, ClientError> {
        let bad = || ClientError::Address {
            address: address.to_owned(),
        };
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
                reason: format!("{address} is encrypted and no folder of certificates is given"),
            })?;
            endpoint = endpoint
                .tls_config(certificates(folder)?)
                .map_err(|error| ClientError::Certificates {
                    reason: format!("{}: {error}", folder.display()),
                })?;
        }
        Ok(Self {
            address: host.to_owned(),
            patience: Patience::default(),
            inner: PolicyRegistryClient::new(endpoint.connect_lazy()),
        })
    }

    /// Bears with the server for longer or shorter.
    #[must_use]
    pub fn with_patience(mut self, patience: Patience) -> Self {
        self.patience = patience;
        self
    }

    /// Where the server is expected.
    #[must_use]
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Publishes one file. Safe to repeat: the same version with the same bytes is stored once.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn publish(
        &mut self,
        manifest: Manifest,
        bytes: &[u8],
    ) -> Result<Published, ClientError> {
        let header = wire::PublishRequest {
            part: Some(wire::publish_request::Part::Header(manifest.into())),
        };
        let pieces = bytes
            .chunks(MAX_PUBLISH_CHUNK_BYTES)
            .map(|piece| wire::PublishRequest {
                part: Some(wire::publish_request::Part::Data(piece.to_vec())),
            });
        let messages: Vec<_> = std::iter::once(header).chain(pieces).collect();
        let call = self.inner.publish(tokio_stream::iter(messages));
        let answer = within("publish", CALL_TIMEOUT, &self.address, call).await?;
        Ok(answer.into_inner().try_into()?)
    }

    /// Manifests of `stream` (`None`: of all), newest first, at most `limit` (0: the server's limit).
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn list(
        &mut self,
        stream: Option<&StreamName>,
        limit: u32,
        below_version: Option<u64>,
    ) -> Result<ListPage, ClientError> {
        let request = wire::ListRequest {
            stream: stream.map(ToString::to_string).unwrap_or_default(),
            limit,
            below_version,
        };
        let call = self.inner.list(request);
        let answer = within("list", CALL_TIMEOUT, &self.address, call).await?;
        Ok(answer.into_inner().try_into()?)
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
        let request = ManifestRequest {
            stream: stream.clone(),
            version,
            label: None,
        };
        self.get_manifest(request).await
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
        let request = ManifestRequest {
            stream: stream.clone(),
            version: None,
            label: Some(label.clone()),
        };
        self.get_manifest(request).await
    }

    async fn get_manifest(&mut self, request: ManifestRequest) -> Result<Manifest, ClientError> {
        let request = wire::GetManifestRequest::from(request);
        let call = self.inner.get_manifest(request);
        let answer = within("get manifest", CALL_TIMEOUT, &self.address, call).await?;
        let manifest = answer
            .into_inner()
            .manifest
            .ok_or(RegistryError::Missing { field: "manifest" })?;
        Ok(manifest.try_into()?)
    }

    /// The bytes that `manifest` names: exactly its size, hashing to its SHA-256. A cut transfer goes on by offset.
    ///
    /// # Errors
    /// See [`ClientError`]; the last one after [`FETCH_RETRIES`] retries.
    pub async fn fetch(&mut self, manifest: &Manifest) -> Result<Vec<u8>, ClientError> {
        let mut bytes = Vec::with_capacity(usize::try_from(manifest.size).unwrap_or(0));
        let limit = self.patience.whole_max;
        let whole = self.fetch_with_retries(manifest, &mut bytes);
        tokio::time::timeout(limit, whole)
            .await
            .map_err(|_| ClientError::TimedOut { what: "fetch" })??;
        steps::check_whole(manifest, &bytes)?;
        Ok(bytes)
    }

    async fn fetch_with_retries(
        &mut self,
        manifest: &Manifest,
        bytes: &mut Vec<u8>,
    ) -> Result<(), ClientError> {
        let mut pause = self.patience.retry_pause;
        let mut attempt = 0;
        loop {
            let before = bytes.len();
            match self.fetch_rest(manifest, bytes).await {
                Ok(()) => return Ok(()),
                Err(error) if error.is_transient() && attempt < FETCH_RETRIES => {
                    tracing::warn!(%error, got = bytes.len(), size = manifest.size, "fetch cut, going on");
                    // A connection that brings something each time is a bad one, not a dead one.
                    attempt = if bytes.len() > before { 0 } else { attempt + 1 };
                    tokio::time::sleep(jittered(pause)).await;
                    pause = (pause * 2).min(RETRY_PAUSE_MAX);
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Appends what is missing to `bytes`; on an error `bytes` holds what came so far.
    async fn fetch_rest(
        &mut self,
        manifest: &Manifest,
        bytes: &mut Vec<u8>,
    ) -> Result<(), ClientError> {
        let offset = bytes.len() as u64;
        if offset == manifest.size {
            return Ok(());
        }
        let request = wire::FetchRequest {
            sha256: manifest.sha256.to_vec(),
            offset,
            if_none_match: Vec::new(),
        };
        let call = self.inner.fetch(request);
        let mut answer = within("fetch", CALL_TIMEOUT, &self.address, call)
            .await?
            .into_inner();
        let mut rate = Rate::new(self.patience.rate_window, Instant::now());
        while let Some(message) = within(
            "fetch",
            self.patience.idle_max,
            &self.address,
            answer.message(),
        )
        .await?
        {
            let piece = steps::piece(manifest, offset, bytes.len(), message.try_into()?)?;
            bytes.extend_from_slice(&piece);
            if !piece.is_empty() {
                rate.add(piece.len() as u64, Instant::now())?;
            }
        }
        if (bytes.len() as u64) < manifest.size {
            return Err(ClientError::TimedOut { what: "fetch" });
        }
        Ok(())
    }

    /// Moves a label, if it is still as the caller saw it.
    ///
    /// # Errors
    /// See [`ClientError`]; [`Code::Aborted`] where somebody else was faster.
    pub async fn set_label(&mut self, wanted: SetLabel) -> Result<LabelState, ClientError> {
        let call = self.inner.set_label(wire::SetLabelRequest::from(wanted));
        let answer = within("set label", CALL_TIMEOUT, &self.address, call).await?;
        Ok(answer.into_inner().try_into()?)
    }

    /// Publishes the bytes of an older version again, as `manifest` says ([`caudata_proto::registry::reverting`]).
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn revert(
        &mut self,
        manifest: Manifest,
        reason: &str,
    ) -> Result<Published, ClientError> {
        let call = self.inner.revert(wire::RevertRequest {
            manifest: Some(manifest.into()),
            reason: reason.to_owned(),
        });
        let answer = within("revert", CALL_TIMEOUT, &self.address, call).await?;
        Ok(answer.into_inner().try_into()?)
    }

    /// Takes a version out of use.
    ///
    /// # Errors
    /// See [`ClientError`].
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
        let answer = within("quarantine", CALL_TIMEOUT, &self.address, call).await?;
        Ok(answer.into_inner().try_into()?)
    }

    /// Tells what became of a version on a robot.
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn report(&mut self, report: RobotReport) -> Result<(), ClientError> {
        let went_well = report.state.went_well();
        let report = wire::RobotReport::from(report);
        let call = async {
            match went_well {
                true => self.inner.ack(report).await,
                false => self.inner.nack(report).await,
            }
        };
        within("report", CALL_TIMEOUT, &self.address, call).await?;
        Ok(())
    }

    /// Asks where a label leads, bound to `asked.nonce`. The caller checks the signature; `asked` holds only the question.
    ///
    /// # Errors
    /// See [`ClientError`].
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
        let answer = within("freshness", CALL_TIMEOUT, &self.address, call).await?;
        Ok(answer.into_inner().try_into()?)
    }

    /// Labels, quarantine and reports of `stream` (`None`: of all).
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn overview(&mut self, stream: Option<&StreamName>) -> Result<Overview, ClientError> {
        let call = self.inner.overview(wire::OverviewRequest {
            stream: stream.map(ToString::to_string).unwrap_or_default(),
        });
        let answer = within("overview", CALL_TIMEOUT, &self.address, call).await?;
        Ok(answer.into_inner().try_into()?)
    }

    /// Who changed what, newest first; entries before number `before` (0: from the newest on).
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn audit(&mut self, limit: u32, before: u64) -> Result<AuditPage, ClientError> {
        let call = self.inner.audit(wire::AuditRequest { limit, before });
        let answer = within("audit", CALL_TIMEOUT, &self.address, call).await?;
        Ok(answer.into_inner().try_into()?)
    }

    /// Follows changes of `stream` from a generation on (0: a snapshot first).
    ///
    /// # Errors
    /// See [`ClientError`].
    pub async fn watch(
        &mut self,
        stream: Option<&StreamName>,
        since_generation: u64,
    ) -> Result<Watch, ClientError> {
        let request = wire::WatchRequest {
            stream: stream.map(ToString::to_string).unwrap_or_default(),
            since_generation,
        };
        let call = self.inner.watch(request);
        let answer = within("watch", CALL_TIMEOUT, &self.address, call).await?;
        Ok(Watch {
            address: self.address.clone(),
            events: answer.into_inner(),
        })
    }
}

/// `pause` made up to half longer or shorter by chance, so that clients that lost the same server do not all come back at once.
#[must_use]
pub fn jittered(pause: Duration) -> Duration {
    use std::hash::{BuildHasher, Hasher};
    // Keyed anew in each process and each time, from the system's random source; nothing depends on its quality.
    let draw = std::collections::hash_map::RandomState::new()
        .build_hasher()
        .finish();
    pause.mul_f64(0.5 + (draw >> 11) as f64 / (1u64 << 53) as f64)
}

/// Whether a transfer is fast enough.
struct Rate {
    window: Duration,
    since: Instant,
    bytes: u64,
}

impl Rate {
    fn new(window: Duration, now: Instant) -> Self {
        Self {
            window,
            since: now,
            bytes: 0,
        }
    }

    /// # Errors
    /// [`ClientError::TooSlow`] where the window that ends now brought too little.
    fn add(&mut self, bytes: u64, now: Instant) -> Result<(), ClientError> {
        self.bytes += bytes;
        if now.duration_since(self.since) < self.window {
            return Ok(());
        }
        if (self.bytes as f64) < RATE_MIN as f64 * self.window.as_secs_f64() {
            return Err(ClientError::TooSlow);
        }
        *self = Self::new(self.window, now);
        Ok(())
    }
}

/// An open watch.
#[derive(Debug)]
pub struct Watch {
    address: String,
    events: tonic::Streaming<wire::WatchEvent>,
}

impl Watch {
    /// The next event; `None` when the server closed the watch in order.
    ///
    /// # Errors
    /// See [`ClientError`]; [`ClientError::TimedOut`] after [`WATCH_IDLE_MAX`] of silence.
    pub async fn next(&mut self) -> Result<Option<WatchEvent>, ClientError> {
        let message = within(
            "watch",
            WATCH_IDLE_MAX,
            &self.address,
            self.events.message(),
        )
        .await?;
        Ok(message.map(WatchEvent::try_from).transpose()?)
    }
}

/// The manifest under which `file` is published on `stream`: everything that the file says about itself.
///
/// # Errors
/// [`RegistryError`] where the robot hash in the file's contract is not a SHA-256.
pub fn manifest_of(
    stream: StreamName,
    file: &PolicyFile,
    created_unix_ms: u64,
) -> Result<Manifest, RegistryError> {
    let metadata = file.metadata();
    Ok(Manifest {
        stream,
        version: metadata.version,
        sha256: file.sha256(),
        size: file.bytes().len() as u64,
        created_unix_ms,
        run_id: metadata.run_id.clone(),
        contract_hash: metadata.contract.hash(),
        robot_name: metadata.contract.robot.clone(),
        robot_hash: hash_from_hex(&metadata.contract.robot_hash)?,
        env_steps: metadata.env_steps,
        training_commit: metadata.training_commit.clone(),
        config_hash: metadata.config_hash.clone(),
        evaluation_json: metadata.evaluation.as_ref().map(ToString::to_string),
        reverts_to: None,
        signatures: Vec::new(),
    })
}

fn hash_from_hex(text: &str) -> Result<[u8; 32], RegistryError> {
    let wrong = RegistryError::HashLength {
        field: "robot_hash",
        found: text.len() / 2,
    };
    let mut hash = [0; 32];
    if text.len() != 64 || !text.is_ascii() {
        return Err(wrong);
    }
    for (byte, at) in hash.iter_mut().zip((0..64).step_by(2)) {
        *byte = u8::from_str_radix(&text[at..at + 2], 16).map_err(|_| wrong.clone())?;
    }
    Ok(hash)
}

async fn within<T>(
    what: &'static str,
    limit: Duration,
    address: &str,
    call: impl Future<Output = Result<T, Status>>,
) -> Result<T, ClientError> {
    match tokio::time::timeout(limit, call).await {
        Err(_) => Err(ClientError::TimedOut { what }),
        Ok(Err(status)) => Err(refusal(address, &status)),
        Ok(Ok(answer)) => Ok(answer),
    }
}

/// A status without a message from the far side is the network's own.
fn refusal(address: &str, status: &Status) -> ClientError {
    use std::error::Error;
    let from_network = status.source().is_some();
    // A connection that broke under a call is `Unknown`, or `Internal` where HTTP/2 noticed first.
    let broken = [
        Code::Unavailable,
        Code::Unknown,
        Code::Internal,
        Code::Cancelled,
    ];
    if broken.contains(&status.code()) && from_network {
        return ClientError::Unreachable {
            address: address.to_owned(),
            reason: innermost(status),
        };
    }
    ClientError::Refused {
        code: status.code(),
        message: status.message().to_owned(),
    }
}

fn innermost(error: &dyn std::error::Error) -> String {
    let mut last = error;
    while let Some(source) = last.source() {
        last = source;
    }
    last.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_scatter_around_their_length() {
        let pause = Duration::from_secs(10);
        let drawn: Vec<f64> = (0..200).map(|_| jittered(pause).as_secs_f64()).collect();
        assert!(drawn.iter().all(|p| (5.0..15.0).contains(p)), "{drawn:?}");
        let mean = drawn.iter().sum::<f64>() / 200.0;
        // Uniform over 10 s: standard error of 200 draws 0.2 s.
        assert!((9.0..11.0).contains(&mean), "{mean}");
        let spread = drawn.iter().filter(|p| **p < 7.5).count();
        assert!((20..80).contains(&spread), "{spread}");
    }

    #[test]
    fn fault_27_one_byte_per_second_is_too_slow_and_a_poor_network_is_not() {
        let start = Instant::now();
        let at = |s| start + Duration::from_secs(s);
        let mut drip = Rate::new(RATE_WINDOW, start);
        assert!((0..30).all(|s| drip.add(1, at(s)).is_ok()));
        assert!(matches!(drip.add(1, at(30)), Err(ClientError::TooSlow)));
        let mut poor = Rate::new(RATE_WINDOW, start);
        assert!((0..600).all(|s| poor.add(4200, at(s)).is_ok()));
        // What came fast at first does not count later.
        let mut stalls = Rate::new(RATE_WINDOW, start);
        assert!(stalls.add(1 << 20, at(1)).is_ok() && stalls.add(1, at(30)).is_ok());
        assert!(matches!(stalls.add(1, at(60)), Err(ClientError::TooSlow)));
    }

    #[test]
    fn addresses_need_a_port() {
        assert!(RegistryClient::new("127.0.0.1").is_err());
        assert!(RegistryClient::new("robot:x").is_err());
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        let _context = runtime.enter();
        let client = RegistryClient::new("http://127.0.0.1:7401").unwrap();
        assert_eq!(client.address(), "127.0.0.1:7401");
    }

    #[test]
    fn nobody_there_is_told_in_one_line() {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        runtime.block_on(async {
            // Port 1 is reserved and closed on any machine that runs tests.
            let mut client = RegistryClient::new("127.0.0.1:1").unwrap();
            let error = client.list(None, 0, None).await.unwrap_err();
            assert!(
                matches!(error, ClientError::Unreachable { .. }),
                "{error:?}"
            );
            assert!(error.is_transient());
            assert!(error.to_string().contains("127.0.0.1:1"), "{error}");
        });
    }
}
