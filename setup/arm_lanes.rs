//! The vector lanes of `sim` and their tests as a crate of their own, for `make test-arm`: another processor's are
//! tried in seconds, without what `sim` depends on.
#![allow(dead_code, unused_imports, unused_macros)]

#[path = "../sim/src/real.rs"]
pub mod real;
#[path = "../sim/src/simd/mod.rs"]
pub mod simd;
