//! Kernels in vector lanes are compiled as one function each.

use std::path::PathBuf;
use std::process::Command;

use super::exceptions::{Offence, hold};

/// Programs that simulate.
const PROGRAMS: [&str; 4] =
    ["caudata", "caudata-actor", "caudata-learner", "caudata-diagnose-case"];

/// The function of a line of `nm`, without what the compiler adds to a copy of it.
fn function(line: &str) -> &str {
    let symbol = line.split_whitespace().last().unwrap_or_default();
    symbol.split(".llvm.").next().unwrap_or_default()
}

/// Whether it is a vector instruction of 8 or 16 lanes. Constants are set outside of kernels as well.
fn is_instruction(function: &str) -> bool {
    let wide = ["_mm256_", "_mm512_"].iter().any(|width| function.contains(width));
    function.contains("core_arch") && wide && !function.contains("_set1_ps")
}

/// A closure or function that stays outside of its kernel is compiled without the kernel's instruction set: each of
/// its vector instructions becomes a call through memory. It is correct, and slow.
#[test]
fn vector_instructions_are_instructions_and_no_calls() {
    let mut offences = Vec::new();
    for name in PROGRAMS {
        let program: PathBuf = caudata_tests::binary(name).expect("built");
        let nm = Command::new("nm").arg(program).output().expect("nm comes with the compiler");
        let symbols = String::from_utf8_lossy(&nm.stdout);
        assert!(symbols.contains("F32x8") && symbols.contains("core_arch"), "{name}: no names");
        let found = symbols.lines().map(function).filter(|f| is_instruction(f));
        offences.extend(found.map(|f| Offence::new(name, f)));
    }
    hold("vector instructions", offences);
}

#[test]
fn names_of_vector_instructions_are_known() {
    let line =
        "00000000020b93a0 t _RNvNtNtNtCsgEmfK2I1SDS_4core9core_arch3x867avx512f15__mm512_fmadd_ps";
    assert!(is_instruction(function(line)));
    assert!(is_instruction(function(&format!("{line}.llvm.330977306446979955"))));
    assert!(!is_instruction(function(&line.replace("fmadd", "set1"))));
    assert!(!is_instruction(function(
        "0 t _RNv4core9core_arch3x863aes27__mm_aeskeygenassist_si128"
    )));
}
