//! Writes the place of libtorch into the executables, so that they run without `LD_LIBRARY_PATH`.

use std::env;
use std::path::PathBuf;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=LIBTORCH");
    let lib = env::var_os("LIBTORCH").map(|root| PathBuf::from(root).join("lib"));
    let linux_or_mac = !matches!(env::var("CARGO_CFG_TARGET_OS").as_deref(), Ok("windows"));
    if let Some(lib) = lib.filter(|_| linux_or_mac) {
        // Beside the executable first: a packaged build brings its own libtorch.
        println!("cargo:rustc-link-arg=-Wl,-rpath,$ORIGIN/../lib");
        println!("cargo:rustc-link-arg=-Wl,-rpath,{}", lib.display());
    }
}
