//! Announcements of policy files.

use caudata_policy::PolicyFile;
use caudata_proto::hex::from_hex;
use caudata_proto::registry::{Manifest, RegistryError, StreamName};

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
    let bytes = from_hex(text).and_then(|bytes| bytes.try_into().ok());
    bytes.ok_or(RegistryError::HashLength { field: "robot_hash", found: text.len() / 2 })
}
