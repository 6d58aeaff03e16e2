//! Kernels in vector lanes are compiled as one function each.

use std::process::Command;

use super::exceptions::{Offence, hold};
use super::sizes::PROGRAMS;

/// Ends of the names of vector instructions that kernels are made of. (Constants are set outside of kernels as well.)
const INSTRUCTIONS: [&str; 4] = ["_add_ps", "_mul_ps", "_fmadd_ps", "_min_ps"];

/// A closure or function that stays outside of its kernel is compiled without the kernel's instruction set: each of
/// its vector instructions becomes a call through memory. It is correct, and a third slower.
#[cfg(target_arch = "x86_64")]
#[test]
fn vector_instructions_are_instructions_and_no_calls() {
    let mut offences = Vec::new();
    for (name, _) in PROGRAMS {
        let program = caudata_tests::binary(name).expect("built");
        let nm = Command::new("nm").arg(program).output().expect("nm comes with the compiler");
        let symbols = String::from_utf8_lossy(&nm.stdout);
        assert!(symbols.contains("caudata"), "{name} has no names of functions");
        let called = |symbol: &&str| {
            symbol.contains("core_arch") && INSTRUCTIONS.iter().any(|end| symbol.ends_with(end))
        };
        offences.extend(symbols.lines().filter(called).map(|symbol| Offence::new(name, symbol)));
    }
    hold("vector instructions", offences);
}
