//! Runs a policy through scenarios.

use std::sync::Arc;

use caudata_actor::build_env;
use caudata_config::Config;
use caudata_env::VecEnv;
use caudata_model::RobotModel;
use caudata_policy::{Inference, PolicyFile};

use crate::gait::{Gait, Measure};
use crate::result::Episode;
use crate::{
    EvaluationError, Frame, GateReport, Limits, Scenario, ScenarioResult, Suite, SuiteResult, Trace,
};

/// Environments stepped together.
const LANES_MAX: u32 = 256;
/// Actor number in the keys of the evaluation's random streams: no actor of a training run has it, so that the episodes are new to
/// the policy.
const EVALUATION_KEY: u64 = u64::MAX;

/// How to evaluate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Episodes of each scenario, at least one per command.
    pub episodes: u32,
    /// Length of an episode, s.
    pub episode_s: f64,
    /// Time left out at its start, s.
    pub settle_s: f64,
    /// Seed of the episodes and the terrain.
    pub seed: u64,
    /// What counts as walking.
    pub limits: Limits,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            episodes: 256,
            episode_s: 20.0,
            settle_s: 2.0,
            seed: 1,
            limits: Limits::default(),
        }
    }
}

/// Runs all scenarios of a suite. `config` is the one that the policy was trained with: robot, engine, action and observation come
/// from it. `go_on` is asked before every control step; `done` is told about every scenario.
///
/// # Errors
/// When the policy does not fit the robot, the simulation cannot be built, or `go_on` says no.
pub fn run_suite(
    config: &Config,
    model: &Arc<RobotModel>,
    policy: &PolicyFile,
    suite: Suite,
    settings: &Settings,
    go_on: &dyn Fn() -> bool,
    done: &mut dyn FnMut(&ScenarioResult),
) -> Result<SuiteResult, EvaluationError> {
    let mut scenarios = Vec::new();
    for scenario in suite.scenarios(model.total_mass_kg()) {
        let (result, _) = run_scenario(config, model, policy, &scenario, settings, go_on)?;
        done(&result);
        scenarios.push(result);
    }
    Ok(SuiteResult {
        suite,
        engine: config.engine.kind.name(),
        policy_version: policy.metadata().version,
        policy_sha256: policy.sha256_hex(),
        scenarios,
    })
}

/// Runs one scenario, and gives its traces with it, one per episode.
///
/// # Errors
/// As [`run_suite`].
pub fn run_scenario(
    config: &Config,
    model: &Arc<RobotModel>,
    policy: &PolicyFile,
    scenario: &Scenario,
    settings: &Settings,
    go_on: &dyn Fn() -> bool,
) -> Result<(ScenarioResult, Vec<Trace>), EvaluationError> {
    let commands = scenario.commands.len().max(1);
    let episodes = (settings.episodes as usize).next_multiple_of(commands);
    let config = under(config, scenario, settings, episodes as u32);
    let mut env = build_env(&config, Arc::clone(model), EVALUATION_KEY)?;
    policy
        .check_runs_on(env.contract())
        .map_err(EvaluationError::Refused)?;
    let mut inference = Inference::new(policy, 1).map_err(EvaluationError::Inference)?;
    let lanes = env.lanes();
    let mut all = Vec::with_capacity(episodes);
    let mut commanded = Vec::with_capacity(episodes);
    while all.len() < episodes {
        let first = all.len();
        let command = |lane: usize| scenario.commands[(first + lane) % commands];
        let round: Vec<[f32; 3]> = (0..lanes).map(command).collect();
        env.reset_all()?;
        env.hold_commands(&round)?;
        all.extend(run_round(&mut env, &mut inference, &round, go_on)?);
        commanded.extend(round);
    }
    all.truncate(episodes);
    let measure = Measure {
        settle_s: settings.settle_s,
        contact_force_n: f64::from(config.task.reward.contact_force_n),
        trunk_force_n: f64::from(config.task.reward.contact_force_n),
        mass_kg: model.total_mass_kg(),
    };
    let measured: Vec<Episode> = all
        .iter()
        .zip(commanded)
        .map(|(trace, command)| Episode {
            command,
            fell: trace.fell,
            gait: Gait::of(trace, &measure),
        })
        .collect();
    let gates = scenario
        .judged
        .then(|| judge(&measured, scenario, &settings.limits));
    Ok((ScenarioResult::of(&scenario.name, &measured, gates), all))
}

fn judge(episodes: &[Episode], scenario: &Scenario, limits: &Limits) -> GateReport {
    let mut limits = *limits;
    if !scenario.is_flat() {
        limits.trunk_contact_share = None;
    }
    let gaits: Vec<Gait> = episodes.iter().filter_map(|e| e.gait.clone()).collect();
    GateReport::of(&gaits, &limits)
}

/// The training configuration under the scenario's conditions.
fn under(config: &Config, scenario: &Scenario, settings: &Settings, episodes: u32) -> Config {
    let mut config = config.clone();
    config.run.seed = settings.seed;
    config.actors.lanes = episodes.clamp(1, LANES_MAX);
    config.actors.threads = std::thread::available_parallelism()
        .map_or(1, |n| n.get() as u32)
        .min(config.actors.lanes);
    config.terrain = scenario.terrain.clone();
    let task = &mut config.task;
    task.stagger_first_episode = false;
    task.episode_steps = (settings.episode_s / task.control_period_s).round() as u32;
    task.randomisation = scenario.corner.randomisation();
    task.reset.spawn_half_extent_m = scenario.spawn_half_extent_m;
    task.push.enabled = false;
    if let Some(push) = scenario.push {
        task.push = push;
    }
    config
}

/// One episode per lane.
fn run_round(
    env: &mut VecEnv,
    inference: &mut Inference,
    commands: &[[f32; 3]],
    go_on: &dyn Fn() -> bool,
) -> Result<Vec<Trace>, EvaluationError> {
    let lanes = env.lanes();
    let mut traces: Vec<Trace> = (0..lanes)
        .map(|lane| Trace {
            period_s: env.task().control_period_s,
            clock_hz: f64::from(env.stride_frequency_hz(lane)),
            ..Trace::default()
        })
        .collect();
    let mut running = vec![true; lanes];
    let mut actions = vec![0.0; lanes * env.act_dim()];
    while running.contains(&true) {
        if !go_on() {
            return Err(EvaluationError::Stopped);
        }
        inference
            .run(env.observations(), lanes, &mut actions)
            .map_err(EvaluationError::Inference)?;
        let output = env.step(&actions)?;
        for episode in &output.episodes {
            let lane = episode.lane as usize;
            if running[lane] {
                running[lane] = false;
                traces[lane].fell = episode.reason.map(|reason| reason.name());
            }
        }
        for lane in (0..lanes).filter(|&lane| running[lane]) {
            traces[lane]
                .frames
                .push(Frame::read(env, lane, commands[lane]));
        }
    }
    Ok(traces)
}
