//! An observation of one's own: what of the standard one is nowhere in it, and what drowns in its noise.
//!
//! The run's observation and the standard one are watched over the same motion (the robot does not see here, so
//! the motion is the same): what of the standard one correlates with nothing in the run's is not seen, be it left
//! out, dead, or another quantity under its name. A permutation that stays the same is no mistake: a network
//! learns it.

use std::ops::Range;
use std::sync::Arc;

use caudata_actor::build_env;
use caudata_config::Config;
use caudata_task::layout::Part;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

use crate::behaviour::{Behaviour, Sign};
use crate::run::Run;
use crate::suspect::{Edit, Seen, Suspect};

/// Environments and control steps that are watched.
const WATCHED: (u32, usize) = (16, 60);
/// Key of the random streams: no actor of a training has it.
const KEY: u64 = u64::MAX / 2;
/// Correlation from which two values are the same quantity.
const SAME: f64 = 0.9;
/// Noise of a term over the spread of its value from which it says nothing.
const DROWNS: f64 = 2.0;

/// Each part of the standard observation, how suspect its absence is, and what a robot does without it.
const PARTS: [(Part, f64, &[Sign]); 7] = [
    (Part::Command, 2.5, &[Sign::IgnoresCommand, Sign::StandsStill, Sign::Slow]),
    (Part::Phase, 2.5, &[Sign::StandsStill, Sign::FewerLegs, Sign::Vibrates]),
    (Part::JointPos, 1.5, &[Sign::StandsStill, Sign::Falls]),
    (Part::JointVel, 1.1, &[Sign::Vibrates, Sign::Falls]),
    (Part::Gravity, 1.2, &[Sign::Falls, Sign::Turns]),
    (Part::Gyro, 1.0, &[Sign::Turns, Sign::Falls]),
    (Part::Actions, 1.0, &[Sign::Vibrates]),
];

/// What was watched: values over time, one row per observed value.
struct Watched {
    rows: Vec<Vec<f64>>,
    slices: Vec<(String, Range<usize>)>,
}

/// Watches the observation of a configuration, without noise, over a motion that depends on nothing in it.
fn watch(run: &Run, config: &Config) -> Result<Watched, Failure> {
    let mut config = config.clone();
    (config.actors.lanes, config.actors.threads) = (WATCHED.0, 1);
    let task = &mut config.task;
    task.noise.enabled = false;
    task.push.enabled = false;
    task.observation.term.iter_mut().for_each(|term| term.noise_std = 0.0);
    let mut env = build_env(&config, Arc::clone(&run.model), KEY).map_err(|e| e.into_failure())?;
    let (lanes, width, joints) = (env.lanes(), env.obs_dim(), env.act_dim());
    let mut rows = vec![Vec::new(); width];
    for step in 0..WATCHED.1 {
        let action = |k: usize| {
            let (lane, joint) = (k / joints, k % joints);
            let hz = 0.5 + 0.31 * joint as f32 + 0.17 * lane as f32;
            0.5 * (0.1257 * hz * step as f32 + (3 * joint + 5 * lane) as f32).sin()
        };
        let actions: Vec<f32> = (0..lanes * joints).map(action).collect();
        env.step(&actions).or_exit(ExitCode::Internal)?;
        for (k, value) in env.observations().iter().enumerate() {
            rows[k % width].push(f64::from(*value));
        }
    }
    let slices = env.contract().observation.slices().iter();
    let slices = slices.map(|s| (s.name.clone(), s.start..s.start + s.width()));
    Ok(Watched { slices: slices.collect(), rows })
}

fn moments(row: &[f64]) -> (f64, f64) {
    let n = row.len().max(1) as f64;
    let mean = row.iter().sum::<f64>() / n;
    let square = row.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
    (mean, square.sqrt())
}

/// Correlation, without its sign; 0 where one is constant.
fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let ((mean_a, std_a), (mean_b, std_b)) = (moments(a), moments(b));
    let pairs = a.iter().zip(b);
    let joint: f64 = pairs.map(|(x, y)| (x - mean_a) * (y - mean_b)).sum();
    if std_a * std_b > 1e-12 { (joint / (a.len() as f64 * std_a * std_b)).abs() } else { 0.0 }
}

/// The suspects in the observation; none where it is the standard one.
///
/// # Errors
/// Where the environments cannot be built or stepped.
pub fn suspects(run: &Run, behaviour: &Behaviour) -> Result<Vec<Suspect>, Failure> {
    let terms = &run.config.task.observation.term;
    if terms.is_empty() || *terms == run.reference.task.observation.term {
        return Ok(Vec::new());
    }
    let mut standard = run.config.clone();
    standard.task.observation.term.clear();
    let (own, standard) = (watch(run, &run.config)?, watch(run, &standard)?);
    let mut all = Vec::new();
    for (part, suspicion, leads) in PARTS {
        let slice = standard.slices.iter().find(|(name, _)| name == part.name());
        let Some((name, range)) = slice else { continue };
        // what does not change in this motion cannot be missed in it
        let moving = range.clone().filter(|i| moments(&standard.rows[*i]).1 > 1e-6);
        let seen = |i: &usize| own.rows.iter().any(|r| correlation(r, &standard.rows[*i]) > SAME);
        let (there, missing): (Vec<usize>, Vec<usize>) = moving.partition(seen);
        if missing.len() <= there.len() {
            continue;
        }
        let under_its_name = terms.iter().any(|term| term.name == *name);
        let suspect = Suspect {
            id: if under_its_name { "observation_dead" } else { "observation_missing" },
            keys: vec![format!("task.observation.term.{name}")],
            says: match under_its_name {
                true => {
                    format!("the observation's term {name} does not show what it is named after")
                }
                false => format!("the policy does not see {name}"),
            },
            edit: Edit::Observe { name: name.clone(), value: Seen::BuiltIn },
            suspicion: suspicion + if under_its_name { 1.0 } else { 0.0 },
        };
        all.push(suspect.seen_in(leads, behaviour));
    }
    for term in terms.iter().filter(|term| term.noise_std > 0.0) {
        let slice = own.slices.iter().find(|(name, _)| *name == term.name);
        let spread = slice.map_or(0.0, |(_, range)| {
            let all = range.clone().map(|i| moments(&own.rows[i]).1);
            all.sum::<f64>() / range.len().max(1) as f64
        });
        let ratio = f64::from(term.noise_std) / spread.max(1e-6);
        if ratio > DROWNS {
            all.push(Suspect {
                id: "observation_noise",
                keys: vec![format!("task.observation.term.{}", term.name)],
                says: format!(
                    "the observation's term {} drowns in its noise ({} for a spread of {spread:.2})",
                    term.name, term.noise_std
                ),
                edit: Edit::Observe {
                    name: term.name.clone(),
                    value: Seen::Quiet,
                },
                suspicion: 1.0 + (ratio / DROWNS).ln().min(2.0),
            });
        }
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::correlation;

    #[test]
    fn the_same_quantity_is_found_whatever_its_scale_and_sign() {
        let a = [0.0, 1.0, 0.0, -1.0];
        assert!((correlation(&a, &[5.0, 3.0, 5.0, 7.0]) - 1.0).abs() < 1e-12);
        assert_eq!(correlation(&a, &[1.0, 0.0, -1.0, 0.0]), 0.0);
        assert_eq!(correlation(&a, &[2.0; 4]), 0.0);
    }
}
