//! FAULTS.md, 61, as a rate: one of 64 actors at a hundredth of the speed of the others. Time is simulated,
//! so that the rates are those of quota and batch, and not of the machine.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use caudata_actor::quota::Quota;
use caudata_learner::batch::{Accounting, Collector, CollectorSettings};
use caudata_proto::{DecodeLimits, Envelope, Moments, RolloutChunk, encode};

const ACTORS: u32 = 64;
/// The one that is slow in one of the two runs.
const SLOW: u32 = 17;
/// What a chunk takes, µs; with each next actor a little longer, so that they do not go in step.
const CHUNK_US: u64 = 60_000;
const SKEW_US: u64 = 37;
const WARM_UP_US: u64 = 1_000_000;
const END_US: u64 = 11_000_000;

fn chunk(actor_id: u32, sequence: u64, policy_version: u64) -> Vec<u8> {
    encode(&Envelope::Chunk(Box::new(RolloutChunk {
        run_id: "run".into(),
        actor_id,
        incarnation: 0,
        sequence,
        policy_version,
        policy_sha256: [0; 32],
        contract_hash: [0; 32],
        steps: 1,
        lanes: 1,
        obs_dim: 1,
        act_dim: 1,
        observations: vec![0.0; 2],
        actions: vec![0.0],
        action_means: vec![0.0],
        log_std: vec![0.0],
        log_probs: vec![0.0],
        rewards: vec![0.0],
        terminated: vec![false],
        truncated: vec![false],
        final_observations: Vec::new(),
        episodes: Vec::new(),
        moments: Moments { count: 1, mean: vec![0.0], m2: vec![0.0] },
        action_history: None,
        trace: None,
    })))
}

/// An actor whose simulation is a pause.
struct Actor {
    quota: Quota,
    /// Version of the policy that it runs.
    version: u64,
    chunk_us: u64,
    sent: u64,
}

impl Actor {
    /// Takes the newest policy, and begins a chunk if it may: when that will be done.
    fn begin(&mut self, newest: u64, now_us: u64) -> Option<u64> {
        if self.quota.newest() != Some(newest) {
            self.quota.policy_arrived(newest);
            self.version = newest;
        }
        self.quota.may_collect().then(|| {
            self.quota.chunk_collected();
            now_us + self.chunk_us
        })
    }
}

/// Chunks per second that are used of all actors but [`SLOW`], which takes `slowness` times as long as the
/// others.
fn rate(slowness: u64) -> f64 {
    let mut collector = Collector::new(
        CollectorSettings {
            run_id: "run".into(),
            contract_hash: [0; 32],
            steps: 1,
            lanes: 1,
            obs_dim: 1,
            act_dim: 1,
            actors: ACTORS,
            chunks_per_version: 1,
            max_lead: 1,
            lockstep: false,
            max_lag: 4,
            min_share: 0.5,
            limits: DecodeLimits::default(),
        },
        Accounting::default(),
    );
    let mut actors: Vec<Actor> = (0..ACTORS)
        .map(|id| Actor {
            quota: Quota::new(1, 1),
            version: 0,
            chunk_us: (if id == SLOW { slowness } else { 1 })
                * (CHUNK_US + u64::from(id) * SKEW_US),
            sent: 0,
        })
        .collect();
    let (mut newest, mut used, mut now_us) = (0, 0, 0);
    collector.policy_published(newest, [0; 32]);
    // Who is done when; and who waits for a policy.
    let mut done = BinaryHeap::new();
    let mut waiting: Vec<u32> = (0..ACTORS).collect();
    while now_us < END_US {
        waiting.retain(|&id| {
            let begun = actors[id as usize].begin(newest, now_us);
            done.extend(begun.map(|at| Reverse((at, id))));
            begun.is_none()
        });
        let Reverse((at, id)) = done.pop().expect("all wait for each other");
        now_us = at;
        let actor = &mut actors[id as usize];
        collector.offer(&chunk(id, actor.sent, actor.version));
        actor.sent += 1;
        waiting.push(id);
        if collector.is_ready() {
            let batch = collector.take();
            if now_us > WARM_UP_US {
                used += batch.iter().filter(|chunk| chunk.actor_id != SLOW).count();
            }
            newest += 1;
            collector.policy_published(newest, [0; 32]);
        }
    }
    assert!(collector.accounting().holds());
    used as f64 / ((END_US - WARM_UP_US) as f64 * 1e-6)
}

#[test]
fn fault_61_one_of_64_actors_at_a_hundredth_of_the_speed_costs_the_others_nothing() {
    let (even, with_a_slow_one) = (rate(1), rate(100));
    let share = with_a_slow_one / even;
    println!(
        "63 actors: {even:.0} chunks/s, with a slow 64th {with_a_slow_one:.0} ({:.1} %)",
        100.0 * share
    );
    assert!(share >= 0.95, "{:.1} %", 100.0 * share);
}
