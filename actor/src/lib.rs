//! Steps environments, runs the ONNX policy and streams rollouts.
