//! Which suspect it is: short trainings with suspects put right, as few as will do.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use clap::Args;

use crate::behaviour::Behaviour;
use crate::report::{Cause, Report, Trial, Verdict};
use crate::run::Run;
use crate::suspect::Suspect;
use crate::trial::{Start, Trainer, change};
use crate::{observation, robot, stance, table, terms};

/// Suspects that get a training of their own before all are put right together.
const ALONE: usize = 3;
/// Suspicion from which one is worth a training of its own.
const SUSPECT: f64 = 0.8;
/// How much better it must walk than as it is, of 1: three times what two healthy trainings differ by.
const BETTER: f64 = 0.15;
/// Times the length of the longest training so far that must be left for another.
const ROOM: f64 = 1.1;

/// What is asked.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    pub run: PathBuf,
    /// Longest time that it may take, s
    #[arg(long, value_name = "SECONDS", default_value_t = 120.0, value_parser = seconds)]
    pub budget: f64,
}

fn seconds(text: &str) -> Result<f64, String> {
    let parsed: f64 = text.parse().map_err(|_| "is not a number".to_owned())?;
    match (5.0..=86_400.0).contains(&parsed) {
        true => Ok(parsed),
        false => Err("must be 5 to 86400 s".to_owned()),
    }
}

/// What is told as it goes.
pub type Tell<'a> = &'a mut dyn FnMut(&str);

/// The trainings of one explanation.
struct Search<'a> {
    run: &'a Run,
    trainer: Trainer,
    folder: tempfile::TempDir,
    seed: u64,
    /// The policy that trainings begin with where the mistake shows only later.
    from: Option<PathBuf>,
    /// The score as it is.
    as_is: f64,
    trials: Vec<Trial>,
    tell: Tell<'a>,
}

impl Search<'_> {
    /// Trains with these suspects put right, so many times as long as usual; `None` where there is no time for it.
    fn trial(&mut self, put_right: &[&Suspect], times: u64) -> Result<Option<Behaviour>, Failure> {
        let longest = self.trials.iter().map(|t| t.seconds).fold(0.0, f64::max);
        let left = self.trainer.until.saturating_duration_since(Instant::now());
        if left.as_secs_f64() < ROOM * times as f64 * longest {
            return Ok(None);
        }
        let what = match put_right {
            [] => "as it is".to_owned(),
            [one] => format!("with {} put right", one.id),
            all => format!("with {} suspects put right", all.len()),
        };
        let folder = self.folder.path().join(format!("trial {}", self.trials.len()));
        let start = Start {
            run: self.run,
            trainer: &self.trainer,
            seed: self.seed,
            times,
            from: self.from.as_deref(),
        };
        let Some(trial) = start.trial(put_right, &folder)? else { return Ok(None) };
        let behaviour = trial.behaviour.clone();
        (self.tell)(&format!(
            "{what}: {:.2} of {:.2} m/s after {} iterations, {:.0} s",
            behaviour.vx_mps, behaviour.command_mps, trial.iterations, trial.seconds
        ));
        self.trials.push(trial);
        Ok(Some(behaviour))
    }

    /// Whether it walks with these put right; `None` where there is no time to find out.
    fn helps(&mut self, put_right: &[&Suspect]) -> Result<Option<bool>, Failure> {
        let better = self.as_is + BETTER;
        let first = match self.trial(put_right, 1) {
            // what the learner refuses is no cure
            Err(failure) if matches!(failure.code(), ExitCode::BadConfig | ExitCode::Internal) => {
                return Ok(Some(false));
            }
            other => other?,
        };
        match first {
            None => Ok(None),
            Some(behaviour) if behaviour.score < better => Ok(Some(false)),
            Some(behaviour) if behaviour.walks() => Ok(Some(true)),
            // much better than it was, and not there yet
            Some(_) => Ok(self.trial(put_right, 2)?.map(|later| later.walks())),
        }
    }

    /// Trains as it is, from another seed. Where that walks at first, once more from there with costs in full:
    /// what makes standing pay shows only when costs have grown. Whether it walks as it is.
    fn control(&mut self) -> Result<Option<bool>, Failure> {
        let Some(first) = self.trial(&[], 1)? else { return Ok(None) };
        self.as_is = first.score;
        if !first.walks() {
            return Ok(Some(false));
        }
        self.from = Some(self.folder.path().join("trial 0").join("policy.onnx"));
        let Some(later) = self.trial(&[], 1)? else { return Ok(None) };
        self.as_is = later.score;
        Ok(Some(later.walks()))
    }

    /// The fewest of `all`, which together help, that do: the smallest number of the first ones, by halving; the
    /// last of these is needed, and what else is, is looked for among those before it.
    fn needed<'s>(&mut self, all: &[&'s Suspect]) -> Result<Option<Vec<&'s Suspect>>, Failure> {
        let mut needed: Vec<&Suspect> = Vec::new();
        let mut among = all.len();
        while among > 0 {
            let (mut too_few, mut enough) = (0, among);
            while too_few + 1 < enough {
                let middle = too_few.midpoint(enough);
                let tried = [&needed[..], &all[..middle]].concat();
                match self.helps(&tried)? {
                    Some(true) => enough = middle,
                    Some(false) => too_few = middle,
                    None => return Ok(None),
                }
            }
            needed.push(all[enough - 1]);
            among = enough - 1;
            if among == 0 {
                break;
            }
            match self.helps(&needed.clone())? {
                Some(true) => break,
                Some(false) => {}
                None => return Ok(None),
            }
        }
        needed.sort_by(|a, b| b.suspicion.total_cmp(&a.suspicion));
        Ok(Some(needed))
    }
}

/// Everything that may be wrong with a run whose robot does that, the most suspect first.
///
/// # Errors
/// Where the environments cannot be built.
pub fn suspects(run: &Run, behaviour: &Behaviour) -> Result<Vec<Suspect>, Failure> {
    let mut all = table::suspects(run, behaviour);
    all.extend(terms::suspects(run, behaviour));
    all.extend(observation::suspects(run, behaviour)?);
    all.extend(robot::suspects(&run.model));
    all.extend(stance::suspect(run));
    all.extend(table::shuffles(run, behaviour));
    all.sort_by(|a, b| b.suspicion.total_cmp(&a.suspicion));
    Ok(all)
}

/// Says why a run does not walk, within the plan's time; `learner` is the program `caudata-learner`.
///
/// # Errors
/// Where the run cannot be read, a training cannot be started, or `stop` is raised.
pub fn explain(
    plan: &Plan,
    learner: &Path,
    stop: &StopFlag,
    tell: Tell<'_>,
) -> Result<Report, Failure> {
    let began = Instant::now();
    let run = Run::read(&plan.run)?;
    let policy = files::policy(&plan.run.join("policy.onnx"))?;
    let behaviour = Behaviour::of(&run.config, &run.reference, &run.model, &policy, stop)?;
    let mut report = Report {
        verdict: Verdict::Walks,
        causes: Vec::new(),
        others: Vec::new(),
        trials: Vec::new(),
        seconds: 0.0,
        behaviour,
    };
    if !report.behaviour.walks() {
        let suspects = suspects(&run, &report.behaviour)?;
        let mut search = Search {
            run: &run,
            trainer: Trainer {
                learner: learner.to_owned(),
                stop: stop.clone(),
                until: began + Duration::from_secs_f64(plan.budget),
            },
            folder: tempfile::tempdir().or_exit(ExitCode::CannotCreate)?,
            seed: run.config.run.seed.wrapping_add(1) & (i64::MAX as u64),
            from: None,
            as_is: 0.0,
            trials: Vec::new(),
            tell,
        };
        let (verdict, named) = searched(&mut search, &suspects)?;
        report.verdict = verdict;
        report.trials = search.trials;
        sort_out(&mut report, &run, &suspects, &named);
    }
    report.seconds = began.elapsed().as_secs_f64();
    Ok(report)
}

/// The verdict, and the suspects that it names.
fn searched<'s>(
    search: &mut Search<'_>,
    suspects: &'s [Suspect],
) -> Result<(Verdict, Vec<&'s Suspect>), Failure> {
    let nothing = |verdict| Ok((verdict, Vec::new()));
    match search.control()? {
        Some(true) => return nothing(Verdict::WalksWhenTrainedAgain),
        Some(false) => {}
        None => return nothing(Verdict::Suspected),
    }
    let alone = suspects.iter().take_while(|s| s.suspicion >= SUSPECT).take(ALONE);
    let mut tried = 0;
    for suspect in alone {
        match search.helps(&[suspect])? {
            Some(true) => return Ok((Verdict::Explained, vec![suspect])),
            Some(false) => tried += 1,
            None => return nothing(Verdict::Suspected),
        }
    }
    let all: Vec<&Suspect> = suspects.iter().collect();
    if all.len() <= tried.min(1) {
        return nothing(Verdict::Unexplained);
    }
    match search.helps(&all)? {
        Some(true) => Ok(match search.needed(&all)? {
            Some(named) => (Verdict::Explained, named),
            None => (Verdict::Suspected, Vec::new()),
        }),
        Some(false) => nothing(Verdict::Unexplained),
        None => nothing(Verdict::Suspected),
    }
}

/// Puts the suspects into the report: those that are named, then those that were not refuted.
fn sort_out(report: &mut Report, run: &Run, suspects: &[Suspect], named: &[&Suspect]) {
    let refuted = |suspect: &Suspect| {
        let alone = |t: &&Trial| t.put_right == [suspect.id];
        report.trials.iter().any(|t| alone(&t)) && !named.contains(&suspect)
    };
    let cause = |suspect: &Suspect, helps: Option<bool>| Cause {
        id: suspect.id,
        places: suspect.keys.clone(),
        says: suspect.says.clone(),
        change: change(run, suspect),
        suspicion: suspect.suspicion,
        helps,
    };
    let causes = named.iter().map(|suspect| cause(suspect, Some(true))).collect();
    let others = suspects.iter().filter(|s| !named.contains(s) && s.suspicion >= 0.5);
    let (last, first): (Vec<&Suspect>, Vec<&Suspect>) = others.partition(|s| refuted(s));
    let first = first.into_iter().map(|suspect| cause(suspect, None));
    let last = last.into_iter().map(|suspect| cause(suspect, Some(false)));
    let others = first.chain(last).collect();
    (report.causes, report.others) = (causes, others);
}
