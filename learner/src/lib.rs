//! PPO on libtorch: batches, update, checkpoints, ONNX export.
