//! Calls to a policy server.

use std::path::PathBuf;

pub use caudata_proto::hex::hex;
use caudata_proto::registry::{Manifest, StreamName};
use caudata_registry_client::{ClientError, RegistryClient};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::json;

#[derive(Debug, Args)]
pub struct ServerArgs {
    /// Address of the policy server
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7401")]
    server: String,
    /// Stream of policies: a run's id unless the run chose another name; all streams when absent
    #[arg(long)]
    stream: Option<String>,
    /// Certificates for an https:// address: folder with ca.crt, tls.crt and tls.key
    #[arg(long, value_name = "DIR", env = "CAUDATA_TLS_DIR")]
    tls_dir: Option<PathBuf>,
}

/// Runs a few calls to a policy server.
pub fn block_on<T>(work: impl Future<Output = Result<T, ClientError>>) -> Result<T, Failure> {
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .or_exit(ExitCode::OsResource)?
        .block_on(work)
        .map_err(client_failure)
}

/// The exit code that a client error stands for.
pub fn client_failure(error: ClientError) -> Failure {
    let code = match &error {
        ClientError::Address { .. }
        | ClientError::Plain { .. }
        | ClientError::Certificates { .. } => ExitCode::BadConfig,
        _ if error.is_not_found() => ExitCode::NoInput,
        ClientError::Unreachable { .. } => ExitCode::Unavailable,
        _ if error.is_of_the_policy() => ExitCode::PolicyRefused,
        _ if error.is_lost_race() => ExitCode::TempFail,
        ClientError::TimedOut { .. } | ClientError::TooSlow => ExitCode::TempFail,
        ClientError::BadAnswer(_)
        | ClientError::OtherQuestion(_)
        | ClientError::WrongBytes { .. } => ExitCode::Protocol,
        ClientError::Refused { .. } => ExitCode::Unavailable,
    };
    Failure::new(code, error)
}

impl ServerArgs {
    /// The stream, where one was given.
    pub fn stream(&self) -> Result<Option<StreamName>, Failure> {
        self.stream.as_deref().map(StreamName::new).transpose().or_exit(ExitCode::BadConfig)
    }

    /// The stream, which must have been given.
    pub fn one_stream(&self) -> Result<StreamName, Failure> {
        self.stream()?.ok_or_else(|| {
            Failure::message(ExitCode::BadConfig, "which stream? `caudata policy list` shows them")
                .hint("add --stream NAME")
        })
    }

    /// A client of the server.
    pub fn client(&self) -> Result<RegistryClient, ClientError> {
        RegistryClient::with_tls(&self.server, self.tls_dir.as_deref())
    }
}

/// What a manifest says.
pub fn as_json(manifest: &Manifest) -> serde_json::Value {
    json!({
        "stream": manifest.stream.as_str(),
        "version": manifest.version,
        "sha256": hex(&manifest.sha256),
        "bytes": manifest.size,
        "run_id": manifest.run_id,
        "env_steps": manifest.env_steps,
        "robot": manifest.robot_name,
        "created_unix_ms": manifest.created_unix_ms,
    })
}
