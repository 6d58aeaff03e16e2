//! The registry of policies: content-addressed store and gRPC service.
