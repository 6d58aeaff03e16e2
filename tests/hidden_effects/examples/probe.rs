//! Looks at the truth: speed, null discrepancy, and the sizes of every effect at a given d on a rig: `probe RIG D FOLDER [EFFECT[,EFFECT] [SEED]]`; two effects are
//! hidden together.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use caudata_hidden_effects::battery::{self, Amount};
use caudata_hidden_effects::case::Block;
use caudata_hidden_effects::generate::{self, Request, Rig};
use caudata_hidden_effects::hidden::{CATALOGUE, OUTSIDE, find};
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let rig = Rig::bench(args.get(1).map_or("pendulum", |s| s)).unwrap();
    let d: f64 = args.get(2).map_or(4.0, |s| s.parse().unwrap());
    let out = std::path::PathBuf::from(args.get(3).expect("output folder"));
    let only = args.get(4);
    let seed = |otherwise: u64| args.get(5).map_or(otherwise, |s| s.parse().unwrap());
    let trials = battery::fit(&rig.model, Amount::Full);
    let total: f64 = trials.iter().map(|t| t.duration_s()).sum();
    let now = std::time::Instant::now();
    for seed in 1..4 {
        let view = generate::null_view(&rig, &trials, seed).unwrap();
        println!(
            "null {seed}: {:.3} over {total} s of trials; {:.2} s",
            view.discrepancy,
            now.elapsed().as_secs_f64()
        );
    }
    for (i, h) in CATALOGUE.iter().chain(OUTSIDE).enumerate() {
        let together: Vec<&str> = only.map_or(vec![h.id], |o| o.split(',').collect());
        if together[0] != h.id {
            continue;
        }
        let of = |id: &&str| find(id).expect("an effect of the catalogue, or a law outside it");
        let now = std::time::Instant::now();
        let request = Request {
            name: h.id.to_owned(),
            block: Block::Single,
            rig: &rig,
            seed: seed(100 + i as u64),
            amount: Amount::Full,
            effects: together.iter().map(|id| (of(id), 0, d)).collect(),
            decoy: None,
            without: Vec::new(),
        };
        match generate::make(&request, &out) {
            Ok(a) => {
                let e = &a.effects[0];
                println!(
                    "{:26} size {:9.4} d {:5.2} truth {:?} {:.1} s",
                    h.id,
                    e.size,
                    e.d,
                    e.parameters
                        .iter()
                        .map(|p| (p.value, p.nominal))
                        .collect::<Vec<_>>(),
                    now.elapsed().as_secs_f64()
                );
            }
            Err(e) => println!("{:26} {e} {:.1} s", h.id, now.elapsed().as_secs_f64()),
        }
    }
}
