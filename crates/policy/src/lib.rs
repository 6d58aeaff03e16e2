//! The policy file: ONNX graph, metadata, strict checks, inference with ONNX Runtime.
