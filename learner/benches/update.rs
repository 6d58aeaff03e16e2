//! Speed of one PPO update: `cargo bench -p caudata-learner --bench update -- [threads] [samples] [hidden]`.
//!
//! Prints environment steps per second that the update alone could keep up with, at 4 epochs of 4 minibatches.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::time::Instant;

use caudata_config::{NetworkConfig, PpoConfig, StalenessConfig};
use caudata_learner::batch::{Batch, Segment};
use caudata_learner::network::{ActorCritic, NetworkSpec};
use caudata_learner::normaliser::Scaling;
use caudata_learner::ppo::{Ppo, PpoSettings};
use caudata_random::{Key, Purpose, Stream};

const OBS: usize = 97;
const ACT: usize = 16;
const LANES: usize = 128;

fn main() {
    let arguments: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| a != "--bench")
        .collect();
    let number = |at: usize, default: usize| {
        arguments
            .get(at)
            .and_then(|text| text.parse().ok())
            .unwrap_or(default)
    };
    let (threads, samples) = (number(0, 1), number(1, 6144));
    let hidden: Vec<u32> = arguments.get(2).map_or(vec![128, 128], |text| {
        text.split(',').map(|n| n.parse().unwrap()).collect()
    });
    let network = NetworkConfig {
        policy_hidden: hidden.clone(),
        value_hidden: hidden.clone(),
        ..NetworkConfig::default()
    };
    let spec = NetworkSpec::new(&network, OBS, ACT).unwrap();
    let settings = PpoSettings {
        ppo: PpoConfig::default(),
        staleness: StalenessConfig::default(),
        mirror: None,
    };
    let epochs = settings.ppo.epochs;
    let net = ActorCritic::new(spec, 1, tch::Device::Cpu);
    let mut ppo = Ppo::new(net, settings, threads).unwrap();
    let batch = noise(samples / LANES);
    let scaling = Scaling::identity(OBS, 10.0);
    let mut order = stream(Purpose::Minibatch);
    let mut best = f64::INFINITY;
    for _ in 0..8 {
        let started = Instant::now();
        ppo.update(&batch, &scaling, 0, &mut order, false).unwrap();
        best = best.min(started.elapsed().as_secs_f64());
    }
    println!(
        "{threads} threads, {} samples, {hidden:?}, {epochs} epochs: {:.1} ms, {:.0} steps/s, {:.0} samples/s",
        batch.rows,
        best * 1e3,
        batch.rows as f64 / best,
        batch.rows as f64 * f64::from(epochs) / best
    );
}

fn stream(purpose: Purpose) -> Stream {
    Stream::new(
        Key {
            seed: 1,
            actor: 0,
            env: 0,
            episode: 0,
        },
        purpose,
    )
}

fn noise(steps: usize) -> Batch {
    let mut noise = stream(Purpose::Sensor);
    let rows = steps * LANES;
    let mut draw = |n: usize| (0..n).map(|_| noise.normal()).collect::<Vec<f32>>();
    Batch {
        obs_dim: OBS,
        act_dim: ACT,
        rows,
        observations: draw((rows + LANES) * OBS),
        actions: draw(rows * ACT),
        behaviour_log_probs: draw(rows),
        rewards: draw(rows),
        terminated: vec![false; rows],
        truncated: vec![false; rows],
        segments: vec![Segment {
            first_row: 0,
            steps,
            lanes: LANES,
            bootstrap_row: rows,
            finals: 0,
            policy_version: 0,
        }],
        moments: Vec::new(),
    }
}
