//! ONNX's messages (`proto/onnx.proto`), as far as policies use them.

include!(concat!(env!("OUT_DIR"), "/caudata.onnx.rs"));

pub(crate) use dimension::Extent;

/// `TensorProto.DataType.FLOAT`.
pub(crate) const FLOAT: i32 = 1;
