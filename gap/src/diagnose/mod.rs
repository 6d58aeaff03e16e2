//! From runs to a verdict.
//!
//! Noise floor, divergence, standard models, screening, refinement, greedy extension with deletion and swaps,
//! gates in cross-validation on the runs that are fitted, answer sets, the model to carry; then, once, held-out
//! runs; detection floors, leftovers, the next experiment. Deterministic where no time is set: the only
//! randomness is resampling, from a seed.

mod alike;
mod both_gains;
mod carried;
mod constancy;
mod delete;
mod divergence;
mod doubt;
mod exchange;
mod extend;
mod fits;
mod floors;
mod folds;
mod gates;
mod heard;
mod joints;
mod judge;
mod leftover;
mod levels;
mod local;
mod losses;
mod metric;
mod motion;
mod naming;
mod next;
mod noise;
mod nuisances;
mod pairs;
mod pictures;
mod pipeline;
mod product;
mod refine;
mod request;
mod scout;
mod screen;
mod search;
mod signature;
mod split;
mod spread;
mod state;
mod stops;
mod synonyms;
mod tracking;
mod unexplained;
mod verdict;
mod words;

use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_model::RobotModel;

use crate::calibration::Calibration;
use crate::effects::{self, DROPPED_FRAMES, Effect, PASSED_STOP};
use crate::error::GapError;
use crate::excitation::Excitation;
use crate::go_on::GoOn;
use crate::replay::{Data, Replayer, SegmentOptions};
use crate::report::{Compute, RunUse};
use crate::trial::{Role, Run, Trial};
use crate::{check, reading, repeats};
use losses::Repeats;

pub use request::{Diagnosis, Options, Progress, Request, Split, Stage};

/// Diagnoses.
///
/// # Errors
/// [`GapError`] where the robot or a run cannot be used at all; [`GapError::Stopped`] where
/// [`Options::go_on`] says so before there is anything to tell, or while it is written down. Whatever the data
/// say about themselves is a verdict, not an error.
pub fn diagnose(
    request: &Request,
    progress: &mut dyn FnMut(Progress),
) -> Result<Diagnosis, GapError> {
    progress(Progress::new(Stage::Reading, 0, ""));
    let asked = request.options.only.iter().chain(&request.options.without);
    if let Some(id) = asked.into_iter().find(|id| effects::find(id).is_none()) {
        return Err(GapError::UnknownEffect(id.clone()));
    }
    let model =
        Arc::new(RobotModel::from_bytes(&request.label, &request.robot_toml, &request.mjcf)?);
    if request.runs.is_empty() {
        return Err(GapError::NoRuns);
    }
    let mut runs = uses(request);
    if request.data_faults.iter().any(|f| f.fatal) {
        return Ok(verdict::data_fault(request, &model, runs));
    }
    let mut trials = request
        .runs
        .iter()
        .map(|run| reading::trial(&model, run))
        .collect::<Result<Vec<_>, _>>()?;
    repeats::group(&model, &mut trials);
    mask_touched(request, &model, &mut trials);
    let split = split::hold_out(&replayer(request, &model)?, &mut trials)?;
    for (run, trial) in runs.iter_mut().zip(&trials) {
        run.role = role_name(trial.role).to_owned();
    }
    let began = Instant::now();
    let mut all =
        searched(request, &model, &trials, split, (&[], request.options.budget_s), progress)?;
    // a joint that was thrown past its stop by what was found does not say that the stop is wrong
    let met = if all.unfinished { Ok(Vec::new()) } else { all.stops_met(request, &model) };
    let met = met.or_else(none_where_stopped)?;
    let left_s = request.options.budget_s.map(|s| s - began.elapsed().as_secs_f64());
    if !met.is_empty() && left_s.is_none_or(|s| s > began.elapsed().as_secs_f64()) {
        let again = searched(request, &model, &trials, split, (&met, left_s), progress);
        // what is finished is worth more than what is not
        let again = again.map(Some).or_else(none_where_stopped)?;
        all = again.filter(|again| !again.unfinished).unwrap_or(all);
    }
    let Searched { mut context, mut found, mut named, tracking, unfinished } = all;
    progress(Progress::new(Stage::Reporting, 0, &found.best.label()));
    context.replayer.set_go_on(GoOn::default());
    if unfinished {
        search::settle(&mut context, &mut found)?;
        naming::name_untried(&context, &found.best, &mut named)?;
    }
    // held-out runs, for the first time
    carried::refuse(&mut context, &mut found, &mut named)?;
    let carried = carried::choose(&mut context, &mut found, &tracking)?;
    if let Some(losses) = &context.losses {
        // what was wrong before is said of the robot as its file says
        found.base = context.lossless(losses)?;
    }
    // strongest first
    named.sort_by(|a, b| b.worth.cross.total_cmp(&a.worth.cross));
    let evidence = verdict::Evidence {
        found: &found,
        named: &named,
        carried: &carried,
        tracking: &tracking,
        unfinished,
    };
    let mut diagnosis = verdict::conclude(request, &context, &evidence, runs, split)?;
    diagnosis.report.data_faults.extend(request.data_faults.iter().cloned());
    diagnosis.report.data_faults.extend(context.passed.iter().map(|p| p.note.clone()));
    let (rollouts, simulated_s) = context.replayer.spent();
    diagnosis.report.compute =
        Compute { candidates: found.tried, rollouts, simulated_s, seconds: 0.0 };
    Ok(diagnosis)
}

/// Nothing, of what whoever asked for it ended.
fn none_where_stopped<T: Default>(error: GapError) -> Result<T, GapError> {
    match error {
        GapError::Stopped => Ok(T::default()),
        other => Err(other),
    }
}

/// What a search came to.
struct Searched {
    context: state::Context,
    found: search::Found,
    named: Vec<naming::Named>,
    tracking: tracking::Tracking,
    /// Whether time was too short.
    unfinished: bool,
}

impl Searched {
    /// Joints that pass a stop of the file as given, and do not as they were found.
    fn stops_met(
        &self,
        request: &Request,
        model: &Arc<RobotModel>,
    ) -> Result<Vec<usize>, GapError> {
        let state::Context { passed, fit, holdout, .. } = &self.context;
        if passed.is_empty() {
            return Ok(Vec::new());
        }
        let trials = fit.data.trials.iter().chain(&holdout.data.trials).cloned().collect();
        let data = Data::new(model, trials, SegmentOptions::default());
        stops::met(&replayer(request, model)?, &data, passed, &self.found.best.terms)
    }
}

/// Searches in so many seconds, if they are counted. Stops of the joints `kept` are as the file has them.
fn searched(
    request: &Request,
    model: &Arc<RobotModel>,
    trials: &[Trial],
    split: Split,
    (kept, budget_s): (&[usize], Option<f64>),
    progress: &mut dyn FnMut(Progress),
) -> Result<Searched, GapError> {
    let mut context = context(request, replayer(request, model)?, trials.to_vec(), split, kept)?;
    let mut found = search::Found::nothing(&context)?;
    let mut named = Vec::new();
    let mut tracking = tracking::Tracking::default();
    let parts = (&mut context, &mut found, &mut named, &mut tracking);
    let unfinished = explore((request, budget_s), parts, progress)?;
    Ok(Searched { context, found, named, tracking, unfinished })
}

/// Shares of the time there is after which fitting of angles, the search, and naming end.
const ENDS: [f64; 3] = [0.4, 0.75, 0.9];

/// What a search fills.
type Parts<'a> = (
    &'a mut state::Context,
    &'a mut search::Found,
    &'a mut Vec<naming::Named>,
    &'a mut tracking::Tracking,
);

/// Fits, searches and names, in the time there is. Whether that was too short.
fn explore(
    (request, budget_s): (&Request, Option<f64>),
    (context, found, named, tracking): Parts<'_>,
    progress: &mut dyn FnMut(Progress),
) -> Result<bool, GapError> {
    let began = Instant::now();
    let options = &request.options;
    let end = |share: f64| Some(began + Duration::from_secs_f64((share * budget_s?).max(0.0)));
    let mut unfinished = false;
    let mut ended = |outcome: Result<(), GapError>| match outcome {
        Err(GapError::Stopped) => {
            unfinished = true;
            Ok(())
        }
        other => other,
    };
    let [fitting, searching, naming] = ENDS.map(end);
    context.replayer.set_go_on(options.go_on.until(fitting));
    ended(tracking.fit_standard(context, progress))?;
    // where there is no gap a model is built as well, if a standard one would be nearer to the angles
    let gap = gates::worst(context, &found.base) >= levels::NOTHING_LEFT;
    ended(tracking.build(context, gap, progress))?;
    context.replayer.set_go_on(options.go_on.until(searching));
    let built = tracking.joint_by_joint(context);
    ended(search::search(context, found, built, progress))?;
    found.supported = found.best.clone();
    progress(Progress::new(Stage::Naming, 0, &found.best.label()));
    context.replayer.set_go_on(options.go_on.until(naming));
    ended(naming::name(context, found, named))?;
    Ok(unfinished)
}

fn role_name(role: Role) -> &'static str {
    match role {
        Role::Fit => "fit",
        Role::Holdout => "holdout",
    }
}

fn uses(request: &Request) -> Vec<RunUse> {
    request
        .runs
        .iter()
        .map(|run| {
            let time = run.log.table.time_s();
            RunUse {
                name: run.name.clone(),
                role: role_name(run.role).to_owned(),
                duration_s: match (time.first(), time.last()) {
                    (Some(a), Some(b)) => b - a,
                    _ => 0.0,
                },
                sha256: run.sha256.clone(),
            }
        })
        .collect()
}

/// Takes out what one of three or more repeats has and the others have not, as if somebody had touched the robot.
fn mask_touched(request: &Request, model: &RobotModel, trials: &mut [Trial]) {
    let logs: Vec<_> = request.runs.iter().map(|r| (r.name.as_str(), &r.log)).collect();
    for span in check::touched(&logs, model) {
        for trial in trials.iter_mut().filter(|t| t.name == span.run) {
            trial.masked_s.push((span.from_s, span.to_s));
        }
    }
}

/// Height of the water's surface that a run notes, m.
fn water_level(run: &Run) -> Option<f64> {
    match run.log.meta.settings.get("water_level_m") {
        Some(caudata_runlog::Setting::Number(level_m)) if *level_m > 0.0 => Some(*level_m),
        _ => None,
    }
}

/// Replays the robot as given, in the water that the runs note.
fn replayer(request: &Request, model: &Arc<RobotModel>) -> Result<Replayer, GapError> {
    let options = &request.options;
    let replayer = Replayer::new(Arc::clone(model), options.threads)?;
    let replayer = replayer.with_go_on(options.go_on.clone());
    Ok(match request.runs.iter().find_map(water_level) {
        Some(level_m) => replayer.with_water_level(level_m),
        None => replayer,
    })
}

fn context(
    request: &Request,
    replayer: Replayer,
    trials: Vec<Trial>,
    split: Split,
    kept: &[usize],
) -> Result<state::Context, GapError> {
    let model = &Arc::clone(replayer.model());
    let last = trials.len().max(2) as f64 - 1.0;
    let mut trials = trials;
    for (k, t) in trials.iter_mut().enumerate() {
        t.session = k as f64 / last;
    }
    let of = |role: Role| -> Vec<Trial> {
        let mut of: Vec<Trial> = trials.iter().filter(|p| p.role == role).cloned().collect();
        if of.is_empty() {
            of.clone_from(&trials);
        }
        repeats::collapse(&of)
    };
    let options = SegmentOptions::default();
    let (fit_trials, held_out) = (of(Role::Fit), of(Role::Holdout));
    let wanted = |e: &&'static Effect| {
        let named = |list: &[String]| list.iter().any(|id| id == e.id);
        !named(&request.options.without)
            && (request.options.only.is_empty() || named(&request.options.only))
    };
    let mut effects: Vec<&'static Effect> = effects::ALL.iter().copied().filter(wanted).collect();
    effects.retain(|e| e.id != PASSED_STOP.id);
    let whole = fit_trials.iter().chain(&held_out).cloned().collect();
    let mut passed = stops::find(&replayer, &Data::new(model, whole, options), &[])?;
    passed.retain(|p| !kept.contains(&p.joint()));
    let also = |replayer: Replayer, p: &stops::Passed| replayer.with_also(p.term.clone());
    let replayer = passed.iter().fold(replayer, also);
    let repeats = match effects.iter().any(|e| e.id == DROPPED_FRAMES.id) {
        true => losses::find(&replayer, &fit_trials)?,
        false => Repeats::SayNothing,
    };
    if !matches!(repeats, Repeats::SayNothing) {
        effects.retain(|e| e.id != DROPPED_FRAMES.id);
    }
    let (replayer, losses) = match repeats {
        Repeats::Lose(losses) => (replayer.with_also(losses.term.clone()), Some(losses)),
        Repeats::LoseNone | Repeats::SayNothing => (replayer, None),
    };
    let excitation = Excitation::of(model, &fit_trials.iter().collect::<Vec<_>>());
    let judged = |trials| judge::Judge::new(&replayer, Data::new(model, trials, options), options);
    effects.retain(|e| (e.of_runs)(&excitation));
    let [fit, holdout] = [judged(fit_trials)?, judged(held_out)?];
    let scout = scout::Scout::new(&replayer, &fit, options)?;
    Ok(state::Context {
        replayer,
        folds: folds::Folds::of(&fit.data),
        fit,
        scout,
        holdout,
        same_runs: split == Split::Same,
        losses,
        passed,
        effects,
        excitation,
        calibration: Calibration::shipped()?,
        seed: request.options.seed,
    })
}
