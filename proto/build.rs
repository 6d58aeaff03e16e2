//! Generates the Rust code of `proto/*.proto` and the descriptor set that gRPC reflection serves.
//! protox reads the files itself: no `protoc` is needed.

use std::error::Error;
use std::path::PathBuf;

const FILES: [&str; 3] = ["rollout.proto", "registry.proto", "robot_link.proto"];
/// Not ours, and served by nothing of ours: reflection does not speak of it.
const FOREIGN: &str = "otlp.proto";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let mut compiler = protox::Compiler::new(["proto"])?;
    compiler.include_source_info(true).include_imports(true);
    compiler.open_files(FILES)?;
    let out_dir = PathBuf::from(std::env::var("OUT_DIR")?);
    std::fs::write(
        out_dir.join("descriptors.bin"),
        compiler.encode_file_descriptor_set(),
    )?;
    tonic_prost_build::configure().compile_fds(compiler.file_descriptor_set())?;

    let mut foreign = protox::Compiler::new(["proto"])?;
    foreign.include_source_info(true).open_file(FOREIGN)?;
    tonic_prost_build::configure().compile_fds(foreign.file_descriptor_set())?;
    Ok(())
}
