//! Generated message types and gRPC stubs, by package, as they are on the wire: unchecked.

/// Package `caudata.rollout.v1`.
#[allow(missing_docs, clippy::all)]
pub mod rollout {
    include!(concat!(env!("OUT_DIR"), "/caudata.rollout.v1.rs"));
}

/// Package `caudata.registry.v1`: messages, client and server of the policy registry.
#[allow(missing_docs, clippy::all)]
pub mod registry {
    include!(concat!(env!("OUT_DIR"), "/caudata.registry.v1.rs"));
}

/// Package `caudata.robot_link.v1`.
#[allow(missing_docs, clippy::all)]
pub mod robot_link {
    include!(concat!(env!("OUT_DIR"), "/caudata.robot_link.v1.rs"));
}

/// Package `opentelemetry.proto.collector.trace.v1`: what traces are exported with.
#[allow(missing_docs, clippy::all)]
pub mod otlp {
    include!(concat!(env!("OUT_DIR"), "/opentelemetry.proto.collector.trace.v1.rs"));
}

/// The encoded `FileDescriptorSet` of our own packages, for gRPC reflection.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
