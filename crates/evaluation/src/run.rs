//! Runs a policy through scenarios.

use std::sync::Arc;

use caudata_actor::{ActorError, build_env};
use caudata_config::{Config, GatesConfig};
use caudata_declare::settings;
use caudata_env::StartShift;
use caudata_model::RobotModel;
use caudata_policy::{Inference, PolicyFile};
use caudata_sim::{Terrain, TerrainConfig};

use crate::anatomy::Anatomy;
use crate::block::{Block, Round, run_blocks};
use crate::gait::Measure;
use crate::posture::PostureResult;
use crate::result::Episode;
use crate::righting::RightingResult;
use crate::scenario::Goal;
use crate::transition::{Shore, TransitionResult};
use crate::wave::WaveResult;
use crate::{
    Envelope, Estimate, EvaluationError, Film, GateReport, Scenario, ScenarioResult, Track,
};

/// Actor number in the keys of the evaluation's random streams, less the number of the block: no actor of a
/// training run has it, so that the episodes are new to the policy.
const EVALUATION_KEY: u64 = u64::MAX;

settings! {
    /// How to evaluate.
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct Settings {
        /// Episodes of each scenario, at least one per command.
        pub episodes: u32 = 256,
        /// Length of an episode, s, where the scenario has none of its own.
        pub episode_s: f64 = 20.0,
        /// Time left out at its start, s.
        pub settle_s: f64 = 2.0,
        /// Seed of the episodes and the terrain.
        pub seed: u64 = 1,
        /// Whether to keep what reports show: velocities of every episode, everything of one.
        pub film: bool,
    }
}

/// A scenario, run.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The figures.
    pub result: ScenarioResult,
    /// Where it was.
    pub terrain: Terrain,
    /// What that was drawn from.
    pub terrain_config: TerrainConfig,
    /// Time between two frames, s.
    pub period_s: f64,
    /// How many commands the episodes follow in turn.
    pub commands: usize,
    /// Velocities of every episode; empty unless filmed.
    pub tracks: Vec<Track>,
    /// The episode that the scenario wants shown, if filmed.
    pub film: Option<Film>,
}

/// Runs one scenario. `config` is the one that the policy was trained with: robot, engine, action and
/// observation come from it. `go_on` is asked before every control step.
///
/// # Errors
/// When the policy does not fit the robot, the simulation cannot be built, or `go_on` says no.
pub fn run_scenario(
    config: &Config,
    model: &Arc<RobotModel>,
    policy: &PolicyFile,
    scenario: &Scenario,
    settings: &Settings,
    go_on: &(dyn Fn() -> bool + Sync),
) -> Result<Outcome, EvaluationError> {
    let commands = scenario.commands.len().max(1);
    let episodes = (settings.episodes as usize).next_multiple_of(commands);
    let terrain = Terrain::generate(&scenario.terrain, settings.seed)
        .map_err(|error| ActorError::Env(error.into()))?;
    let config = conditions(config, scenario, settings, terrain.water_level_m);
    let shore = scenario.goal.and_then(|goal| Shore::of(&terrain, goal));
    let measure = Measure {
        settle_s: settings.settle_s,
        contact_force_n: f64::from(config.task.reward.contact_force_n),
        trunk_force_n: f64::from(config.task.reward.contact_force_n),
        mass_kg: model.total_mass_kg(),
        anatomy: Anatomy::of(model),
        vibration_hz: config.evaluation.gates.vibration_hz,
        envelopes: Envelope::of_each(model),
    };
    let run = |block: Block| -> Result<Round, EvaluationError> {
        let mut config = config.clone();
        config.actors.lanes = block.lanes as u32;
        config.actors.threads = 1;
        let key = EVALUATION_KEY - block.number as u64;
        let mut env = build_env(&config, Arc::clone(model), key)?;
        policy.check_runs_on(env.contract()).map_err(EvaluationError::Refused)?;
        let held: Vec<[f32; 3]> = (block.first..block.first + block.lanes)
            .map(|episode| scenario.commands[episode % commands])
            .collect();
        env.hold_commands(&held)?;
        env.shift_starts(StartShift {
            xy_m: scenario.start.xy_m,
            yaw_rad: scenario.start.yaw_rad,
        })?;
        let mut inference = Inference::new(policy, 1).map_err(EvaluationError::Inference)?;
        let filmed = scenario.film.filter(|_| settings.film);
        let round = Round::run(&mut env, &mut inference, scenario, block, filmed, go_on)?;
        Ok(round.measured(&measure, shore.as_ref(), settings.film))
    };
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let rounds = run_blocks(episodes, threads, &run)?;

    let (mut measured, mut tracks, mut film) = (Vec::new(), Vec::new(), None);
    for round in rounds {
        measured.extend(round.episodes);
        tracks.extend(round.tracks);
        film = film.or(round.film);
    }
    let gates = scenario.judged.then(|| judge(&measured, scenario, &config.evaluation.gates));
    let mut result = ScenarioResult::of(&scenario.name, model.feet().len(), &measured, gates);
    what_it_is_about(&mut result, scenario, &measured, shore.is_some());
    let gaits = measured.iter().filter_map(|e| e.gait.as_ref());
    let postures: Vec<_> = gaits.map(|g| &g.posture).collect();
    result.posture = PostureResult::of(&postures, &measure.anatomy);
    Ok(Outcome {
        result,
        terrain,
        terrain_config: scenario.terrain.clone(),
        period_s: config.task.control_period_s,
        commands,
        tracks,
        film,
    })
}

/// Figures that only some scenarios have.
fn what_it_is_about(
    result: &mut ScenarioResult,
    scenario: &Scenario,
    measured: &[Episode],
    at_shore: bool,
) {
    let passages: Vec<_> = measured.iter().filter_map(|e| e.passage).collect();
    result.transition = at_shore.then(|| TransitionResult::of(&passages));
    result.arrived = (scenario.goal == Some(Goal::Ahead)).then(|| {
        let arrived = measured.iter().filter(|e| e.arrived()).count();
        Estimate::share(arrived, measured.len())
    });
    result.righting = scenario.fallen.then(|| {
        let times: Vec<_> = measured.iter().map(|e| e.righted_s).collect();
        RightingResult::of(&times)
    });
    let waves: Vec<_> = measured.iter().filter_map(|e| e.wave).collect();
    result.wave = WaveResult::of(&waves);
}

fn judge(episodes: &[Episode], scenario: &Scenario, limits: &GatesConfig) -> GateReport {
    let gaits: Vec<_> = episodes.iter().filter_map(|e| e.gait.clone()).collect();
    GateReport::of(&gaits, limits, scenario.is_flat())
}

/// The training configuration under the scenario's conditions; `surface_m` is the height of the water, if
/// there is any.
pub fn conditions(
    config: &Config,
    scenario: &Scenario,
    settings: &Settings,
    surface_m: Option<f32>,
) -> Config {
    /// Room above the water for a centre of mass, m.
    const ABOVE_WATER_M: f32 = 1.0;
    let mut config = config.clone();
    config.run.seed = settings.seed;
    config.terrain = scenario.terrain.clone();
    let task = &mut config.task;
    task.stagger_first_episode = false;
    let episode_s = scenario.episode_s.unwrap_or(settings.episode_s);
    task.episode_steps = (episode_s / task.control_period_s).round() as u32;
    task.randomisation = scenario.corner.randomisation();
    task.reset.spawn_half_extent_m = scenario.spawn_half_extent_m;
    task.reset.swimming_pose_share = 0.0;
    task.reset.fallen_share = f32::from(u8::from(scenario.fallen));
    if scenario.fallen {
        task.termination.max_tilt_rad = std::f32::consts::PI;
    }
    if let Some(range) = scenario.start.yaw_range_rad {
        task.reset.yaw_range_rad = range;
    }
    // a robot that swims is far above the ground
    if let Some(surface_m) = surface_m {
        let highest = &mut task.termination.com_height_m[1];
        *highest = highest.max(surface_m + ABOVE_WATER_M);
    }
    task.push.enabled = false;
    if let Some(push) = scenario.push {
        task.push = push;
    }
    config
}
