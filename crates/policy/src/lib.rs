//! The policy file: ONNX graph, metadata, strict checks, inference with ONNX Runtime.
//!
//! The learner writes one with [`build_onnx`]; actors, evaluation and the robot read it with
//! [`PolicyFile::parse`] and run it with [`Inference`], all on the same bytes.
//! `docs/reference/policy-file.md` describes the format.
//!
//! *Invariant*: bytes from outside reach ONNX Runtime only as a [`PolicyFile`]; the runtime is no
//! sandbox.

mod average;
mod error;
mod file;
mod inference;
mod join;
mod metadata;
mod mlp;
mod onnx;
mod runtime;
#[cfg(test)]
mod tests;

pub use average::average;
pub use error::PolicyError;
pub use file::PolicyFile;
pub use inference::Inference;
pub use join::join;
pub use metadata::{METADATA_KEY, PolicyMetadata};
pub use mlp::{Activation, Dense, MAX_LAYERS, MAX_WIDTH, MIN_OBS_STD, MlpSpec, evaluate_mlp};
pub use onnx::build::build_onnx;
pub use runtime::{Lookup, runtime_library};

/// Largest policy file, bytes. The paper's network (512, 256, 128) takes 0.9 MB.
pub const MAX_FILE_BYTES: usize = 8 << 20;
