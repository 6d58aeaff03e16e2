//! End stops of the robot file that measured angles pass. There the file is wrong whatever else is, and nothing is
//! to make up for it: such a stop is simulated nowhere, or, where a joint without it would go on and the measured
//! one does not, where that one stops.

use crate::effects::{PASSED_STOP, Place};
use crate::error::GapError;
use crate::replay::{Data, Replayer, Term, Variant};
use crate::report::DataFault;
use crate::trial::Kind;

/// What would go on farther without a stop, by this share of the range, is held by one.
const HELD: f64 = 0.01;
/// So many samples are no slip of the encoder.
const SAMPLES: usize = 5;
/// Without a stop that is passed, what is beyond it is off by less than this share (mean squares) of what it is with it.
const NEARER: f64 = 0.25;
/// Farther than any stop, rad or m.
const FARTHER: f64 = 10.0;

/// Stops of a joint that are passed.
#[derive(Debug, Clone)]
pub struct Passed {
    /// What is simulated in their place.
    pub term: Term,
    /// What is said of it.
    pub note: DataFault,
}

/// Where the stops of each joint are in a run, rad or m.
type Limits = Vec<(f64, f64)>;

/// How far angles go beyond the two stops of each joint: the farthest few samples, rad or m; below 0: not at all.
struct Beyond(Vec<[Vec<f64>; 2]>);

impl Beyond {
    fn of<X: Into<f64> + Copy>(limits: &[Limits], data: &Data, values: &[X]) -> Self {
        let mut all = vec![[Vec::new(), Vec::new()]; limits.first().map_or(0, Vec::len)];
        for (segment, piece) in data.parts().filter(|(_, p)| p.kind == Kind::Position) {
            let (low, high) = limits[segment.trial][piece.index];
            for k in piece.range.clone() {
                let at: f64 = values[k].into();
                for (side, over) in [low - at, at - high].into_iter().enumerate() {
                    if over > 0.0 {
                        all[piece.index][side].push(over);
                    }
                }
            }
        }
        for over in all.iter_mut().flatten() {
            over.sort_by(|a, b| b.total_cmp(a));
        }
        Self(all)
    }

    /// By how much, at the `rank`-th farthest.
    fn at(&self, joint: usize, side: usize, rank: usize) -> f64 {
        self.0[joint][side].get(rank).copied().unwrap_or(0.0)
    }
}

/// The joints of `trials` that pass a stop of the robot file where the simulated robot does not.
///
/// # Errors
/// As [`Replayer::predict`].
pub fn find(replayer: &Replayer, data: &Data) -> Result<Vec<Passed>, GapError> {
    let model = replayer.model();
    let limits: Vec<Limits> = (data.trials.iter())
        .map(|trial| {
            let plant = replayer.plant(trial, &[]);
            let joints = plant.lane.joints.iter();
            joints.map(|j| (f64::from(j.low_rad), f64::from(j.high_rad))).collect()
        })
        .collect();
    let Some(first) = limits.first() else { return Ok(Vec::new()) };
    let measured = Beyond::of(&limits, data, &data.value);
    // what matters of a stop, or a count, beyond what the simulated one gives way
    let least = |a: usize| PASSED_STOP.parameters[0].scale * model.per_radian(a);
    let passes = |a: usize| least(a).max(model.servo(a).encoder_lsb_rad());
    let may = |a: usize, s: usize| measured.at(a, s, SAMPLES) > passes(a);
    if !(0..first.len()).any(|a| may(a, 0) || may(a, 1)) {
        return Ok(Vec::new());
    }
    let run = |terms: Variant| Ok::<_, GapError>(replayer.predict(data, &[terms])?.swap_remove(0));
    let term = |a: usize, out: &dyn Fn(usize) -> f64| {
        let place = Place::of_joint(model, a);
        Term { effect: &PASSED_STOP, place, values: [0, 1].map(out).to_vec() }
    };
    let joints: Vec<usize> = (0..first.len()).filter(|a| may(*a, 0) || may(*a, 1)).collect();
    let without = |&a: &usize| term(a, &|s| if may(a, s) { FARTHER } else { 0.0 });
    let (with, free) = (run(Vec::new())?, run(joints.iter().map(without).collect())?);
    let off = [&with, &free].map(|simulated| off(&limits, data, simulated));
    let [simulated, free] = [with, free].map(|values| Beyond::of(&limits, data, &values));
    let passed = |a: usize, s: usize| {
        let farther = measured.at(a, s, SAMPLES) > simulated.at(a, s, 0) + passes(a);
        may(a, s) && (farther || off[1][a][s] < NEARER * off[0][a][s])
    };
    let told = |&a: &usize| {
        let unit = model.joints()[model.actuated()[a]].unit();
        let over = |s: usize| measured.at(a, s, 0);
        // farther without a stop than it was ever measured: there is one
        let held = |s: usize| free.at(a, s, SAMPLES) > over(s) + HELD * (first[a].1 - first[a].0);
        let sides = [0, 1].map(|s| passed(a, s));
        let ends = [0, 1].map(|s| sides[s] && held(s));
        let to = |s: usize| if held(s) { over(s) } else { FARTHER };
        let term = term(a, &|s| if sides[s] { to(s) } else { 0.0 });
        Passed { note: note(&term.place.names[0], unit, first[a], sides, ends, over), term }
    };
    Ok(joints.iter().filter(|a| passed(**a, 0) || passed(**a, 1)).map(told).collect())
}

/// Sum of the squares by which simulated angles are off where the measured ones are beyond each stop of each joint.
fn off(limits: &[Limits], data: &Data, simulated: &[f32]) -> Vec<[f64; 2]> {
    let mut all = vec![[0.0; 2]; limits.first().map_or(0, Vec::len)];
    for (segment, piece) in data.parts().filter(|(_, p)| p.kind == Kind::Position) {
        let (low, high) = limits[segment.trial][piece.index];
        for k in piece.range.clone() {
            let square = (data.value[k] - f64::from(simulated[k])).powi(2);
            let beyond = [data.value[k] < low, data.value[k] > high];
            let sums = all[piece.index].iter_mut().zip(beyond);
            sums.filter(|(_, beyond)| *beyond).for_each(|(sum, _)| *sum += square);
        }
    }
    all
}

fn note(
    joint: &str,
    unit: &str,
    (low, high): (f64, f64),
    sides: [bool; 2],
    ends: [bool; 2],
    over: impl Fn(usize) -> f64,
) -> DataFault {
    let reached = match sides {
        [true, false] => format!("{:.3} {unit}", low - over(0)),
        [false, true] => format!("{:.3} {unit}", high + over(1)),
        _ => format!("{:.3} and {:.3} {unit}", low - over(0), high + over(1)),
    };
    let simulated = match ends {
        [false, false] => "without this stop",
        _ if ends == sides => "with the stop where it was measured to stop",
        [true, _] => "with the lower stop where it was measured to stop, and without the upper one",
        _ => "with the upper stop where it was measured to stop, and without the lower one",
    };
    DataFault {
        kind: "range".to_owned(),
        location: joint.to_owned(),
        detail: format!(
            "reaches {reached}, past the end stop of the robot file ({low:.3} to {high:.3} {unit}), which the simulated robot does not: range or zero of the file, or the encoder, are wrong. It is simulated {simulated}, and so is the extended robot"
        ),
        fatal: false,
    }
}
