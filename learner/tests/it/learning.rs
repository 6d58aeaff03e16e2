//! Whether the update learns: two small problems with known answers, no simulator.

use std::sync::Arc;

use caudata_config::{Config, NetworkConfig, PpoConfig};
use caudata_learner::batch::{Batch, Segment};
use caudata_learner::network::{ActorCritic, NetworkSpec};
use caudata_learner::normaliser::{Moments, Scaling};
use caudata_learner::ppo::{Ppo, PpoSettings};
use caudata_random::{Key, Purpose, Stream};
use caudata_task::Mirror;
use caudata_task::mirror::SignedPermutation;
use tch::{Device, Tensor};

fn stream(seed: u64, purpose: Purpose) -> Stream {
    Stream::new(Key { seed, actor: 0, env: 0, episode: 0 }, purpose)
}

fn learner(seed: u64, obs_dim: usize, act_dim: usize, ppo: PpoConfig) -> Ppo {
    learner_with(seed, obs_dim, act_dim, ppo, None)
}

fn learner_with(
    seed: u64,
    obs_dim: usize,
    act_dim: usize,
    ppo: PpoConfig,
    mirror: Option<Mirror>,
) -> Ppo {
    let network = NetworkConfig {
        policy_hidden: vec![32, 32],
        value_hidden: vec![32, 32],
        init_std: 0.5,
        std_min: 0.05,
        ..NetworkConfig::default()
    };
    let mut spec = NetworkSpec::new(&network, obs_dim, act_dim).unwrap();
    if let Some(mirror) = mirror {
        spec = spec.symmetric(mirror).unwrap();
    }
    let settings = PpoSettings { ppo, ..PpoSettings::new(&Config::default()) };
    Ppo::new(ActorCritic::new(spec, seed, Device::Cpu), settings, 1).unwrap()
}

/// Means `[n, A]` for raw observations, as an actor would compute them.
fn means(ppo: &Ppo, scaling: &Scaling, observations: &[f32], obs_dim: usize) -> Vec<f32> {
    let raw = Tensor::from_slice(observations).view([-1, obs_dim as i64]);
    Vec::try_from(ppo.net().policy().forward(&scaling.apply(&raw)).view([-1])).unwrap()
}

/// Actions around `means` and their log-probabilities.
fn explore(ppo: &Ppo, means: &[f32], noise: &mut Stream) -> (Vec<f32>, Vec<f32>) {
    let log_std: Vec<f32> = Vec::try_from(ppo.net().log_std()).unwrap();
    let act_dim = log_std.len();
    let (mut actions, mut log_probs) = (Vec::new(), Vec::new());
    for row in means.chunks_exact(act_dim) {
        let mut log_prob = 0.0;
        for (mean, log_std) in row.iter().zip(&log_std) {
            let z = noise.normal();
            actions.push(mean + z * log_std.exp());
            log_prob += -0.5 * z * z - log_std - 0.918_938_5;
        }
        log_probs.push(log_prob);
    }
    (actions, log_probs)
}

/// One-step problem: for a context s ∈ [−1, 1]², the reward is −‖a − (s₀ + s₁, s₀ − 0.5)‖². The best return
/// is 0; doing nothing earns −E[(s₀+s₁)² + (s₀−½)²] = −(⅔ + ⅓ + ¼) = −1.25.
fn bandit_return(ppo: &Ppo, scaling: &Scaling) -> f64 {
    let mut contexts = stream(99, Purpose::Reset);
    let observations: Vec<f32> = (0..2000).map(|_| contexts.uniform(-1.0, 1.0)).collect();
    let actions = means(ppo, scaling, &observations, 2);
    mean_bandit_reward(&observations, &actions)
}

fn bandit_rewards(observations: &[f32], actions: &[f32]) -> Vec<f32> {
    let pairs = observations.chunks_exact(2).zip(actions.chunks_exact(2));
    pairs.map(|(s, a)| -(a[0] - s[0] - s[1]).powi(2) - (a[1] - s[0] + 0.5).powi(2)).collect()
}

fn mean_bandit_reward(observations: &[f32], actions: &[f32]) -> f64 {
    let rewards = bandit_rewards(observations, actions);
    rewards.iter().map(|&r| f64::from(r)).sum::<f64>() / rewards.len() as f64
}

/// Episodes of one step, two actions each.
fn one_step_episodes(
    obs_dim: usize,
    observations: Vec<f32>,
    actions: Vec<f32>,
    behaviour_log_probs: Vec<f32>,
    rewards: Vec<f32>,
    policy_version: u64,
) -> Batch {
    let rows = rewards.len();
    Batch {
        obs_dim,
        act_dim: 2,
        rows,
        // Every step ends its episode, so the observations after the last step (zeros) do not matter.
        observations: [observations, vec![0.0; rows * obs_dim]].concat(),
        actions,
        action_means: Vec::new(),
        behaviour_log_probs,
        rewards,
        terminated: vec![true; rows],
        truncated: vec![false; rows],
        segments: vec![Segment {
            first_row: 0,
            steps: 1,
            lanes: rows,
            bootstrap_row: rows,
            finals: 0,
            policy_version,
        }],
        moments: Vec::new(),
    }
}

#[test]
fn what_is_learnt_on_one_side_holds_on_the_other() {
    // Contexts of the left side only, s ∈ [0, 1]: reward −(a₀ − s)² − (a₁ − 1 + s)². A world that is its own
    // mirror image asks on the other side, −s, for actions exchanged and negated: a₀ = −(1 − s), a₁ = −s. At
    // s = −¾ that is (−¼, −¾); a policy that only goes on in a straight line from what it saw says (−¾, 1¾).
    let flip = |source: &[usize]| SignedPermutation {
        source: source.to_vec(),
        sign: vec![-1.0; source.len()],
    };
    let mirror = Mirror { observation: flip(&[0]), action: flip(&[1, 0]), feet: Vec::new() };
    let found = [None, Some(mirror)].map(|mirror| {
        let with_mirror = mirror.is_some();
        let ppo_config = PpoConfig { gamma: 0.0, epochs: 2, ..PpoConfig::default() };
        let mut ppo = learner_with(1, 1, 2, ppo_config, mirror);
        let scaling = Scaling::identity(1, 10.0);
        let (mut noise, mut order) = (stream(1, Purpose::Action), stream(1, Purpose::Minibatch));
        for version in 0..100 {
            let contexts: Vec<f32> = (0..512).map(|_| noise.uniform(0.0, 1.0)).collect();
            let means = means(&ppo, &scaling, &contexts, 1);
            let (actions, log_probs) = explore(&ppo, &means, &mut noise);
            let pairs = contexts.iter().zip(actions.chunks_exact(2));
            let rewards = pairs.map(|(s, a)| -(a[0] - s).powi(2) - (a[1] - 1.0 + s).powi(2));
            let rewards = rewards.collect();
            let batch = one_step_episodes(1, contexts, actions, log_probs, rewards, version);
            ppo.update(&Arc::new(batch), &scaling, version, &mut order, false).unwrap();
        }
        let seen = means(&ppo, &scaling, &[0.75], 1);
        let off = (seen[0] - 0.75).abs().max((seen[1] - 0.25).abs());
        assert!(off < 0.1, "mirror {with_mirror}, seen side: {seen:?}");
        let unseen = means(&ppo, &scaling, &[-0.75], 1);
        (unseen[0] + 0.25).abs().max((unseen[1] + 0.75).abs())
    });
    assert!(found[0] > 0.5 && found[1] < 0.1, "{found:?}");
}

#[test]
fn a_contextual_bandit_is_solved_in_fifty_updates() {
    for seed in [1, 2] {
        let ppo_config = PpoConfig { gamma: 0.0, ..PpoConfig::default() };
        let mut ppo = learner(seed, 2, 2, ppo_config);
        let scaling = Scaling::identity(2, 10.0);
        let (mut noise, mut order) =
            (stream(seed, Purpose::Action), stream(seed, Purpose::Minibatch));
        let before = bandit_return(&ppo, &scaling);
        assert!((before + 1.25).abs() < 0.1, "an untrained policy does nothing: {before}");
        for version in 0..50 {
            let rows = 512;
            let observations: Vec<f32> = (0..rows * 2).map(|_| noise.uniform(-1.0, 1.0)).collect();
            let means = means(&ppo, &scaling, &observations, 2);
            let (actions, behaviour_log_probs) = explore(&ppo, &means, &mut noise);
            let rewards = bandit_rewards(&observations, &actions);
            let batch =
                one_step_episodes(2, observations, actions, behaviour_log_probs, rewards, version);
            ppo.update(&Arc::new(batch), &scaling, version, &mut order, false).unwrap();
        }
        let after = bandit_return(&ppo, &scaling);
        assert!(after > -0.02, "seed {seed}: {after}");
    }
}

/// A mass on a line: x' = x + v·dt, v' = v + a·dt, reward −(x² + 0.1·v² + 0.01·a²), 40 steps of 0.1 s. An
/// action costs at once and pays later, so that credit has to travel through time, across chunks and the time
/// limit.
struct PointMasses {
    x: Vec<f32>,
    v: Vec<f32>,
    age: Vec<usize>,
    start: Stream,
}

const DT: f32 = 0.1;
const LIMIT: usize = 40;

impl PointMasses {
    fn new(lanes: usize, seed: u64) -> Self {
        let mut world = Self {
            x: vec![0.0; lanes],
            v: vec![0.0; lanes],
            age: (0..lanes).map(|lane| lane % LIMIT).collect(),
            start: stream(seed, Purpose::Reset),
        };
        (0..lanes).for_each(|lane| world.place(lane));
        world
    }

    fn place(&mut self, lane: usize) {
        self.x[lane] = self.start.uniform(-1.0, 1.0);
        self.v[lane] = 0.0;
    }

    fn observations(&self) -> Vec<f32> {
        // Odd scales and an offset, for the normaliser to earn its keep.
        (0..self.x.len()).flat_map(|l| [100.0 + 20.0 * self.x[l], 0.1 * self.v[l]]).collect()
    }

    fn step(&mut self, lane: usize, a: f32) -> f32 {
        let reward = -(self.x[lane].powi(2) + 0.1 * self.v[lane].powi(2) + 0.01 * a * a);
        self.x[lane] += self.v[lane] * DT;
        self.v[lane] += a * DT;
        self.age[lane] += 1;
        reward
    }
}

/// Cost-to-go of the best linear feedback over `LIMIT` steps from (x, 0): Riccati's recursion on the 2×2
/// matrix [p, q; q, r] of the cost, and E[x²] = ⅓.
fn best_return() -> f64 {
    let dt = f64::from(DT);
    let (mut p, mut q, mut r) = (0.0, 0.0, 0.0);
    for _ in 0..LIMIT {
        // With next state (x + v·dt, v + a·dt): a = −k₀x − k₁v minimises 0.01a² + next cost.
        let denominator = 0.01 + r * dt * dt;
        let (k0, k1) = (q * dt / denominator, (q * dt * dt + r * dt) / denominator);
        // Cost of the quadratic after inserting a.
        let np = 1.0 + p - k0 * q * dt;
        let nq = p * dt + q - k0 * (q * dt + r) * dt;
        let nr = 0.1 + p * dt * dt + 2.0 * q * dt + r - k1 * (q * dt + r) * dt;
        (p, q, r) = (np, nq, nr);
    }
    -p / 3.0
}

fn point_mass_return(ppo: &Ppo, scaling: &Scaling) -> f64 {
    let lanes = 256;
    let mut world = PointMasses::new(lanes, 77);
    let mut sum = 0.0;
    for _ in 0..LIMIT {
        let actions = means(ppo, scaling, &world.observations(), 2);
        sum += (0..lanes).map(|lane| f64::from(world.step(lane, actions[lane]))).sum::<f64>();
    }
    sum / lanes as f64
}

/// Collects one batch and leaves the world where the next one begins.
fn collect(
    ppo: &Ppo,
    scaling: &Scaling,
    world: &mut PointMasses,
    noise: &mut Stream,
    version: u64,
) -> Batch {
    let (steps, lanes) = (16, world.x.len());
    let mut batch = Batch { obs_dim: 2, act_dim: 1, rows: steps * lanes, ..Batch::default() };
    let mut finals: Vec<f32> = Vec::new();
    for _ in 0..steps {
        let observations = world.observations();
        let (actions, log_probs) = explore(ppo, &means(ppo, scaling, &observations, 2), noise);
        batch.observations.extend(&observations);
        for lane in 0..lanes {
            batch.rewards.push(world.step(lane, actions[lane]));
        }
        let last = world.observations();
        for lane in 0..lanes {
            let cut = world.age[lane] >= LIMIT;
            batch.truncated.push(cut);
            if cut {
                finals.extend(&last[2 * lane..2 * lane + 2]);
                world.age[lane] = 0;
                world.place(lane);
            }
        }
        batch.actions.extend(actions);
        batch.behaviour_log_probs.extend(log_probs);
    }
    batch.terminated = vec![false; batch.rows];
    batch.moments = vec![Moments::of(&batch.observations, 2)];
    batch.observations.extend(world.observations());
    batch.segments.push(Segment {
        first_row: 0,
        steps,
        lanes,
        bootstrap_row: batch.rows,
        finals: finals.len() / 2,
        policy_version: version,
    });
    batch.observations.extend(finals);
    batch
}

#[test]
fn a_point_mass_is_steered_nearly_as_well_as_riccati_does() {
    let best = best_return();
    let config = PpoConfig { gamma: 0.98, minibatches: 4, ..PpoConfig::default() };
    let mut ppo = learner(3, 2, 1, config);
    let mut moments = Moments::new(2);
    let mut scaling = moments.scaling(10.0);
    let mut world = PointMasses::new(64, 3);
    let (mut noise, mut order) = (stream(3, Purpose::Action), stream(3, Purpose::Minibatch));
    let before = point_mass_return(&ppo, &scaling);
    for version in 0..80 {
        let batch = Arc::new(collect(&ppo, &scaling, &mut world, &mut noise, version));
        ppo.update(&batch, &scaling, version, &mut order, false).unwrap();
        batch.moments.iter().for_each(|m| moments.merge(m));
        scaling = moments.scaling(10.0);
    }
    let after = point_mass_return(&ppo, &scaling);
    // Doing nothing costs 40·⅓ = 13.3; the best feedback costs about a quarter of that.
    assert!(before < -12.0 && best > -4.0, "before {before}, best {best}");
    assert!(after > 1.15 * best, "after {after}, best {best}");
}
