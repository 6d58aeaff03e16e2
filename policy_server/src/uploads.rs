//! Uploads: a header, then exactly the bytes that it announces, and those must be what it says.

use std::time::Duration;

use caudata_policy::PolicyFile;
use caudata_proto::hex::hex;
use caudata_proto::registry::{Manifest, RegistryError};
use caudata_proto::wire::registry as wire;
use tonic::{Request, Status, Streaming};

use crate::error::StoreError;

/// A publisher must send its next piece within this time.
pub const UPLOAD_IDLE_MAX: Duration = Duration::from_secs(30);

/// Reads a whole upload: a checked header that `may` come, then exactly the announced number of bytes.
///
/// # Errors
/// What is wrong with it.
pub async fn receive_upload(
    mut upload: Streaming<wire::PublishRequest>,
    idle: Duration,
    may: impl FnOnce(&Manifest) -> Result<(), Status>,
) -> Result<(Manifest, Vec<u8>), Status> {
    let header = match next_part(&mut upload, idle).await? {
        Some(wire::publish_request::Part::Header(header)) => header,
        _ => return Err(Status::invalid_argument("the first message must be the header")),
    };
    let manifest = Manifest::try_from(header).map_err(|error| refusal(&error))?;
    may(&manifest)?;
    let mut bytes = Vec::with_capacity(usize::try_from(manifest.size).unwrap_or(0));
    while let Some(part) = next_part(&mut upload, idle).await? {
        let wire::publish_request::Part::Data(piece) = part else {
            return Err(Status::invalid_argument("a second header came in the middle of the file"));
        };
        if (bytes.len() + piece.len()) as u64 > manifest.size {
            return Err(Status::invalid_argument(format!(
                "more bytes came than the announced {}",
                manifest.size
            )));
        }
        bytes.extend_from_slice(&piece);
    }
    if bytes.len() as u64 != manifest.size {
        return Err(Status::invalid_argument(format!(
            "upload ended after {} of {} bytes; send the file again",
            bytes.len(),
            manifest.size
        )));
    }
    Ok((manifest, bytes))
}

async fn next_part(
    upload: &mut Streaming<wire::PublishRequest>,
    idle: Duration,
) -> Result<Option<wire::publish_request::Part>, Status> {
    let message = tokio::time::timeout(idle, upload.message())
        .await
        .map_err(|_| Status::deadline_exceeded("the upload stalled; send the file again"))??;
    match message {
        None => Ok(None),
        Some(wire::PublishRequest { part: Some(part) }) => Ok(Some(part)),
        Some(_) => Err(Status::invalid_argument("an upload message is empty")),
    }
}

/// The server stores only files that the strict checker accepts and whose metadata say what the header says.
pub fn check_against_file(manifest: &Manifest, bytes: &[u8]) -> Result<(), Status> {
    let file = PolicyFile::parse(bytes.into())
        .map_err(|error| Status::invalid_argument(format!("not a caudata policy: {error}")))?;
    let metadata = file.metadata();
    let fields = [
        ("contract hash", hex(&manifest.contract_hash), hex(&metadata.contract.hash())),
        ("robot hash", hex(&manifest.robot_hash), metadata.contract.robot_hash.to_string()),
        ("run id", manifest.run_id.clone(), metadata.run_id.clone()),
        ("version", manifest.version.to_string(), metadata.version.to_string()),
    ];
    for (field, header, file) in fields {
        if header != file {
            let error = StoreError::HeaderMismatch { field, header, file };
            return Err(Status::from(&error));
        }
    }
    Ok(())
}

/// The checked form of a request.
pub fn checked<W, D: TryFrom<W, Error = RegistryError>>(request: Request<W>) -> Result<D, Status> {
    D::try_from(request.into_inner()).map_err(|error| refusal(&error))
}

fn refusal(error: &RegistryError) -> Status {
    match error {
        RegistryError::Range { field: "size", .. } => Status::resource_exhausted(error.to_string()),
        _ => Status::invalid_argument(error.to_string()),
    }
}
