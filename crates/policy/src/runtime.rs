//! Where ONNX Runtime's library is, and loading it, once per process.

use std::env;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ort::environment::Environment;
use ort::logging::LogLevel;

use crate::PolicyError;

/// Where [`Lookup::find`] looks, in this order.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Lookup {
    /// The library itself, as named by `ORT_DYLIB_PATH`. Nothing else is looked at where it is set.
    pub named: Option<PathBuf>,
    /// Folder of the running program.
    pub program_dir: Option<PathBuf>,
    /// The user's cache folder; `caudata/onnxruntime-<version>-<architecture>/lib` below it.
    pub cache_dir: Option<PathBuf>,
}

impl Lookup {
    /// What the environment of this process says.
    pub fn from_env() -> Self {
        let var = |name| env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
        Self {
            named: var("ORT_DYLIB_PATH"),
            program_dir: env::current_exe().ok().and_then(|p| p.parent().map(Path::to_owned)),
            cache_dir: var("XDG_CACHE_HOME").or_else(|| var("HOME").map(|h| h.join(".cache"))),
        }
    }

    /// Path of the library.
    ///
    /// # Errors
    /// [`PolicyError::RuntimeNotFound`] lists where was looked.
    pub fn find(&self) -> Result<PathBuf, PolicyError> {
        if let Some(named) = &self.named {
            if named.is_file() {
                return Ok(named.clone());
            }
            let reason = format!("ORT_DYLIB_PATH names {}, which is no file", named.display());
            return Err(PolicyError::RuntimeNotFound { reason });
        }
        let file = library_file_name();
        let mut searched = Vec::new();
        if let Some(dir) = &self.program_dir {
            let path = dir.join(&file);
            if path.is_file() {
                return Ok(path);
            }
            searched.push(path.display().to_string());
        }
        if let Some(dir) = &self.cache_dir {
            let dir = dir.join("caudata");
            if let Some(path) = newest_in_cache(&dir, &file) {
                return Ok(path);
            }
            let pattern = dir.join(format!("onnxruntime-*-{}", env::consts::ARCH)).join("lib");
            searched.push(pattern.join(&file).display().to_string());
        }
        let reason = format!("looked for {}", searched.join(" and "));
        Err(PolicyError::RuntimeNotFound { reason })
    }
}

/// Where ONNX Runtime's library is: `ORT_DYLIB_PATH`, else beside the program, else the newest
/// version in the user's cache.
///
/// # Errors
/// [`PolicyError::RuntimeNotFound`] says where was looked and what to do.
pub fn runtime_library() -> Result<PathBuf, PolicyError> {
    Lookup::from_env().find()
}

fn library_file_name() -> String {
    format!("{}onnxruntime{}", env::consts::DLL_PREFIX, env::consts::DLL_SUFFIX)
}

/// The library of the newest `onnxruntime-<version>-<architecture>` in a folder.
fn newest_in_cache(dir: &Path, file: &str) -> Option<PathBuf> {
    let entries = std::fs::read_dir(dir).ok()?;
    entries
        .filter_map(|entry| {
            let entry = entry.ok()?;
            let version = cached_version(entry.file_name().to_str()?)?;
            let path = entry.path().join("lib").join(file);
            path.is_file().then_some((version, path))
        })
        .max()
        .map(|(_, path)| path)
}

/// `onnxruntime-1.31.1-x86_64` is version 1, 31, 1, where `x86_64` is this machine.
fn cached_version(folder: &str) -> Option<Vec<u32>> {
    let version = folder.strip_prefix("onnxruntime-")?;
    let version = version.strip_suffix(env::consts::ARCH)?.strip_suffix('-')?;
    version.split('.').map(|part| part.parse().ok()).collect()
}

/// Keeps the environment for the life of the process: ONNX Runtime allows one, and its threads
/// and allocators should not be torn down and built anew with each policy.
static ENVIRONMENT: Mutex<Option<Environment>> = Mutex::new(None);

/// The process's ONNX Runtime, loaded on the first call. A failed load may be tried again.
pub(crate) fn environment() -> Result<Environment, PolicyError> {
    let mut slot = ENVIRONMENT.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(environment) = &*slot {
        return Ok(environment.clone());
    }
    let path = runtime_library()?;
    let failed = |reason: String| PolicyError::RuntimeLoad { path: path.clone(), reason };
    // Loaded by path here and now: left to itself, ort would look for the library on first use
    // and panic where there is none.
    let environment = ort::init_from(&path)
        .map_err(|e| failed(e.to_string()))?
        .with_name("caudata")
        .with_telemetry(false)
        .with_logger(Arc::new(log))
        .build()
        .map_err(|e| failed(e.to_string()))?;
    environment.set_log_level(LogLevel::Warning);
    tracing::debug!(library = %path.display(), "loaded ONNX Runtime");
    Ok(slot.insert(environment).clone())
}

/// ONNX Runtime's messages, in the program's log.
fn log(level: LogLevel, category: &str, _id: &str, _location: &str, message: &str) {
    match level {
        LogLevel::Verbose => tracing::trace!(target: "onnxruntime", category, message),
        LogLevel::Info => tracing::debug!(target: "onnxruntime", category, message),
        LogLevel::Warning => tracing::warn!(target: "onnxruntime", category, message),
        LogLevel::Error | LogLevel::Fatal => {
            tracing::error!(target: "onnxruntime", category, message);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// An empty library file below `dir`, its folders made.
    fn library(dir: &Path) -> PathBuf {
        fs::create_dir_all(dir).unwrap();
        let path = dir.join(library_file_name());
        fs::write(&path, "").unwrap();
        path
    }

    #[test]
    fn a_named_library_counts_alone() {
        let dir = tempfile::tempdir().unwrap();
        let beside = library(dir.path());
        let elsewhere = library(&dir.path().join("named"));
        let mut lookup = Lookup {
            named: Some(elsewhere.clone()),
            program_dir: Some(dir.path().to_owned()),
            cache_dir: None,
        };
        assert_eq!(lookup.find().unwrap(), elsewhere);
        lookup.named = Some(dir.path().join("missing.so"));
        let error = lookup.find().unwrap_err().to_string();
        assert!(error.contains("missing.so"), "{error}");
        lookup.named = None;
        assert_eq!(lookup.find().unwrap(), beside);
    }

    #[test]
    fn the_newest_cached_version_for_this_machine_is_taken() {
        let dir = tempfile::tempdir().unwrap();
        let arch = env::consts::ARCH;
        let cached = |name: String| library(&dir.path().join("caudata").join(name).join("lib"));
        cached(format!("onnxruntime-1.9.3-{arch}"));
        let newest = cached(format!("onnxruntime-1.31.1-{arch}"));
        cached("onnxruntime-9.0.0-pdp11".to_owned());
        cached(format!("onnxruntime-nightly-{arch}"));
        let lookup = Lookup { cache_dir: Some(dir.path().to_owned()), ..Lookup::default() };
        assert_eq!(lookup.find().unwrap(), newest);
    }

    #[test]
    fn nothing_found_says_where_and_what_to_do() {
        let lookup = Lookup {
            named: None,
            program_dir: Some("/nowhere/bin".into()),
            cache_dir: Some("/nowhere/cache".into()),
        };
        let error = lookup.find().unwrap_err().to_string();
        for part in ["/nowhere/bin", "/nowhere/cache/caudata/onnxruntime-*", "ORT_DYLIB_PATH"] {
            assert!(error.contains(part), "{part} in {error}");
        }
    }
}
