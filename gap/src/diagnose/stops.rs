//! End stops of the robot file that measured angles pass. There the file is wrong whatever else is, and nothing is
//! to make up for it: such a stop is simulated nowhere. Whether there is another one farther out the search says.

use crate::effects::{HARD_STOP, PASSED_STOP, Place};
use crate::error::GapError;
use crate::replay::{Data, Replayer, Term};
use crate::report::DataFault;
use crate::trial::{Kind, Trial};

/// So many samples are no slip of the encoder.
const SAMPLES: usize = 5;
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

impl Passed {
    /// The joint, policy order.
    pub fn joint(&self) -> usize {
        self.term.place.items[0]
    }
}

/// A stop beyond which a joint was measured.
struct Past {
    joint: usize,
    /// The lower one, or the upper one.
    side: usize,
    /// By how much, rad or m, and in which sample; farthest first.
    samples: Vec<(f64, usize)>,
}

/// Outwards at the lower and at the upper stop.
const OUT: [f64; 2] = [-1.0, 1.0];

/// The stops of the robot file beyond which joints were measured, by what a joint `passes` a stop with.
fn past(replayer: &Replayer, data: &Data, passes: impl Fn(usize) -> f64) -> Vec<Past> {
    let joints = |t: &Trial| replayer.plant(t, &[]).lane.joints.clone();
    let stops: Vec<_> = data.trials.iter().map(joints).collect();
    let of = |joint: usize| [0, 1].map(|side| Past { joint, side, samples: Vec::new() });
    let mut all: Vec<Past> = (0..replayer.model().actuated().len()).flat_map(of).collect();
    for (segment, piece) in data.parts().filter(|(_, p)| p.kind == Kind::Position) {
        let own = &stops[segment.trial][piece.index];
        for past in &mut all[2 * piece.index..2 * piece.index + 2] {
            let stop = f64::from([own.low_rad, own.high_rad][past.side]);
            let over = piece.range.clone().map(|k| (OUT[past.side] * (data.value[k] - stop), k));
            past.samples.extend(over.filter(|(over, _)| *over > passes(piece.index)));
        }
    }
    all.retain(|past| past.samples.len() > SAMPLES);
    for past in &mut all {
        past.samples.sort_by(|a, b| b.0.total_cmp(&a.0));
    }
    all
}

/// The joints that pass a stop of the robot file and are ahead of the robot with `terms` there, in the mean, by as much
/// as matters of a stop, or a count.
///
/// # Errors
/// As [`Replayer::predict`].
pub fn find(replayer: &Replayer, data: &Data, terms: &[Term]) -> Result<Vec<Passed>, GapError> {
    let model = replayer.model();
    let least = |a: usize| PASSED_STOP.parameters[0].scale * model.per_radian(a);
    let passes = |a: usize| least(a).max(model.servo(a).encoder_lsb_rad());
    let mut all = past(replayer, data, passes);
    if all.is_empty() {
        return Ok(Vec::new());
    }
    let simulated = replayer.predict(data, &[terms.to_vec()])?.swap_remove(0);
    all.retain(|past| {
        let ahead = |k: usize| OUT[past.side] * (data.value[k] - f64::from(simulated[k]));
        let sum: f64 = past.samples.iter().map(|(_, k)| ahead(*k)).sum();
        sum > passes(past.joint) * past.samples.len() as f64
    });
    let of_joint = |of: &[Past]| {
        let place = Place::of_joint(model, of[0].joint);
        let mut term = Term::nothing(model, &PASSED_STOP, place);
        of.iter().for_each(|past| term.values[past.side] = FARTHER);
        let stops = &replayer.plant(&data.trials[0], &[]).lane.joints[of[0].joint];
        let unit = model.joints()[model.actuated()[of[0].joint]].unit();
        let stops = [stops.low_rad, stops.high_rad].map(f64::from);
        Passed { note: note(&term.place.names[0], unit, stops, of), term }
    };
    Ok(all.chunk_by(|a, b| a.joint == b.joint).map(of_joint).collect())
}

/// The joints of `passed` that do not pass their stop if the robot has what was found beside other stops, `terms`: they
/// are as far as the simulated ones then.
///
/// # Errors
/// As [`Replayer::predict`].
pub fn met(
    replayer: &Replayer,
    data: &Data,
    passed: &[Passed],
    terms: &[Term],
) -> Result<Vec<usize>, GapError> {
    let other = |t: &&Term| t.effect.id != HARD_STOP.id;
    let found: Vec<Term> = terms.iter().filter(other).cloned().collect();
    if found.is_empty() {
        return Ok(Vec::new());
    }
    let still = find(replayer, data, &found)?;
    let joints = passed.iter().map(Passed::joint);
    Ok(joints.filter(|joint| still.iter().all(|s| s.joint() != *joint)).collect())
}

fn note(joint: &str, unit: &str, stops: [f64; 2], passed: &[Past]) -> DataFault {
    let at = |p: &Past| format!("{:.3}", stops[p.side] + OUT[p.side] * p.samples[SAMPLES].0);
    let reached = passed.iter().map(at).collect::<Vec<_>>().join(" and ");
    let [low, high] = stops;
    DataFault {
        kind: "range".to_owned(),
        location: joint.to_owned(),
        detail: format!(
            "reaches {reached} {unit}, past the end stop of the robot file ({low:.3} to {high:.3} {unit}), which the simulated robot does not: range or zero of the file, or the encoder, are wrong. It is simulated without this stop, and so is the extended robot, up to a `hard_stop` if one is found"
        ),
        fatal: false,
    }
}
