//! What the tests of this crate share.

use caudata_proto::registry::{Manifest, StreamName};
use sha2::{Digest, Sha256};

/// A manifest for `bytes` with fixed, valid values everywhere else.
pub fn manifest(stream: &str, version: u64, bytes: &[u8]) -> Manifest {
    Manifest {
        stream: StreamName::new(stream).unwrap(),
        version,
        sha256: Sha256::digest(bytes).into(),
        size: bytes.len() as u64,
        created_unix_ms: 1_700_000_000_000,
        run_id: "run-1".into(),
        contract_hash: [7; 32],
        robot_name: "polymander".into(),
        robot_hash: [9; 32],
        env_steps: 1000,
        training_commit: String::new(),
        config_hash: String::new(),
        evaluation_json: None,
        reverts_to: None,
        signatures: vec![],
    }
}
