//! The subset of ONNX that a policy file may use: writing it, and reading it strictly.
//!
//! Field numbers, operator semantics and the meaning of `ir_version` are those of the ONNX
//! specification (`onnx.proto`, operator set 17). A file is read in two passes: [`scan`] walks the
//! raw bytes against a closed table of fields, with a limit on each, before anything is decoded;
//! [`graph`] then follows the one chain of operators that a policy may be.

pub(crate) mod build;
pub(crate) mod graph;
pub(crate) mod messages;
pub(crate) mod scan;

/// Version of the ONNX file format that is written and read: the one that came with operator
/// set 17, readable by ONNX Runtime 1.12 and later.
pub(crate) const IR_VERSION: i64 = 8;
/// Operator set that is written and read.
pub(crate) const OPSET: i64 = 17;
/// Name of the input tensor, as in rsl_rl's exports.
pub(crate) const INPUT: &str = "obs";
/// Name of the output tensor, as in rsl_rl's exports.
pub(crate) const OUTPUT: &str = "actions";
/// Name of the batch dimension.
pub(crate) const BATCH: &str = "N";
