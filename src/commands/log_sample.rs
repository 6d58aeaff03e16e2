//! `caudata log sample`: what the environments of a training do now, as rows of a log.

use std::path::Path;
use std::sync::Arc;

use caudata_actor::{build_env, gaussian};
use caudata_config::{Changes, Config, Source};
use caudata_env::VecEnv;
use caudata_evaluation::{Frame, RobotPose};
use caudata_model::RobotModel;
use caudata_policy::Inference;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{BaseHold, CSV_NAME, LogMeta, RunLog, Setting, Table, TableWriter};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

use crate::commands::eval::log;
use crate::commands::ground;

/// Key of its random streams: no actor of the training and no page has it.
const SAMPLE_KEY: u64 = u64::MAX / 3;
/// Ends of episodes that are told, the first.
const ENDS_TOLD: usize = 20;

/// One environment as an actor's: its ground, starts, commands, pushes, noise and randomised parameters, and a policy
/// that explores. The log, the robot, and when episodes ended.
pub fn sample(run: &Path, seconds: u32) -> Result<(RunLog, RobotModel, Vec<String>), Failure> {
    files::run_folder(run)?;
    let first = Config::load(&Source::file(&run.join("config.toml")));
    let first = first.or_exit(ExitCode::BadInput)?;
    let record = Changes::of_run(run, &first).or_exit(ExitCode::BadInput)?;
    let mut config = record.at(&first, u64::MAX).or_exit(ExitCode::BadInput)?;
    (config.actors.lanes, config.actors.threads) = (1, 1);
    let robot = files::robot(&config.robot_path())?;
    let model = Arc::new(robot.clone());
    let policy = files::policy(&run.join("policy.onnx"))?;
    let mut env =
        build_env(&config, Arc::clone(&model), SAMPLE_KEY).or_exit(ExitCode::BadConfig)?;
    policy.check_runs_on(env.contract()).or_exit(ExitCode::BadInput)?;
    let mut inference = Inference::new(&policy, 1).or_exit(ExitCode::BadInput)?;
    let (metadata, seed) = (policy.metadata(), config.run.seed);
    let std: Vec<f32> = metadata.log_std.iter().map(|x| x.exp()).collect();
    // the same policy does the same again
    let (actor, lane) = (SAMPLE_KEY, metadata.version);
    let key = Key { actor, env: lane, ..Key::for_run(seed) };
    let mut noise = Stream::new(key, Purpose::Action);
    let mut act = |observed: &[f32], means: &mut [f32], actions: &mut [f32]| {
        inference.run(observed, 1, means).or_exit(ExitCode::Internal)?;
        gaussian::sample(means, &std, &mut noise, actions);
        Ok(())
    };
    let period_s = config.task.control_period_s;
    let steps = (f64::from(seconds) / period_s).round() as usize;
    let (table, notes) = rows(&mut env, &model, (steps, period_s), &mut act)?;
    let base = match env.engine().terrain().water_level_m {
        Some(_) => BaseHold::Water,
        None => BaseHold::Free,
    };
    let named = config.robot_path().display().to_string();
    let mut meta = LogMeta::new(named, base, 1.0 / period_s);
    ground::note(&mut meta, &config.terrain, seed);
    meta.notes = format!("caudata log sample {}", run.display());
    let version = Setting::Number(metadata.version as f64);
    meta.settings.insert("policy_version".to_owned(), version);
    Ok((RunLog::new(meta, table), robot, notes))
}

/// Answers with actions to what is observed; the means before the noise go to the second.
type Act<'a> = &'a mut dyn FnMut(&[f32], &mut [f32], &mut [f32]) -> Result<(), Failure>;

/// Rows of so many steps, and when episodes end.
fn rows(
    env: &mut VecEnv,
    model: &RobotModel,
    (steps, period_s): (usize, f64),
    act: Act<'_>,
) -> Result<(Table, Vec<String>), Failure> {
    let (mut means, mut actions) = (vec![0.0; env.act_dim()], vec![0.0; env.act_dim()]);
    let signals = log::signals(model);
    let rows = TableWriter::new(Vec::new(), &signals, f64::INFINITY);
    let mut rows = rows.or_exit(ExitCode::Internal)?;
    let mut notes = Vec::new();
    for step in 0..=steps {
        let t_s = step as f64 * period_s;
        let row = log::row(&Frame::read(env, 0), &RobotPose::read(env, 0));
        rows.row(t_s, &row).or_exit(ExitCode::Internal)?;
        act(env.observations(), &mut means, &mut actions)?;
        let output = env.step(&actions).or_exit(ExitCode::Internal)?;
        let room = ENDS_TOLD - notes.len();
        for episode in output.episodes.iter().take(room) {
            let why = episode.reason.map_or("time", |reason| reason.name());
            notes.push(format!("an episode ends at {:.2} s: {why}", t_s + period_s));
        }
    }
    let csv = rows.finish().or_exit(ExitCode::Internal)?;
    let table = Table::parse(CSV_NAME, csv.as_slice()).or_exit(ExitCode::Internal)?;
    Ok((table, notes))
}
