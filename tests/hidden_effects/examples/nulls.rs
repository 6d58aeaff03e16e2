//! Writes nulls of a rig for looking at false alarms.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use caudata_hidden_effects::battery::Amount;
use caudata_hidden_effects::case::Block;
use caudata_hidden_effects::generate::{self, Request, Rig};
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let rig = Rig::bench(&args[1]).unwrap();
    let out = std::path::PathBuf::from(&args[2]);
    let count: u64 = args[3].parse().unwrap();
    for i in 0..count {
        let request = Request {
            name: format!("null_{i}"),
            block: Block::Null,
            rig: &rig,
            seed: 5000 + i,
            amount: Amount::Full,
            effects: Vec::new(),
            decoy: None,
            without: Vec::new(),
        };
        generate::make(&request, &out).unwrap();
    }
}
