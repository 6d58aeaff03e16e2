//! `caudata`: the command line.
fn main() {}
