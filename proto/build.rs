//! Generates the Rust code of `proto/*.proto` and the descriptor set that gRPC reflection serves.
//! protox reads the files itself: no `protoc` is needed.

use std::error::Error;
use std::path::PathBuf;

const FILES: [&str; 3] = ["rollout.proto", "registry.proto", "robot_link.proto"];
/// Package of the registry's messages.
const REGISTRY: &str = "caudata.registry.v1";
/// Not ours, and served by nothing of ours: reflection does not speak of it.
const FOREIGN: &str = "otlp.proto";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let mut compiler = protox::Compiler::new(["proto"])?;
    compiler.include_source_info(true).include_imports(true);
    compiler.open_files(FILES)?;
    let out_dir = PathBuf::from(std::env::var("OUT_DIR")?);
    std::fs::write(out_dir.join("descriptors.bin"), compiler.encode_file_descriptor_set())?;
    let mut registry = tonic_prost_build::configure();
    // What the policy server keeps in files, as it keeps it there.
    for message in ["Manifest", "Signature", "LabelState", "QuarantineState", "RobotReport"] {
        registry = registry.type_attribute(
            format!("{REGISTRY}.{message}"),
            "#[derive(serde::Serialize, serde::Deserialize)]",
        );
    }
    for (field, serde) in [
        ("Manifest.sha256", "with = \"crate::hex\""),
        ("Manifest.contract_hash", "with = \"crate::hex\""),
        ("Manifest.robot_hash", "with = \"crate::hex\""),
        ("Manifest.reverts_to", "skip_serializing_if = \"Option::is_none\""),
        ("Signature.signature", "with = \"crate::hex\""),
        ("RobotReport.sha256", "with = \"crate::hex\""),
        ("RobotReport.state", "with = \"crate::disk::state_word\""),
    ] {
        registry =
            registry.field_attribute(format!("{REGISTRY}.{field}"), format!("#[serde({serde})]"));
    }
    // One file is handed to many at once.
    registry
        .bytes(format!(".{REGISTRY}.FetchResponse"))
        .compile_fds(compiler.file_descriptor_set())?;

    let mut foreign = protox::Compiler::new(["proto"])?;
    foreign.include_source_info(true).open_file(FOREIGN)?;
    tonic_prost_build::configure().compile_fds(foreign.file_descriptor_set())?;
    Ok(())
}
