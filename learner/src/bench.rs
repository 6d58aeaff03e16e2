//! How fast the update is on this machine, beside what libtorch's matrix product reaches in the same run.
//!
//! The batch is noise in the shape of the configuration: the time of an update does not depend on what is in
//! it.

use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_config::Config;
use caudata_random::{Key, Purpose, Stream};
use serde::Serialize;
use tch::{Device, Kind, Tensor};

use crate::LearnerError;
use crate::batch::{Batch, Segment};
use crate::network::{ActorCritic, NetworkSpec};
use crate::normaliser::Scaling;
use crate::ppo::{Ppo, PpoSettings, SHARD_ROWS};
use crate::task::Task;

/// Side of the large square matrices whose product is the machine's ceiling.
const LARGE: i64 = 1024;
/// Measured updates at most, whatever the time allows.
const ROUNDS_MAX: usize = 10_000;

/// What one number of threads reaches.
#[derive(Clone, Debug, Serialize)]
pub struct LearnerSpeed {
    /// Threads of the update.
    pub threads: usize,
    /// Environment steps learnt from per second, all epochs of them.
    pub samples_per_s: f64,
    /// Median time of an update, s.
    pub update_median_s: f64,
    /// Arithmetic of the networks (forward and backward, multiply and add counted apart), 10⁹/s.
    pub gflops: f64,
    /// The same for products of the networks' own largest hidden layer, one shard at a time on each thread.
    pub ceiling_same_shape_gflops: f64,
    /// The same for products of square matrices of 1024.
    pub ceiling_large_gflops: f64,
}

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct LearnerBench {
    /// Always `learner`.
    pub benchmark: &'static str,
    /// Environment steps of one update.
    pub batch_rows: usize,
    /// Passes over them.
    pub epochs: u32,
    /// Hidden layers of the policy.
    pub policy_hidden: Vec<u32>,
    /// Hidden layers of the value function.
    pub value_hidden: Vec<u32>,
    /// By number of threads: one, and as many as configured where that is more.
    pub speeds: Vec<LearnerSpeed>,
}

/// Measures for about `seconds` per number of threads.
///
/// # Errors
/// When the configuration does not fit the robot, or libtorch refuses.
pub fn bench(config: &Config, seconds: f64) -> Result<LearnerBench, LearnerError> {
    let Task { networks: spec, .. } = Task::new(config)?;
    let network = &config.learner.network;
    tch::set_num_threads(1);
    let batch = Arc::new(noise(config, &spec));
    let settings = PpoSettings::new(config);
    let mut thread_counts = vec![1, config.learner.threads as usize];
    thread_counts.dedup();
    let net = || ActorCritic::new(spec.clone(), 1, Device::Cpu);
    let mut speeds = Vec::new();
    for &threads in &thread_counts {
        let ppo = Ppo::new(net(), settings.clone(), threads)?;
        speeds.push(speed(ppo, &spec, &batch, threads, seconds)?);
    }
    Ok(LearnerBench {
        benchmark: "learner",
        batch_rows: batch.rows,
        epochs: config.learner.ppo.epochs,
        policy_hidden: network.policy_hidden.clone(),
        value_hidden: network.value_hidden.clone(),
        speeds,
    })
}

fn stream(purpose: Purpose) -> Stream {
    Stream::new(Key::for_run(1), purpose)
}

/// One chunk per actor and version, as many as an iteration has.
fn noise(config: &Config, spec: &NetworkSpec) -> Batch {
    let actors = &config.actors;
    let (steps, lanes) = (actors.chunk_steps as usize, actors.lanes as usize);
    let chunks = (actors.count * actors.chunks_per_version) as usize;
    let (cells, rows) = (steps * lanes, steps * lanes * chunks);
    let mut stream = stream(Purpose::Sensor);
    let mut draw = |n: usize| (0..n).map(|_| stream.normal()).collect::<Vec<f32>>();
    Batch {
        obs_dim: spec.seen_dim(),
        act_dim: spec.act_dim,
        rows,
        observations: draw((rows + chunks * lanes) * spec.seen_dim()),
        actions: draw(rows * spec.act_dim),
        action_means: Vec::new(),
        behaviour_log_probs: draw(rows),
        rewards: draw(rows),
        terminated: vec![false; rows],
        truncated: vec![false; rows],
        segments: (0..chunks)
            .map(|chunk| Segment {
                first_row: chunk * cells,
                steps,
                lanes,
                bootstrap_row: rows + chunk * lanes,
                finals: 0,
                policy_version: 0,
            })
            .collect(),
        moments: Vec::new(),
    }
}

fn speed(
    mut ppo: Ppo,
    spec: &NetworkSpec,
    batch: &Arc<Batch>,
    threads: usize,
    seconds: f64,
) -> Result<LearnerSpeed, LearnerError> {
    let epochs = ppo.settings().ppo.epochs;
    let scaling = Scaling::identity(spec.seen_dim(), 10.0);
    let mut order = stream(Purpose::Minibatch);
    let mut update = || ppo.update(batch, &scaling, 0, &mut order, false);
    update()?;
    let until = Instant::now() + Duration::from_secs_f64(seconds);
    let mut times = Vec::new();
    while times.is_empty() || (Instant::now() < until && times.len() < ROUNDS_MAX) {
        let began = Instant::now();
        update()?;
        times.push(began.elapsed().as_secs_f64());
    }
    times.sort_unstable_by(f64::total_cmp);
    let median_s = times[times.len() / 2];
    let flops = flops_per_update(spec, batch.rows, epochs);
    let width = spec.policy_hidden.iter().copied().max().unwrap_or(1) as i64;
    let share = seconds / 4.0;
    Ok(LearnerSpeed {
        threads,
        samples_per_s: batch.rows as f64 / median_s,
        update_median_s: median_s,
        gflops: flops / median_s / 1e9,
        ceiling_same_shape_gflops: ceiling(threads, [SHARD_ROWS as i64, width, width], share),
        ceiling_large_gflops: ceiling(threads, [LARGE; 3], share),
    })
}

/// Multiplications and additions of the dense layers: one forward pass before the epochs; in each epoch
/// forward, gradients of the weights, and gradients of the inputs of all layers but the first. Activations,
/// loss and optimiser are not counted.
fn flops_per_update(spec: &NetworkSpec, rows: usize, epochs: u32) -> f64 {
    let products = |sizes: &[usize]| -> (usize, usize) {
        let all = sizes.windows(2).map(|pair| pair[0] * pair[1]).sum();
        (all, sizes[0] * sizes[1])
    };
    let (policy, policy_first) = products(&spec.policy_sizes());
    let (value, value_first) = products(&spec.value_sizes());
    let (all, first) = (policy + value, policy_first + value_first);
    2.0 * rows as f64 * (all as f64 + f64::from(epochs) * (3 * all - first) as f64)
}

/// Best rate of products `[m, k] × [k, n]` on each of `threads` threads at once, 10⁹ operations/s in all.
fn ceiling(threads: usize, [m, k, n]: [i64; 3], seconds: f64) -> f64 {
    let one = move || {
        let _no_grad = tch::no_grad_guard();
        let options = (Kind::Float, Device::Cpu);
        let (a, b) = (Tensor::ones([m, k], options), Tensor::ones([k, n], options));
        let out = Tensor::zeros([m, n], options);
        let began = Instant::now();
        let mut rounds = 0_u64;
        while began.elapsed().as_secs_f64() < seconds {
            for _ in 0..8 {
                let _ = a.linalg_matmul_out(&out, &b);
            }
            rounds += 8;
        }
        2.0 * (m * k * n) as f64 * rounds as f64 / began.elapsed().as_secs_f64() / 1e9
    };
    let others: Vec<_> = (1..threads).map(|_| std::thread::spawn(one)).collect();
    let own = one();
    own + others
        .into_iter()
        .map(|thread| thread.join().unwrap_or(0.0))
        .sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_config::Activation;

    #[test]
    fn arithmetic_is_counted_as_by_hand() {
        // Policy 3→2→1: 6 + 2 = 8, its first layer 6; value 3→1→1: 3 + 1 = 4, first 3. One pass forward, two
        // epochs: 2·10·(12 + 2·(36 − 9)) = 1320.
        let spec = NetworkSpec {
            obs_dim: 3,
            critic: caudata_task::mirror::SignedPermutation::identity(0),
            act_dim: 1,
            policy_hidden: vec![2],
            value_hidden: vec![1],
            activation: Activation::Elu,
            init_std: 0.3,
            std_min: 0.05,
            std_max: 1.0,
            mirror: None,
        };
        assert_eq!(flops_per_update(&spec, 10, 2), 1320.0);
    }

    #[test]
    fn a_short_run_gives_figures() {
        let mut config = Config::default();
        config.actors.lanes = 8;
        config.learner.network.policy_hidden = vec![16];
        config.learner.network.value_hidden = vec![16];
        config.learner.threads = 2;
        let found = bench(&config, 0.01).unwrap();
        assert_eq!(found.batch_rows, 2 * 8 * 24);
        assert_eq!(found.speeds.len(), 2);
        for speed in found.speeds {
            assert!(speed.samples_per_s > 0.0 && speed.gflops > 0.0);
            assert!(speed.ceiling_same_shape_gflops > 0.0 && speed.ceiling_large_gflops > 0.0);
        }
    }
}
