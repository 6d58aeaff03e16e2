//! The rules of this repository, as tests. What may break one is in [`exceptions`], with its reason.

mod circles;
mod constants;
mod dependencies;
mod exceptions;
mod files;
mod lengths;
mod maps;
mod pages;
mod product;
mod sizes;
mod tokens;
#[cfg(target_arch = "x86_64")]
mod vectors;
