//! `caudata bench session`: whether a diagnosis that asks for its own experiments names what is hidden, and in
//! how much motion. The session is a process of its own that sees the robot file and the logs that it asked
//! for; this process is the lab that records them of a robot which only it knows.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_gap::excite;
use caudata_gap_benchmark::case::TrueEffect;
use caudata_gap_benchmark::on_request::{Null, Unknown};
use caudata_gap_benchmark::score::Rate;
use caudata_gap_benchmark::simulated::{self, Robot};
use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_studies::session::{Ending, Next, SESSION, Session};
use caudata_studies::{diagnosis, files};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;

/// How often the lab looks for what is asked of it.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Longest session, s.
const LIMIT_S: f64 = 3600.0;
/// Every so many robots one is healthy.
const ROBOTS_A_HEALTHY_ONE: usize = 5;

/// Which robots, and what a session may take.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Robot file; every fifth robot is healthy, each other one has an effect of the catalogue
    #[arg(long, value_name = "R.robot.toml", default_value = "robots/polymander.robot.toml")]
    robot: PathBuf,
    /// Robots
    #[arg(long, value_name = "N", default_value_t = 20)]
    cases: usize,
    /// Seed of what is hidden
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Smallest size of what is hidden, d
    #[arg(long, value_name = "D", default_value_t = 4.0)]
    least_d: f64,
    /// Motion that a session may take, s
    #[arg(long, value_name = "S", default_value_t = 120.0)]
    motion_s: f64,
    /// Time for each of its diagnoses, s
    #[arg(long, value_name = "S", default_value_t = 120.0)]
    budget_s: f64,
    /// Leave the sessions in this folder; default: a temporary one
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
}

/// How a session went.
#[derive(Clone, Debug, Serialize)]
pub struct Case {
    /// What was hidden, with its place; nothing in a healthy robot.
    pub hidden: String,
    /// Its size, d.
    pub d: f64,
    /// How the session ended; none: it failed.
    pub ending: Option<Ending>,
    /// Its verdict.
    pub verdict: String,
    /// Its causes, with places.
    pub named: Vec<String>,
    /// Whether the first name is what is hidden, or nothing is named in a healthy robot.
    pub right: bool,
    /// Whether its place is.
    pub place_right: bool,
    /// Motion that it took, s.
    pub motion_s: f64,
    /// Motion after which the first name was right and stayed so, s.
    pub right_after_s: Option<f64>,
    /// Trials in order.
    pub trials: Vec<String>,
    /// Wall time, s.
    pub seconds: f64,
    /// Why it failed.
    pub failure: String,
}

/// How all went.
#[derive(Debug, Serialize)]
pub struct Finding {
    /// Seed of what was hidden.
    pub seed: u64,
    /// Robots for which no effect could be made as large as asked for.
    pub left_out: usize,
    /// Robots with something hidden whose first name is right at the end of the session.
    pub named: Rate,
    /// The same, sure, and without a wrong name beside it.
    pub sure: Rate,
    /// Named rightly, to stay so, within 60 s of motion.
    pub named_within_60_s: Rate,
    /// Healthy robots in which nothing was named.
    pub healthy: Rate,
    /// What it took.
    pub seconds: f64,
    /// One per robot.
    pub cases: Vec<Case>,
}

/// Has `program` hold a session with each robot.
///
/// # Errors
/// Where a robot cannot be made or recorded; a session that fails is a case.
pub fn run(plan: &Plan, program: &Path, tell: &mut dyn FnMut(&Case)) -> Result<Finding, Failure> {
    let began = Instant::now();
    let temporary = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
    let root = plan.keep.as_deref().unwrap_or(temporary.path());
    files::make_folder(root)?;
    let root = &root.canonicalize().or_exit(ExitCode::CannotCreate)?;
    let model = Arc::new(files::robot(&plan.robot)?);
    let robot = &copied(&plan.robot, root)?;
    tracing::info!("recording a healthy robot, to measure sizes by");
    let null = Null::record(&model, plan.seed, &temporary.path().join("null"))
        .or_exit(ExitCode::Internal)?;
    let mut seeds = Stream::new(Key::for_run(plan.seed), Purpose::Command);
    let (mut cases, mut left_out) = (Vec::new(), 0);
    for number in 0..plan.cases {
        let seed = seeds.next_u64() >> 1;
        let unknown = match (number + 1) % ROBOTS_A_HEALTHY_ONE {
            0 => Some(null.healthy(seed)),
            _ => null.hide(seed, plan.least_d).or_exit(ExitCode::Internal)?,
        };
        let Some(unknown) = unknown else {
            left_out += 1;
            continue;
        };
        let lab =
            Lab { model: &model, unknown: &unknown, folder: root.join(format!("{number:03}")) };
        let case = lab.session(plan, robot, program)?;
        tell(&case);
        cases.push(case);
    }
    let rate = |healthy: bool, hit: &dyn Fn(&Case) -> bool| {
        Rate::count(&cases, |c| c.hidden.is_empty() == healthy, hit)
    };
    let alone = |c: &Case| c.right && c.ending == Some(Ending::Sure) && c.named.len() == 1;
    Ok(Finding {
        seed: plan.seed,
        left_out,
        named: rate(false, &|c| c.right),
        sure: rate(false, &alone),
        named_within_60_s: rate(false, &|c| c.right_after_s.is_some_and(|s| s <= 60.0)),
        healthy: rate(true, &|c| c.right),
        seconds: began.elapsed().as_secs_f64(),
        cases,
    })
}

/// The robot file with its MJCF in `root`, where sessions see nothing else.
fn copied(robot: &Path, root: &Path) -> Result<PathBuf, Failure> {
    let (toml, mjcf_name, mjcf) = diagnosis::robot_files(robot)?;
    let copy = root.join("robot.robot.toml");
    files::write_whole(&copy, &toml)?;
    files::write_whole(&root.join(mjcf_name), &mjcf)?;
    Ok(copy)
}

/// A lab with a robot that only it knows.
struct Lab<'a> {
    model: &'a Arc<RobotModel>,
    unknown: &'a Unknown,
    folder: PathBuf,
}

impl Lab<'_> {
    fn session(&self, plan: &Plan, robot: &Path, program: &Path) -> Result<Case, Failure> {
        let began = Instant::now();
        files::make_folder(&self.folder)?;
        let log = self.folder.join("output.txt");
        let output = std::fs::File::create(&log).or_exit(ExitCode::CannotCreate)?;
        let errors = output.try_clone().or_exit(ExitCode::OsResource)?;
        let folder = self.folder.join("session");
        let mut child = Command::new(program)
            .args(["gap", "session", "--threads", "1", "--wait", "10min"])
            .args(["--motion", &format!("{}s", plan.motion_s)])
            .args(["--budget", &format!("{}s", plan.budget_s)])
            .arg("--robot")
            .arg(robot)
            .arg(&folder)
            .env_clear()
            .current_dir(&self.folder)
            .stdin(Stdio::null())
            .stdout(output)
            .stderr(errors)
            .spawn()
            .or_exit_with(ExitCode::OsResource, || program.display().to_string())?;
        let served = self.serve(&folder, &mut child, began);
        // a session that is not served any more has nothing to wait for
        let _ = child.kill();
        let _ = child.wait();
        served?;
        let session = files::read_json::<Session>(&folder.join(SESSION));
        let seconds = began.elapsed().as_secs_f64();
        Ok(judged(self.unknown, session, seconds))
    }

    /// Records what is asked for until the session has ended.
    fn serve(&self, folder: &Path, child: &mut Child, began: Instant) -> Result<(), Failure> {
        let mut run = 0;
        while child.try_wait().or_exit(ExitCode::OsResource)?.is_none() {
            if began.elapsed().as_secs_f64() > LIMIT_S {
                return Ok(());
            }
            // it is written whole
            let session = files::read_json::<Session>(&folder.join(SESSION)).ok();
            let next = session.filter(|s| s.ending == Ending::Waiting);
            match next.and_then(|s| s.next).filter(|n| !n.log.exists()) {
                Some(next) => {
                    self.record(&next, run)?;
                    run += 1;
                }
                None => std::thread::sleep(LOOK_EVERY),
            }
        }
        Ok(())
    }

    fn record(&self, next: &Next, run: u64) -> Result<(), Failure> {
        let trial = excite::trial(self.model, &next.trial, None, excite::DEFAULT_RATE_HZ)
            .or_exit(ExitCode::Internal)?;
        let robot = Robot {
            lab: self.model,
            model: self.model,
            lane: &self.unknown.lane,
            seed: self.unknown.answer.seed,
            payload: next.payload.as_slice(),
        };
        let part = self.folder.join("recording");
        simulated::record(&robot, &trial, run, &part).or_exit(ExitCode::Internal)?;
        if let Some(parent) = next.log.parent() {
            files::make_folder(parent)?;
        }
        std::fs::rename(&part, &next.log).or_exit(ExitCode::CannotCreate)
    }
}

/// Whether a label (`effect` or `effect@place`) has the name of what is hidden.
fn names(truth: &TrueEffect, label: &str) -> bool {
    let id = label.split('@').next().unwrap_or_default();
    id == truth.effect || truth.equivalent.iter().any(|e| e == id)
}

fn judged(unknown: &Unknown, session: Result<Session, Failure>, seconds: f64) -> Case {
    let truth = unknown.answer.effects.first();
    let label = |t: &TrueEffect| match t.joint.as_str() {
        "" => t.effect.clone(),
        joint => format!("{}@{joint}", t.effect),
    };
    let (session, failure) = match session {
        Ok(session) => (Some(session), String::new()),
        Err(failure) => (None, failure.to_string()),
    };
    let rounds = session.as_ref().map_or(&[][..], |s| &s.rounds);
    let named = rounds.last().map_or(Vec::new(), |r| r.names.clone());
    let right_in = |names_of: &[String]| match truth {
        Some(t) => names_of.first().is_some_and(|first| names(t, first)),
        None => names_of.is_empty(),
    };
    let said = rounds.iter().rev().take_while(|r| r.verdict.is_some());
    let settled = said.take_while(|r| right_in(&r.names));
    let place = |label: &str| label.split_once('@').map_or(String::new(), |(_, p)| p.to_owned());
    Case {
        hidden: truth.map_or_else(String::new, label),
        d: truth.map_or(0.0, |t| t.d),
        ending: session.as_ref().map(|s| s.ending),
        verdict: session.as_ref().map_or_else(String::new, |s| {
            let word = serde_json::to_value(s.verdict).unwrap_or_default();
            word.as_str().unwrap_or_default().to_owned()
        }),
        right: rounds.last().is_some_and(|r| r.verdict.is_some()) && right_in(&named),
        place_right: truth.is_none_or(|t| named.first().is_some_and(|n| place(n) == t.joint)),
        motion_s: session.as_ref().map_or(0.0, |s| s.motion_s),
        right_after_s: settled.last().map(|r| r.motion_s),
        trials: rounds.iter().map(|r| r.trial.clone()).collect(),
        named,
        seconds,
        failure,
    }
}
