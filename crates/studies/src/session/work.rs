//! A session at work in its folder.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_gap::GoOn;
use caudata_gap::excite;
use caudata_gap::prospects::Prospects;
use caudata_gap::report::{Cause, Report, Verdict};
use caudata_gap_benchmark::simulated;
use caudata_model::RobotModel;
use caudata_runlog::{Axis, BaseHold, Payload, RunLog, Signal};
use caudata_sim::LaneParams;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

use super::choose::{asked_for, is_sure, weights};
use super::{Ending, Next, Plan, Round, SESSION, Session, noted};
use crate::adapt::Named;
use crate::out_folder::{Asked, OutFolder};
use crate::{Steps, diagnosis, files, flags};

/// So probable must it be, after all that was recorded, that nothing is wrong.
const HEALTHY: f64 = 0.95;
/// So many trials come before the first diagnosis: two to fit, and one that nothing is fitted to.
const FIRST: usize = 3;
/// How often a log that is waited for is looked for.
const LOOK_FOR_LOG_EVERY: Duration = Duration::from_millis(200);

/// Records and diagnoses until it is sure, cannot be, or has to wait for a log.
///
/// # Errors
/// Where a file cannot be read or written, the folder was made with something else or is another process's,
/// a log cannot be used, or a step is stopped.
pub fn session(plan: &Plan, steps: &mut Steps<'_>) -> Result<Session, Failure> {
    let lab = Arc::new(files::robot(&plan.robot)?);
    let truth = plan.truth.as_ref().map(|path| truth(path, &lab)).transpose()?;
    let _taken = OutFolder::take(&plan.dir, &asked(plan, &lab, truth.as_deref()))?;
    let mut own = Own { plan, lab, truth, rounds: Vec::new(), prospects: None };
    own.go_back()?;
    loop {
        let report = own.report()?;
        match own.decide(report.as_ref(), steps)? {
            Decision::End(ending, reason) => return own.told(report, ending, reason, None),
            Decision::Record(next) => {
                if !own.record(&next, steps)? {
                    let reason = format!("{} is not recorded yet", next.trial);
                    return own.told(report, Ending::Waiting, reason, Some(next));
                }
                own.diagnose(next, steps)?;
            }
        }
    }
}

/// The robot to be simulated, which has the joints of the one that is diagnosed.
fn truth(path: &Path, lab: &RobotModel) -> Result<Arc<RobotModel>, Failure> {
    let truth = files::robot(path)?;
    if truth.actuated_names() != lab.actuated_names() {
        let message = format!("{} has other joints than the robot file", path.display());
        return Err(Failure::message(ExitCode::BadInput, message));
    }
    caudata_sim::check_extension(&truth).or_exit(ExitCode::BadInput)?;
    Ok(Arc::new(truth))
}

/// All that decides what is recorded and found, but for what may be given more of.
fn asked(plan: &Plan, lab: &RobotModel, truth: Option<&RobotModel>) -> Asked {
    let places: Vec<String> = plan.place.iter().map(|p| format!("{p:?}")).collect();
    let truth = truth.map_or("none".to_owned(), RobotModel::hash_hex);
    let all = [
        ("--robot", lab.hash_hex()),
        ("--truth", truth),
        ("--place", places.join(",").to_lowercase()),
        ("--without", plan.without.join(" ")),
        ("--only", plan.only.join(" ")),
        ("--seed", plan.seed.to_string()),
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
    ];
    all.map(|(key, value)| (key.to_owned(), value)).into()
}

/// What to do next.
enum Decision {
    End(Ending, String),
    Record(Next),
}

/// A session at work.
struct Own<'a> {
    plan: &'a Plan,
    lab: Arc<RobotModel>,
    truth: Option<Arc<RobotModel>>,
    rounds: Vec<Round>,
    /// Simulated when they are first asked for.
    prospects: Option<Prospects>,
}

impl Own<'_> {
    /// To where an earlier call was.
    fn go_back(&mut self) -> Result<(), Failure> {
        let path = self.plan.dir.join(SESSION);
        if path.is_file() {
            self.rounds = files::read_json::<Session>(&path)?.rounds;
        }
        Ok(())
    }

    fn motion_s(&self) -> f64 {
        self.rounds.last().map_or(0.0, |r| r.motion_s)
    }

    /// Folder of the diagnosis after round `round`.
    fn folder(&self, round: usize) -> PathBuf {
        self.plan.dir.join("rounds").join(format!("{round:02}"))
    }

    /// The last diagnosis.
    fn report(&self) -> Result<Option<Report>, Failure> {
        match self.rounds.len() {
            n if n < FIRST => Ok(None),
            n => files::read_json(&self.folder(n).join(diagnosis::REPORT)).map(Some),
        }
    }

    fn decide(
        &mut self,
        report: Option<&Report>,
        steps: &mut Steps<'_>,
    ) -> Result<Decision, Failure> {
        if let Some(report) = report {
            if report.verdict == Verdict::DataFault {
                return Ok(Decision::End(Ending::Unsure, report.summary.clone()));
            }
            if is_sure(report) {
                let names: Vec<String> = report.causes.iter().map(Cause::rivals).collect();
                let names = names.join("; ");
                let reason = format!("{names}: confident names, and held-out runs agree");
                return Ok(Decision::End(Ending::Sure, reason));
            }
        }
        self.look_ahead(steps)?;
        let Some(prospects) = &self.prospects else {
            return Err(Failure::message(ExitCode::Internal, "no prospects"));
        };
        // without a weight, which no prospect has
        let bare = self.rounds.iter().filter(|r| r.payload.is_none());
        let recorded: Vec<&str> = bare.map(|r| r.trial.as_str()).collect();
        let weights = match report {
            Some(report) => weights(report, prospects, &self.lab, &recorded),
            None => prospects.unseen(&[]),
        };
        let left_s = self.plan.motion - self.motion_s();
        let is_recorded = |trial: &str, weighted: bool| {
            let mut same = self.rounds.iter().filter(|r| r.trial == trial);
            same.any(|r| r.payload.is_some() == weighted)
        };
        if let Some(asked) = report.and_then(asked_for)
            && let Some(found) = prospects.find(&asked.trial)
            && !is_recorded(&asked.trial, asked.payload.is_some())
            && found.duration_s <= left_s
        {
            let payload = asked.payload.clone();
            return Ok(Decision::Record(self.next(found, asked.reason.clone(), payload)));
        }
        let no_gap = report.is_some_and(|r| r.verdict == Verdict::NoGap);
        let best = prospects.best(&weights, &recorded, f64::INFINITY);
        if no_gap && (weights.nothing() >= HEALTHY || best.is_none()) {
            let dark = prospects.dark(&recorded);
            let dark = match dark.is_empty() {
                true => String::new(),
                false => format!("; no short trial shows {}", dark.join(", ")),
            };
            let reason = format!(
                "nothing is wrong, with {:.0} %: what matters on this robot would have shown{dark}",
                100.0 * weights.nothing()
            );
            return Ok(Decision::End(Ending::Sure, reason));
        }
        if let Some(best) = prospects.best(&weights, &recorded, left_s) {
            return Ok(Decision::Record(self.next(best.trial, best.why, None)));
        }
        let reason = match best {
            Some(best) => format!(
                "{:.0} s of motion are left; {} would come next ({})",
                left_s, best.trial.name, best.why
            ),
            None => "no trial of the battery tells more about what is open".to_owned(),
        };
        // one that lets a servo go, or is done where this robot cannot be
        let beyond = report.and_then(asked_for);
        let beyond = beyond.filter(|asked| prospects.find(&asked.trial).is_none());
        let beyond = beyond.map_or(String::new(), |asked| {
            format!(
                "; {} would tell it, which this session does not do: {}",
                asked.trial, asked.reason
            )
        });
        Ok(Decision::End(Ending::Unsure, reason + &beyond))
    }

    fn next(&self, trial: &excite::Trial, why: String, payload: Option<Payload>) -> Next {
        let name = format!("{:02}_{}", self.rounds.len() + 1, trial.name);
        Next {
            trial: trial.name.clone(),
            why,
            base: trial.base,
            commands: self.plan.dir.join("next").join(format!("{name}.csv")),
            log: self.plan.dir.join("logs").join(name),
            payload,
        }
    }

    /// Simulates what each trial would tell, once.
    fn look_ahead(&mut self, steps: &mut Steps<'_>) -> Result<(), Failure> {
        if self.prospects.is_some() {
            return Ok(());
        }
        let sees_base = self.sees_base()?;
        let bases: Vec<BaseHold> = self.plan.place.iter().map(|p| p.base()).collect();
        let (plan, lab) = (self.plan, &self.lab);
        let what = "every trial of the battery with every effect, simulated";
        let made = steps.run("look ahead", what, |stop, _| {
            let stop = stop.clone();
            Prospects::of(
                lab,
                // a robot that is let go may fall
                |trial| bases.contains(&trial.base) && trial.on.is_empty(),
                sees_base,
                |effect| {
                    let named = |ids: &[String]| ids.iter().any(|id| id == effect.id);
                    !named(&plan.without) && (plan.only.is_empty() || named(&plan.only))
                },
                plan.threads.unwrap_or_else(flags::cores).max(1),
                GoOn::as_long_as(move || !stop.is_set()),
            )
            .or_exit(ExitCode::Internal)
        })?;
        self.prospects = Some(made);
        Ok(())
    }

    /// Whether logs on the ground or in water have the base's motion, as far as there are any.
    fn sees_base(&self) -> Result<bool, Failure> {
        let mut any = false;
        for dir in self.logs()? {
            let log = RunLog::read(&dir).or_exit(ExitCode::BadInput)?;
            if log.meta.base != BaseHold::Fixed {
                any = true;
                if log.table.column(&Signal::BasePosition(Axis::X)).is_some() {
                    return Ok(true);
                }
            }
        }
        Ok(!any)
    }

    /// All log folders of the rounds so far.
    fn logs(&self) -> Result<Vec<PathBuf>, Failure> {
        let of = |r: &Round| {
            let name = format!("{:02}_{}", r.round, r.trial);
            self.plan.dir.join("logs").join(name)
        };
        let dirs: Vec<PathBuf> = self.rounds.iter().map(of).collect();
        diagnosis::logs_at(&dirs)
    }

    /// Whether the log of `next` is there: made now of a simulated robot, else waited for.
    fn record(&self, next: &Next, steps: &mut Steps<'_>) -> Result<bool, Failure> {
        let is_there = || diagnosis::logs_at(std::slice::from_ref(&next.log)).is_ok();
        if is_there() {
            steps.is_there("record", &next.log);
            return noted_in_log(next);
        }
        let trial = excite::trial(&self.lab, &next.trial, None, excite::DEFAULT_RATE_HZ)
            .or_exit(ExitCode::Internal)?;
        if let Some(truth) = &self.truth {
            let what = format!("{} for {:.0} s: {}", next.trial, trial.duration_s, next.why);
            let part = self.plan.dir.join("logs.part");
            return steps.run("record", &what, |_, _| {
                if part.exists() {
                    // of a call that was stopped
                    std::fs::remove_dir_all(&part).or_exit(ExitCode::CannotCreate)?;
                }
                let robot = simulated::Robot {
                    lab: &self.lab,
                    model: truth,
                    lane: &LaneParams::nominal(truth),
                    seed: self.plan.seed,
                    payload: next.payload.as_slice(),
                };
                simulated::record(&robot, &trial, self.rounds.len() as u64, &part)
                    .or_exit(ExitCode::Internal)?;
                files::make_folder(&self.plan.dir.join("logs"))?;
                std::fs::rename(&part, &next.log).or_exit(ExitCode::CannotCreate)?;
                Ok(true)
            });
        }
        files::make_folder(&self.plan.dir.join("next"))?;
        let csv = trial.to_csv().or_exit(ExitCode::Internal)?;
        files::write_whole(&next.commands, &csv)?;
        let Some(wait_s) = self.plan.wait else { return Ok(false) };
        let reason = format!("{} is not recorded yet", next.trial);
        self.told(self.report()?, Ending::Waiting, reason, Some(next.clone()))?;
        let what = format!("{} into {}", next.commands.display(), next.log.display());
        steps.run("wait", &what, |stop, _| {
            let until = Instant::now() + Duration::from_secs_f64(wait_s);
            while !is_there() && Instant::now() < until && !stop.is_set() {
                stop.wait(LOOK_FOR_LOG_EVERY);
            }
            if is_there() { noted_in_log(next) } else { Ok(false) }
        })
    }

    /// Ends a round: diagnoses all logs, the one of `next` included, as soon as there are enough.
    fn diagnose(&mut self, next: Next, steps: &mut Steps<'_>) -> Result<(), Failure> {
        let round = self.rounds.len() + 1;
        let found = self.prospects.as_ref().and_then(|p| p.find(&next.trial));
        let mut own = Round {
            round,
            motion_s: self.motion_s() + found.map_or(0.0, |t| t.duration_s),
            trial: next.trial,
            why: next.why,
            payload: next.payload,
            given_rad: None,
            left_rad: None,
            verdict: None,
            names: Vec::new(),
        };
        let report = match round {
            n if n < FIRST => None,
            _ => Some(self.diagnosed(round, next.log, steps)?),
        };
        if let Some(report) = &report {
            let label = |c: &Cause| match c.location.is_empty() {
                true => c.effect.clone(),
                false => format!("{}@{}", c.effect, c.location.join("+")),
            };
            own.given_rad = report.position_errors.first().map(|e| e.mean_rad);
            own.left_rad = report.position_errors.last().map(|e| e.mean_rad);
            own.verdict = Some(report.verdict);
            own.names = report.causes.iter().map(label).collect();
        }
        self.rounds.push(own);
        self.told(report, Ending::Unsure, "interrupted".to_owned(), None)?;
        Ok(())
    }

    /// The diagnosis of a round, which is not made again where it is there.
    fn diagnosed(
        &self,
        round: usize,
        log: PathBuf,
        steps: &mut Steps<'_>,
    ) -> Result<Report, Failure> {
        let out = self.folder(round);
        let path = out.join(diagnosis::REPORT);
        if path.is_file() {
            steps.is_there("diagnose", &path);
            return files::read_json(&path);
        }
        let mut logs = self.logs()?;
        logs.push(log);
        let plan = diagnosis::Plan {
            robot: self.plan.robot.clone(),
            logs,
            holdouts: Vec::new(),
            out,
            without: self.plan.without.clone(),
            only: self.plan.only.clone(),
            threads: self.plan.threads,
            seed: self.plan.seed,
            budget: self.plan.budget,
        };
        steps.diagnose("diagnose", &plan)
    }

    /// How it stands, which is written down.
    fn told(
        &self,
        report: Option<Report>,
        ending: Ending,
        reason: String,
        next: Option<Next>,
    ) -> Result<Session, Failure> {
        let causes = report.iter().flat_map(|r| &r.causes);
        let session = Session {
            ending,
            reason,
            verdict: report.as_ref().map(|r| r.verdict),
            causes: causes.map(Named::from).collect(),
            motion_s: self.motion_s(),
            rounds: self.rounds.clone(),
            next,
            diagnosis: report.is_some().then(|| self.folder(self.rounds.len())),
        };
        files::write_json(&self.plan.dir.join(SESSION), &session)?;
        Ok(session)
    }
}

/// That the log of `next` notes the weight that was asked for, if one was.
fn noted_in_log(next: &Next) -> Result<bool, Failure> {
    let Some(weight) = &next.payload else { return Ok(true) };
    for dir in diagnosis::logs_at(std::slice::from_ref(&next.log))? {
        let log = RunLog::read(&dir).or_exit(ExitCode::BadInput)?;
        if log.meta.payload.is_empty() {
            let message = format!(
                "{}: log.toml notes no weight, and one was to hang on the robot",
                dir.display()
            );
            let hint = format!("write down what hung there, as `{}`", noted(weight));
            return Err(Failure::message(ExitCode::BadInput, message).hint(hint));
        }
    }
    Ok(true)
}
