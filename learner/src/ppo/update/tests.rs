//! Updates as a whole: determinism, guards, rules.

use super::*;
use crate::batch::Segment;
use crate::network::NetworkSpec;
use caudata_config::{Activation, AdvantageScale, NetworkConfig, Returns};
use caudata_policy::{Dense, MlpSpec};
use caudata_random::{Key, Purpose};
use tch::Device;

fn stream(purpose: Purpose) -> Stream {
    Stream::new(Key { seed: 5, actor: 0, env: 0, episode: 0 }, purpose)
}

const OBS: usize = 6;
const ACT: usize = 2;

fn ppo(change: impl FnOnce(&mut PpoSettings), threads: usize) -> Ppo {
    let config = NetworkConfig {
        policy_hidden: vec![16, 16],
        value_hidden: vec![16],
        ..NetworkConfig::default()
    };
    let spec = NetworkSpec::new(&config, OBS, ACT).unwrap();
    let mut settings = PpoSettings::new(&caudata_config::Config::default());
    change(&mut settings);
    Ppo::new(ActorCritic::new(spec, 1, Device::Cpu), settings, threads).unwrap()
}

/// Two chunks of `steps × lanes`, of version 0, with noise in place of a world.
fn batch(steps: usize, lanes: usize) -> Batch {
    let mut noise = stream(Purpose::Sensor);
    let (cells, chunks) = (steps * lanes, 2);
    let rows = chunks * cells;
    let extra = chunks * lanes + 1;
    let mut draw = |n: usize| (0..n).map(|_| noise.normal()).collect::<Vec<f32>>();
    let mut batch = Batch {
        obs_dim: OBS,
        act_dim: ACT,
        rows,
        observations: draw((rows + extra) * OBS),
        actions: draw(rows * ACT),
        action_means: Vec::new(),
        behaviour_log_probs: draw(rows).iter().map(|x| -2.5 + x).collect(),
        rewards: draw(rows),
        terminated: vec![false; rows],
        truncated: vec![false; rows],
        segments: Vec::new(),
        moments: Vec::new(),
    };
    // One truncated step in the second chunk; its final observation is the last row.
    batch.truncated[cells + 1] = true;
    batch.terminated[0] = true;
    for chunk in 0..chunks {
        batch.segments.push(Segment {
            first_row: chunk * cells,
            steps,
            lanes,
            bootstrap_row: rows + chunk * lanes,
            finals: chunk,
            policy_version: 0,
        });
    }
    batch
}

fn scaling() -> Scaling {
    Scaling::identity(OBS, 10.0)
}

fn update(ppo: &mut Ppo, batch: &Batch, version: u64) -> UpdateStats {
    ppo.update(
        &Arc::new(batch.clone()),
        &scaling(),
        version,
        &mut stream(Purpose::Minibatch),
        false,
    )
    .unwrap()
}

#[test]
fn the_bits_do_not_depend_on_the_number_of_threads() {
    let batch = batch(30, 40); // 2,400 samples: minibatches of 600 make two shards
    let mut results = Vec::new();
    for threads in [1, 2, 3] {
        let mut ppo = ppo(|_| {}, threads);
        let stats = update(&mut ppo, &batch, 0);
        results.push((ppo.net().to_vec().unwrap(), stats));
    }
    assert_eq!(results[0].1.updates, 16);
    assert_eq!(results[0], results[1]);
    assert_eq!(results[0], results[2]);
}

#[test]
fn a_teachers_actions_are_learnt_until_it_is_gone() {
    let batch = batch(8, 8);
    let weight = (0..ACT * 3).map(|i| 0.3 * i as f32 - 0.7).collect();
    let spec = MlpSpec {
        obs_mean: vec![0.0; 3],
        obs_std: vec![1.0; 3],
        obs_clip: None,
        layers: vec![Dense { out: ACT, input: 3, weight, bias: vec![0.4; ACT] }],
        activation: Activation::Tanh,
    };
    let lesson = |settings: &mut PpoSettings| {
        settings.ppo.target_kl = 0.0; // as fast at the end as at the beginning
        settings.teacher.weight = 10.0;
        settings.teacher.gone_after_env_steps = 1_000_000;
    };
    let mut ppo = ppo(lesson, 1);
    assert_eq!(update(&mut ppo, &batch, 0).teacher_loss, 0.0);
    ppo.learn_from(Teacher::new(&spec, vec![0, 2, 5]));
    let first = update(&mut ppo, &batch, 0).teacher_loss;
    let last = (0..100).map(|_| update(&mut ppo, &batch, 0).teacher_loss).last().unwrap();
    assert!(first > 0.1 && last < 0.1 * first, "{first} {last}");
    ppo.set_progress(1_000_000);
    assert_eq!(update(&mut ppo, &batch, 0).teacher_loss, 0.0);
}

#[test]
fn poison_changes_nothing_and_is_counted() {
    let mut poisoned = batch(8, 8);
    poisoned.rewards[3] = f32::NAN;
    let mut ppo = ppo(|_| {}, 1);
    let before = ppo.net().to_vec().unwrap();
    let stats = update(&mut ppo, &poisoned, 0);
    // The advantages are scaled over the batch, so that the poison is in every minibatch.
    assert_eq!((stats.updates, stats.skipped), (0, 16));
    assert_eq!(ppo.net().to_vec().unwrap(), before);
    let clean = update(&mut ppo, &batch(8, 8), 0);
    assert_eq!((clean.updates, clean.skipped), (16, 0));
    assert!(clean.surrogate.is_finite() && clean.value_loss.is_finite());
}

#[test]
fn poison_stays_in_its_own_minibatch() {
    let mut poisoned = batch(8, 8);
    poisoned.actions[0] = f32::INFINITY;
    let mut ppo = ppo(|s| s.ppo.advantage_scale = AdvantageScale::None, 1);
    let stats = update(&mut ppo, &poisoned, 0);
    // One of four minibatches per epoch holds the sample.
    assert_eq!((stats.updates, stats.skipped), (12, 4));
    assert!(ppo.net().to_vec().unwrap().iter().all(|x| x.is_finite()));
}

#[test]
fn stale_data_with_wild_weights_halves_the_step() {
    // One epoch, one minibatch, one Adam step from rest: its size is the learning rate.
    let one_step = |guard: f64, version: u64| {
        let mut ppo = ppo(
            |s| {
                (s.ppo.epochs, s.ppo.minibatches, s.ppo.target_kl) = (1, 1, 0.0);
                (s.staleness.min_effective_share, s.staleness.weight_max) = (guard, 100.0);
            },
            1,
        );
        let before = ppo.net().flat().copy();
        let stats = update(&mut ppo, &batch(8, 8), version);
        ((ppo.net().flat() - before).abs().max().double_value(&[]), stats.effective_share)
    };
    let (fresh, share) = one_step(0.9, 0);
    assert_eq!(share, 1.0, "the version that acted is the current one");
    let (unguarded, share) = one_step(0.0, 1);
    assert!(share < 0.9, "{share}");
    let (guarded, _) = one_step(0.9, 1);
    assert!((fresh - 1e-3).abs() < 1e-5 && (unguarded - 1e-3).abs() < 1e-5);
    assert!((guarded - 0.5e-3).abs() < 1e-5);
}

fn targets_of(
    ppo: &Ppo,
    batch: &Batch,
    values: &[f32],
    log_probs: &[f32],
    version: u64,
) -> Targets {
    let PpoSettings { ppo, staleness, .. } = &ppo.settings;
    Targets::new(ppo, staleness, batch, values, log_probs, version)
}

#[test]
fn older_data_has_the_returns_of_fresh_data_unless_v_trace_is_asked_for() {
    let batch = batch(8, 8);
    let values = vec![0.5; batch.observations.len() / OBS];
    let prox_log_probs = vec![-2.5; batch.rows];
    let targets = |returns: Returns, version: u64| {
        let ppo = ppo(
            |s| {
                s.ppo.advantage_scale = AdvantageScale::None;
                s.staleness.returns = returns;
            },
            1,
        );
        targets_of(&ppo, &batch, &values, &prox_log_probs, version)
    };
    let fresh = targets(Returns::Gae, 0);
    assert!(fresh.weights.iter().all(|&w| w == 1.0));
    let stale = targets(Returns::Gae, 1);
    assert_eq!((&stale.advantages, &stale.targets), (&fresh.advantages, &fresh.targets));
    assert!(stale.weights.iter().any(|&w| w < 0.5), "the loss weighs it by its age all the same");
    let capped = {
        let ppo = ppo(
            |s| {
                s.ppo.advantage_scale = AdvantageScale::None;
                (s.staleness.rho_max, s.staleness.c_max) = (0.1, 0.1);
            },
            1,
        );
        targets_of(&ppo, &batch, &values, &prox_log_probs, 1)
    };
    assert_eq!(capped.targets, fresh.targets, "caps are V-trace's");
    // Fresh data has ratios of 1, with which V-trace is GAE; older data has not.
    assert_eq!(targets(Returns::Vtrace, 0).targets, fresh.targets);
    assert_ne!(targets(Returns::Vtrace, 1).targets, fresh.targets);
}

#[test]
fn the_rate_follows_the_divergence() {
    let config = PpoConfig { target_kl: 0.01, ..PpoConfig::default() };
    assert_eq!(adapted_rate(&config, config.target_kl, 3e-3, 0.021), 2e-3);
    assert_eq!(adapted_rate(&config, config.target_kl, 2e-3, 0.004), 3e-3);
    assert_eq!(adapted_rate(&config, config.target_kl, 2e-3, 0.01), 2e-3);
    assert_eq!(adapted_rate(&config, config.target_kl, 2e-3, 0.0), 2e-3, "nothing has changed yet");
    assert_eq!(adapted_rate(&config, config.target_kl, 1.2e-5, 1.0), config.learning_rate_min);
    assert_eq!(adapted_rate(&config, config.target_kl, 9e-3, 0.001), config.learning_rate_max);
    let fixed = PpoConfig { target_kl: 0.0, ..config };
    assert_eq!(adapted_rate(&fixed, fixed.target_kl, 2e-3, 5.0), 2e-3);
}

#[test]
fn the_target_falls_evenly_in_its_logarithm() {
    let config = PpoConfig {
        target_kl: 0.01,
        target_kl_final: 0.0001,
        target_kl_final_after_env_steps: 1000,
        ..PpoConfig::default()
    };
    for (steps, target) in [(0, 0.01), (500, 0.001), (1000, 0.0001), (5000, 0.0001)] {
        let found = config.target_kl_after(steps);
        assert!((found / target - 1.0).abs() < 1e-9, "{found} after {steps}");
    }
    assert_eq!(PpoConfig::default().target_kl_after(1_000_000), 0.01);
}

#[test]
fn shares_and_parts_by_hand() {
    assert_eq!(effective_share(&[1.0; 4]), 1.0);
    // (2)²/(4·4) and (1+2)²/(2·5).
    assert_eq!(effective_share(&[2.0, 0.0, 0.0, 0.0]), 0.25);
    assert_eq!(effective_share(&[1.0, 2.0]), 0.9);
    assert_eq!(explained_variance(&[1.0, 2.0, 3.0], &[1.0, 2.0, 3.0]), 1.0);
    assert_eq!(explained_variance(&[0.0, 0.0], &[1.0, 3.0]), 0.0);
    let ppo = ppo(|s| s.ppo.minibatches = 4, 1);
    assert_eq!(ppo.minibatches(10), [(0, 2), (2, 3), (5, 2), (7, 3)]);
    assert_eq!(ppo.minibatches(2), [(0, 1), (1, 1)]);
}

#[test]
fn a_batch_of_another_size_is_refused() {
    let mut wrong = batch(2, 2);
    wrong.obs_dim = 3;
    let error = ppo(|_| {}, 1)
        .update(&Arc::new(wrong), &scaling(), 0, &mut stream(Purpose::Minibatch), false)
        .unwrap_err();
    assert!(error.to_string().contains("3 observations"), "{error}");
}

#[test]
fn a_critic_alone_learns_while_the_policy_and_its_rate_stay() {
    let batch = batch(8, 8);
    let mut ppo = ppo(|_| {}, 1);
    let (before, rate) = (ppo.net().to_vec().unwrap(), ppo.learning_rate);
    let order = &mut stream(Purpose::Minibatch);
    ppo.update(&Arc::new(batch), &scaling(), 0, order, true).unwrap();
    let after = ppo.net().to_vec().unwrap();
    let policy = ppo.net().policy_len();
    assert_eq!(before[..policy], after[..policy]);
    assert_ne!(before[policy..], after[policy..]);
    assert_eq!(ppo.learning_rate, rate);
}

#[test]
fn the_critic_has_its_own_rate() {
    // One epoch, one minibatch, from rest: Adam's first step has the size of the rate wherever there is a
    // gradient.
    let largest = |value_rate: f64| {
        let mut ppo = ppo(
            |s| {
                (s.ppo.epochs, s.ppo.minibatches, s.ppo.target_kl) = (1, 1, 0.0);
                (s.ppo.learning_rate, s.ppo.value_learning_rate) = (1e-4, value_rate);
            },
            1,
        );
        let before = ppo.net().to_vec().unwrap();
        let _ = update(&mut ppo, &batch(8, 8), 0);
        let after = ppo.net().to_vec().unwrap();
        let policy = ppo.net().policy_len();
        let change: Vec<f32> = before.iter().zip(&after).map(|(b, a)| (a - b).abs()).collect();
        let max = |part: &[f32]| part.iter().copied().fold(0.0, f32::max);
        (max(&change[..policy]), max(&change[policy..]))
    };
    let near = |found: f32, expected: f32| (found / expected - 1.0).abs() < 0.01;
    let (policy, value) = largest(0.0);
    assert!(near(policy, 1e-4) && near(value, 1e-4), "{policy} {value}");
    let (policy, value) = largest(1e-2);
    assert!(near(policy, 1e-4) && near(value, 1e-2), "{policy} {value}");
}
