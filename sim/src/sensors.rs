//! Measurement models (pure).
