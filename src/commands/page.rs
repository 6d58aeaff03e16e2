//! Where a live page is, and how it is encrypted.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::SystemTime;

use caudata_live::{LivePage, Show, Training};
use caudata_signing::pki::{CERTIFICATE_FILE, Callers, hosts_of_pem, listen_as, listen_unknown};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;

use crate::commands::cluster::pki;

/// What a page speaks within TLS.
const PROTOCOL: &str = "http/1.1";

/// Where a live page is.
#[derive(Debug, Args)]
pub struct PageArgs {
    /// Address of the live page; default: any free port, for this machine alone. Beyond it the page is encrypted
    #[arg(long, value_name = "IP:PORT", default_value = "127.0.0.1:0", hide_default_value = true)]
    page: SocketAddr,
    /// Folder with tls.crt and tls.key for the page; without it a page for others has a certificate made for this run, of which browsers warn
    #[arg(long, value_name = "DIR")]
    page_tls: Option<PathBuf>,
}

impl PageArgs {
    /// Serves a live page, and tells a person what is to know of its certificate.
    ///
    /// # Errors
    /// When the address or the certificate cannot be had.
    pub fn serve(
        &self,
        show: Show,
        training: Option<Training>,
        tell: &dyn Fn(&str),
    ) -> Result<LivePage, Failure> {
        let mut name = caudata_actor::host_name().ok();
        let tls = match &self.page_tls {
            Some(folder) => {
                let tls = listen_as(folder, Callers::Anyone, PROTOCOL).map_err(pki::failure)?;
                // browsers take the page by a name that its certificate holds
                let held = hosts_of_pem(&folder.join(CERTIFICATE_FILE)).map_err(pki::failure)?;
                if !name.as_ref().is_some_and(|own| held.contains(own)) {
                    let told = held.into_iter().find(|host| !host.starts_with('*'));
                    name = told.or(name);
                }
                Some(tls)
            }
            None if self.page.ip().is_loopback() => None,
            None => {
                let hosts = [name.clone(), Some(self.page.ip().to_string())];
                let hosts = hosts.into_iter().flatten().collect();
                let (tls, fingerprint) =
                    listen_unknown(hosts, SystemTime::now(), PROTOCOL).map_err(pki::failure)?;
                tell(
                    "the page's certificate is made for this run, and browsers warn of it; its SHA-256:",
                );
                tell(&fingerprint);
                Some(tls)
            }
        };
        LivePage::start(self.page, name, show, training, tls).or_exit(ExitCode::OsResource)
    }
}
