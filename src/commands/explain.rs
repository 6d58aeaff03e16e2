//! `caudata explain`: why a run's policy does not walk. The work is in `crates/explain`.

use std::io::Write;

use caudata_explain::{Cause, Plan, Report, Verdict, explain};
use caudata_task::termination::TerminationReason;
use caudata_telemetry::{ExitCode, Failure, Process};

use crate::commands::eval::BREAKS_DOWN;
use crate::commands::train::Programs;
use crate::say::{self, WithJson, short};

const NONE: &str = "none of these: with every suspect put right it does not walk either";
const CLEAN: &str = "task and robot file hold no mistake that this command knows: train longer, or look at gains and pose";
/// Suspects that are shown besides what is named.
const OTHERS: usize = 3;

pub fn run(args: &WithJson<Plan>, process: &Process) -> Result<(), Failure> {
    let WithJson { plan, json } = args;
    let learner = Programs::beside_this_one()?.find("caudata-learner")?;
    let report = explain(plan, &learner, &process.stop, &mut |text| {
        if !*json {
            let _ = writeln!(std::io::stderr(), "{text}");
        }
    })?;
    say::either(*json, &report, tell)?;
    match report.verdict {
        Verdict::Walks | Verdict::Explained | Verdict::WalksWhenTrainedAgain => Ok(()),
        Verdict::Suspected => {
            Err(Failure::outcome(ExitCode::PartlyExplained, "no time to show what it is")
                .hint("give it more time with --budget"))
        }
        Verdict::Unexplained => Err(Failure::outcome(ExitCode::Unexplained, none(&report))),
    }
}

fn tell(report: &Report) {
    let behaviour = &report.behaviour;
    let signs: Vec<&str> = behaviour.signs.iter().map(|sign| sign.words()).collect();
    let does = match signs.as_slice() {
        _ if behaviour.walks() => "walks".to_owned(),
        [] => "does not walk".to_owned(),
        some => some.join(", "),
    };
    say::line(format_args!(
        "it {does}: {} of {} m/s, {:.0} % of episodes fall{}",
        short(behaviour.vx_mps),
        short(behaviour.command_mps),
        100.0 * behaviour.fall_share,
        behaviour.fell_by.as_ref().map_or_else(String::new, |reason| format!(" ({reason})"))
    ));
    let breaks_down = behaviour.fell_by.as_deref() == Some(TerminationReason::Diverged.name());
    if breaks_down {
        say::line(BREAKS_DOWN);
    }
    let none_suspect = report.causes.is_empty() && report.others.is_empty();
    say::line(match report.verdict {
        Verdict::Walks => "nothing to explain",
        Verdict::Explained => "most likely:",
        Verdict::WalksWhenTrainedAgain => {
            "trained again as it is, from another seed, it walks: train it again, or longer"
        }
        Verdict::Suspected if breaks_down && none_suspect => {
            "nothing else in its task or robot is suspect so far"
        }
        Verdict::Suspected if none_suspect => {
            "nothing in its task or robot is suspect so far; it may need a longer training"
        }
        Verdict::Suspected if report.causes.is_empty() => {
            "nothing was shown in this time (--budget); suspects:"
        }
        Verdict::Suspected => "nothing was shown in this time (--budget); most suspect:",
        Verdict::Unexplained => none(report),
    });
    report.causes.iter().for_each(show);
    if !report.causes.is_empty() {
        evidence(report);
    }
    if !report.others.is_empty() {
        if report.verdict != Verdict::Suspected || !report.causes.is_empty() {
            say::line("also suspect:");
        }
        report.others.iter().take(OTHERS).for_each(show);
    }
    if report.verdict != Verdict::Walks {
        say::line(format_args!("{} trainings, {:.0} s", report.trials.len(), report.seconds));
    }
}

fn none(report: &Report) -> &'static str {
    if report.causes.is_empty() && report.others.is_empty() { CLEAN } else { NONE }
}

fn show(cause: &Cause) {
    let refuted = match cause.helps {
        Some(false) => " (putting it right alone does not help)",
        _ => "",
    };
    say::line(format_args!("  {}{refuted}", cause.says));
    for change in &cause.change {
        let setting = change.split_once('=').is_some_and(|(key, _)| !key.contains(' '));
        match setting {
            true => say::line(format_args!("    --set '{change}'")),
            false => say::line(format_args!("    {change}")),
        }
    }
}

/// How it walks with the causes put right, and as it is.
fn evidence(report: &Report) {
    let ids: Vec<&str> = report.causes.iter().map(|cause| cause.id).collect();
    let with = |ids: &[&str]| report.trials.iter().rev().find(|t| t.put_right == ids);
    for (what, trial) in [("with that", with(&ids)), ("as it is", with(&[]))] {
        if let Some(trial) = trial {
            let done = &trial.behaviour;
            say::line(format_args!(
                "  {what}: {} of {} m/s, {:.0} % fall, after {} iterations from seed {}",
                short(done.vx_mps),
                short(done.command_mps),
                100.0 * done.fall_share,
                trial.iterations,
                trial.seed
            ));
        }
    }
}
