//! The linker folds functions of the same code into one: 1.1 of 40 MiB of `caudata`. Nothing here compares addresses
//! of functions (the compiler warns of that).

use std::env::var;
use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    if links_with_lld() {
        println!("cargo:rustc-link-arg-bins=-Wl,--icf=all");
    }
}

/// Whether this rustc comes with LLD, which is its linker on this target then. Others do not know the option, and
/// who gives flags of their own may have chosen one.
fn links_with_lld() -> bool {
    let (target, flags) = (var("TARGET"), var("CARGO_ENCODED_RUSTFLAGS"));
    let sysroot =
        Command::new(var("RUSTC").unwrap_or_default()).args(["--print", "sysroot"]).output();
    let (Ok(target), Ok(sysroot)) = (target, sysroot) else { return false };
    let sysroot = String::from_utf8_lossy(&sysroot.stdout).trim().to_owned();
    let lld = format!("lib/rustlib/{target}/bin/gcc-ld/ld.lld");
    target == "x86_64-unknown-linux-gnu"
        && flags.unwrap_or_default().is_empty()
        && Path::new(&sysroot).join(lld).exists()
}
