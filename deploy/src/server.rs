//! The way to the policy server.

use std::path::Path;

use caudata_registry_client::RegistryClient;
use tokio::runtime::{Builder, Runtime};

use crate::DeployError;

/// A client of the policy server at `address`, and the runtime of one thread that it works on.
///
/// # Errors
/// [`DeployError::System`], [`DeployError::Server`] for a wrong address or certificates.
pub(crate) fn connect(
    address: &str,
    tls_dir: Option<&Path>,
) -> Result<(Runtime, RegistryClient), DeployError> {
    let runtime = Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(DeployError::system("a network runtime"))?;
    let client = {
        let _context = runtime.enter();
        RegistryClient::to_any_host(address, tls_dir)?
    };
    Ok((runtime, client))
}
