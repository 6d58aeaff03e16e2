//! Reward terms and conditions that the task file brings along: which of them pay for the wrong thing.

use caudata_task::expression::SIGNALS;
use serde_json::Value;

use crate::behaviour::{Behaviour, Sign};
use crate::run::{Run, assignment};
use crate::suspect::{Edit, Suspect};

/// Signals that say how much is spent, so that a sum of them is a cost.
const SPENT: [&str; 9] = [
    "power",
    "torque",
    "joint_vel",
    "previous_joint_vel",
    "action",
    "previous_action",
    "foot_speed",
    "trunk_force",
    "contact",
];
/// Signals that the robot's motion does not change.
const GIVEN: [&str; 9] = [
    "command_vx",
    "command_vy",
    "command_yaw_rate",
    "phase",
    "clock",
    "standing",
    "nominal",
    "lower",
    "upper",
];
/// Share of everything that is paid and charged from which a term decides what the robot does.
const DECIDES: f64 = 0.25;

/// Names of signals in an expression, each once.
pub(crate) fn signals(expression: &str) -> Vec<&'static str> {
    let words: Vec<&str> =
        expression.split(|c: char| !c.is_ascii_alphanumeric() && c != '_').collect();
    let known = SIGNALS.iter().map(|signal| signal.name);
    known.filter(|name| words.contains(name)).collect()
}

/// Each term's share of what the run was paid and charged at its end, if the folder says so.
fn shares(run: &Run) -> Vec<(String, f64)> {
    let text = std::fs::read_to_string(run.folder.join("progress.jsonl")).unwrap_or_default();
    let last = text.lines().rev().find_map(|line| {
        let event: Value = serde_json::from_str(line).ok()?;
        event.get("reward_terms")?.as_object().cloned()
    });
    let last = last.unwrap_or_default();
    let paid = |value: &Value| value.as_f64().unwrap_or(0.0).abs();
    let all: f64 = last.values().map(paid).sum();
    let share = |(name, value): (&String, &Value)| (name.clone(), paid(value) / all.max(1e-9));
    last.iter().map(share).collect()
}

/// A reward term of the task file's own: what is wrong with it, how suspect, and the weight that it should have.
fn wrong_term(value: &str, weight: f32) -> (&'static str, f64, &'static str, Option<f32>) {
    let names = signals(value);
    let all_in = |known: &[&str]| names.iter().all(|name| known.contains(name));
    let across = value.replace(' ', "");
    let [x, y] = ["velocity.x", "velocity.y"].map(|v| across.contains(v));
    let frame = (y && !x && names.contains(&"command_vx"))
        || (x && !y && names.contains(&"command_vy"))
        || (across.contains("velocity.z") && names.iter().any(|n| n.starts_with("command")));
    let falls_off = across.contains("exp(-") || across.starts_with('-') || across.contains('<');
    match () {
        () if frame => (
            "term_in_wrong_frame",
            3.0,
            "compares a velocity with the command of another axis",
            None,
        ),
        () if all_in(&GIVEN) && weight < 0.0 => (
            "living_costs",
            2.0,
            "charges every step whatever the robot does, so that ending the episode pays",
            None,
        ),
        () if all_in(&GIVEN) => (
            "term_ignores_motion",
            1.0,
            "pays whatever the robot does: it looks at the command, not at the motion",
            None,
        ),
        () if all_in(&SPENT) && weight > 0.0 && !falls_off => {
            ("cost_pays", 2.0, "is a cost, and its weight makes it pay", Some(-weight))
        }
        () => ("own_term", 0.5, "may pay for something else than walking", None),
    }
}

/// The suspects among the task file's own terms and conditions.
pub fn suspects(run: &Run, behaviour: &Behaviour) -> Vec<Suspect> {
    let (own, reference) = (&run.config.task, &run.reference.task);
    let shares = shares(run);
    let mut all = Vec::new();
    let mut tracks = Vec::new();
    for term in &own.reward.term {
        if reference.reward.term.contains(term) {
            continue;
        }
        let (id, mut suspicion, what, weight) = wrong_term(&term.value, term.weight);
        let share = shares.iter().find(|(name, _)| *name == term.name);
        if share.is_some_and(|(_, share)| *share > DECIDES) {
            suspicion += 0.6;
        }
        let edit = Edit::Term { table: "task.reward.term", name: term.name.clone(), weight };
        if signals(&term.value).iter().any(|n| n.starts_with("command")) {
            tracks.push(edit.clone());
        }
        all.push(Suspect {
            id,
            keys: vec![format!("task.reward.term.{}", term.name)],
            says: format!("the reward term {} = `{}` {what}", term.name, term.value),
            edit,
            suspicion,
        });
    }
    all.extend(replaced_tracking(run, tracks));
    for when in &own.termination.when {
        if reference.termination.when.contains(when) {
            continue;
        }
        let by_condition = behaviour.fell_by.as_deref() == Some("condition");
        let suspect = Suspect {
            id: "own_condition",
            keys: vec![format!("task.termination.when.{}", when.name)],
            says: format!(
                "the condition {} = `{}` ends episodes in which nothing has failed",
                when.name, when.value
            ),
            edit: Edit::Term {
                table: "task.termination.when",
                name: when.name.clone(),
                weight: None,
            },
            suspicion: if by_condition { 3.0 } else { 0.9 },
        };
        all.push(suspect.seen_in(&[Sign::Falls], behaviour));
    }
    all
}

/// Where the built-in reward for velocity was taken out and a term of the task file's own stands for it.
fn replaced_tracking(run: &Run, tracks: Vec<Edit>) -> Option<Suspect> {
    const KEY: &str = "task.reward.weights.tracking_lin_vel";
    let weight = |config: &caudata_config::Config| config.task.reward.weights.tracking_lin_vel;
    let (is, was) = (weight(&run.config), weight(&run.reference));
    if tracks.is_empty() || is > was / 3.0 {
        return None;
    }
    let name = |edit: &Edit| match edit {
        Edit::Term { name, .. } => name.clone(),
        _ => String::new(),
    };
    let names: Vec<String> = tracks.iter().map(name).collect();
    let mut keys: Vec<String> = names.iter().map(|n| format!("task.reward.term.{n}")).collect();
    keys.push(KEY.to_owned());
    let mut edits = tracks;
    edits.push(Edit::Set(vec![assignment(KEY, &was.to_string())]));
    Some(Suspect {
        id: "tracking_replaced",
        keys,
        says: format!(
            "{} stands for the reward for velocity, and does not pay for following the command",
            names.join(", ")
        ),
        edit: Edit::All(edits),
        suspicion: 4.0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_terms_are_told_apart_by_what_they_read() {
        let id = |value: &str, weight: f32| wrong_term(value, weight).0;
        assert_eq!(id("sum(abs(power))", 0.1), "cost_pays");
        assert_eq!(id("sum(abs(power))", -0.1), "own_term");
        assert_eq!(id("exp(-sum(torque ^ 2))", 0.1), "own_term");
        assert_eq!(id("command_vx", 1.0), "term_ignores_motion");
        assert_eq!(id("1", -5.0), "living_costs");
        assert_eq!(id("exp(-(velocity.y - command_vx)^2 / 0.05)", 3.0), "term_in_wrong_frame");
        assert_eq!(id("exp(-(velocity.x - command_vx)^2 / 0.05)", 3.0), "own_term");
    }
}
