//! Files of the store: where they lie, and their JSON, which begins with a checksum of the rest.

use std::fs;
use std::path::{Path, PathBuf};

use caudata_proto::hex::hex;
use caudata_proto::registry::StreamName;
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};

use crate::error::{RecordError, StoreError};

/// What a file begins with, before the checksum and after it.
const HEAD: (&[u8], &[u8]) = (b"{\n  \"checksum\": \"", b"\",\n");
/// What its content begins with without the checksum.
const BODY: &[u8] = b"{\n";

/// The bytes of a file: `content` as an object whose first entry is the SHA-256 of the others as they stand
/// there.
///
/// # Errors
/// [`RecordError::Json`], which would be a bug.
pub fn seal(content: &impl Serialize) -> Result<Vec<u8>, RecordError> {
    let body = serde_json::to_vec_pretty(content)?;
    let entries = body.strip_prefix(BODY).ok_or(RecordError::Checksum)?;
    let sum = hex(&Sha256::digest(&body));
    Ok([HEAD.0, sum.as_bytes(), HEAD.1, entries].concat())
}

/// Reads a file's bytes, whose checksum must be right.
///
/// # Errors
/// [`RecordError::Checksum`], [`RecordError::Json`].
pub fn unseal<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, RecordError> {
    let sealed = bytes.strip_prefix(HEAD.0).and_then(|rest| {
        let (sum, rest) = rest.split_at_checked(64)?;
        Some((sum, rest.strip_prefix(HEAD.1)?))
    });
    let (sum, entries) = sealed.ok_or(RecordError::Checksum)?;
    let body = [BODY, entries].concat();
    if hex(&Sha256::digest(&body)).as_bytes() != sum {
        return Err(RecordError::Checksum);
    }
    Ok(serde_json::from_slice(&body)?)
}

/// Reads a file; the outer error: it cannot be read at all.
///
/// # Errors
/// [`StoreError::Unusable`].
pub fn read<F: DeserializeOwned, T>(path: &Path) -> Result<Result<T, RecordError>, StoreError>
where
    T: TryFrom<F>,
    RecordError: From<T::Error>,
{
    let bytes = fs::read(path).map_err(|error| unusable(path, &error.to_string()))?;
    Ok(unseal::<F>(&bytes).and_then(|file| Ok(T::try_from(file)?)))
}

/// Stream names may hold `/`; on disk that is `@`, which no stream name may hold.
pub fn stream_folder(stream: &StreamName) -> String {
    stream.as_str().replace('/', "@")
}

/// The stream and the version of a file that lies at `<stream>/<version>.json`.
pub fn version_of(path: &Path) -> Option<(StreamName, u64)> {
    let folder = path.parent()?.file_name()?.to_str()?.replace('@', "/");
    let version = path.file_stem()?.to_str()?.parse().ok()?;
    Some((StreamName::new(&folder).ok()?, version))
}

/// What is in a folder, sorted.
///
/// # Errors
/// [`StoreError::Unusable`].
pub fn entries(folder: &Path) -> Result<Vec<PathBuf>, StoreError> {
    let listed = fs::read_dir(folder).map_err(|error| unusable(folder, &error.to_string()))?;
    let mut paths: Vec<PathBuf> = listed.flatten().map(|entry| entry.path()).collect();
    paths.sort();
    Ok(paths)
}

/// Files in the folders of `folder`; what interrupted writes left is removed.
///
/// # Errors
/// [`StoreError::Unusable`], [`StoreError::Durable`].
pub fn files_below(folder: &Path) -> Result<Vec<PathBuf>, StoreError> {
    let mut files = Vec::new();
    for inner in entries(folder)?.into_iter().filter(|path| path.is_dir()) {
        caudata_durable::remove_leftovers(&inner)?;
        files.extend(entries(&inner)?);
    }
    Ok(files)
}

/// The error of a folder or file that cannot be worked with.
pub fn unusable(path: &Path, reason: &str) -> StoreError {
    StoreError::Unusable { path: path.to_path_buf(), reason: reason.to_owned() }
}

/// What fits into a line of the record.
pub fn clipped(words: &str) -> String {
    let line = words.chars().filter(|c| !c.is_control());
    let mut length = 0;
    line.take_while(|c| {
        length += c.len_utf8();
        length <= 300
    })
    .collect()
}
