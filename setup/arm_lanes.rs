//! The vector lanes of `sim` and their tests as a crate of their own, for `make test-arm`: another processor's are
//! tried in seconds, without what `sim` depends on.
#![allow(dead_code, unused_imports, unused_macros)]

#[path = "../crates/lanes/src/real.rs"]
pub mod real;
#[path = "../crates/lanes/src/simd/mod.rs"]
pub mod simd;
