//! Diagnosis from outside: logs in, findings and files out.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod assumed;
mod check;
mod common;
mod effects;
mod excite;
mod extension;
mod page;
mod recordings;
mod recover;
mod replay;
mod xl330;
