//! How long one rollout frame takes to write and to read.
#![allow(clippy::print_stdout)]

use std::hint::black_box;
use std::time::Instant;

use caudata_proto::{DecodeLimits, Envelope, Moments, RolloutChunk, decode, encode};

const REPEATS: u32 = 200;

fn main() {
    for (steps, lanes) in [(24, 64), (48, 128)] {
        let envelope = Envelope::Chunk(Box::new(chunk(steps, lanes)));
        let frame = encode(&envelope);
        let limits = DecodeLimits::default();
        let encode_us = best_us(|| {
            black_box(encode(black_box(&envelope)));
        });
        let decode_us = best_us(|| {
            let _ = black_box(decode(black_box(&frame), &limits));
        });
        println!(
            "{steps} steps x {lanes} lanes: {:.2} MB, encode {encode_us:.0} us, decode {decode_us:.0} us",
            frame.len() as f64 / 1e6
        );
    }
}

/// The fastest of many runs: what the code takes when nothing else is in its way.
fn best_us(mut run: impl FnMut()) -> f64 {
    let mut best = f64::INFINITY;
    for _ in 0..REPEATS {
        let start = Instant::now();
        run();
        best = best.min(start.elapsed().as_secs_f64() * 1e6);
    }
    best
}

fn chunk(steps: usize, lanes: usize) -> RolloutChunk {
    let (obs_dim, act_dim) = (97, 16);
    let cells = steps * lanes;
    RolloutChunk {
        run_id: "speed".into(),
        actor_id: 0,
        incarnation: 0,
        sequence: 0,
        policy_version: 0,
        policy_sha256: [0; 32],
        contract_hash: [0; 32],
        steps,
        lanes,
        obs_dim,
        act_dim,
        observations: vec![0.5; (cells + lanes) * obs_dim],
        actions: vec![0.5; cells * act_dim],
        action_means: vec![0.5; cells * act_dim],
        log_std: vec![-0.5; act_dim],
        log_probs: vec![-1.0; cells],
        rewards: vec![0.1; cells],
        terminated: vec![false; cells],
        truncated: vec![false; cells],
        final_observations: Vec::new(),
        episodes: Vec::new(),
        moments: Moments {
            count: cells as u64,
            mean: vec![0.5; obs_dim],
            m2: vec![0.0; obs_dim],
        },
        action_history: None,
        trace: None,
    }
}
