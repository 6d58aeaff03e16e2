//! Runs that repeat each other: who belongs together, and their mean.

use caudata_model::RobotModel;
use caudata_runlog::{JointConditions, LogMeta};

use crate::trial::{Channel, Force, Kind, Steps, Trial, YAW, nearest_turn};

/// Commands that differ by less than this are the same, rad (half a count of a 4096-count encoder).
const SAME_COMMAND_RAD: f64 = 0.0008;

/// Gives trials with the same commands the same group number.
pub fn group(model: &RobotModel, trials: &mut [Trial]) {
    let mut next = 0;
    for i in 0..trials.len() {
        let before = trials[..i].iter().find(|t| repeats(model, t, &trials[i]));
        trials[i].group = before.map_or_else(
            || {
                next += 1;
                next - 1
            },
            |t| t.group,
        );
    }
}

/// One trial per group of repeats: their mean at the stamps of the first, since what repeats agree on is what
/// a model can explain.
pub fn collapse(trials: &[Trial]) -> Vec<Trial> {
    let mut out: Vec<Trial> = Vec::new();
    for trial in trials {
        if out.iter().any(|t| t.group == trial.group && t.role == trial.role) {
            continue;
        }
        let members: Vec<Trial> = trials
            .iter()
            .filter(|t| t.group == trial.group && t.role == trial.role)
            .cloned()
            .collect();
        out.push(if members.len() == 1 { trial.clone() } else { mean(trial, members) });
    }
    out
}

fn mean(first: &Trial, members: Vec<Trial>) -> Trial {
    let n = members.len() as f64;
    let mut trial = first.clone();
    for channel in &mut trial.channels {
        // anything that not all of them have stays that of the first
        let others: Vec<(&Trial, &Channel)> = members
            .iter()
            .filter_map(|m| m.channel(channel.kind, channel.index).map(|c| (m, c)))
            .collect();
        if others.len() < members.len() {
            continue;
        }
        let yaw = (channel.kind, channel.index) == (Kind::BaseAttitude, YAW);
        for (k, t) in channel.time_s.iter().enumerate() {
            let since = t - first.span_s.0;
            let (mut sum, mut count) = (0.0, 0.0);
            for (m, c) in &others {
                let at = m.span_s.0 + since;
                if !m.is_left_out(at) {
                    let value = c.at(at);
                    // each run counts its turns from where it began
                    sum += if yaw { nearest_turn(value, channel.value[k]) } else { value };
                    count += 1.0;
                }
            }
            if count > 0.0 {
                channel.value[k] = sum / count;
            }
        }
    }
    let volts: Vec<f64> = members.iter().filter_map(|t| t.supply_v).collect();
    trial.supply_v = (!volts.is_empty()).then(|| volts.iter().sum::<f64>() / volts.len() as f64);
    trial.session = members.iter().map(|t| t.session).sum::<f64>() / n;
    // only what all members lack is missing; holes of the commands that are replayed stay
    trial.masked_s = Vec::new();
    trial.members = members;
    trial
}

/// Whether two runs of `model` were recorded under the same conditions; gains that are not noted are those of its
/// file.
pub(crate) fn same_conditions(model: &RobotModel, one: &LogMeta, other: &LogMeta) -> bool {
    let told = |meta: &LogMeta| {
        let gains = |(a, name): (usize, &str)| {
            let (kp, kd) = meta.gains(name);
            let kp = kp.or(Some(model.kp_nm_per_rad(a)));
            let kd = kd.or(Some(model.kd_nm_s_per_rad(a)));
            (
                name.to_owned(),
                JointConditions { kp, kd, ..meta.joint.get(name).copied().unwrap_or_default() },
            )
        };
        let joint = model.actuated_names().into_iter().enumerate().map(gains).collect();
        LogMeta { kp: None, kd: None, joint, ..meta.clone() }
    };
    told(one).same_conditions(&told(other))
}

/// Whether `other` was commanded the same under the same conditions, times counted from each one's start.
fn repeats(model: &RobotModel, own: &Trial, other: &Trial) -> bool {
    (own.duration_s() - other.duration_s()).abs() <= 0.1
        && same_conditions(model, &own.meta, &other.meta)
        && same_beside(own, other)
        && same_commands(own, other, |a| 10.0 * SAME_COMMAND_RAD * model.per_radian(a))
}

/// Whether two runs were sent the same, within so many rad or m of each joint, for as long as the shorter one
/// lasts; times counted from each one's start.
pub(crate) fn same_commands(own: &Trial, other: &Trial, within: impl Fn(usize) -> f64) -> bool {
    // both middle of holds and ramps: a stamp's jitter moves a step by a row, so allow some to disagree
    let differ = |(joint, (a, b)): (usize, (&Steps, &Steps))| {
        differ(own, other, |t| a.at(t), |t| b.at(t), within(joint))
    };
    let wrong: usize = own.commands.iter().zip(&other.commands).enumerate().map(differ).sum();
    wrong * 50 < own.commands.len() * MOMENTS
}

/// What was commanded beside positions, or pushed, differs by less than this share of the most of it.
const SAME_BESIDE: f64 = 0.05;

/// Whether the same speeds and torques were sent beside the positions, and the same forces acted.
fn same_beside(own: &Trial, other: &Trial) -> bool {
    let same = |a: &dyn Fn(f64) -> f64, b: &dyn Fn(f64) -> f64| {
        let most = (0..MOMENTS).map(|k| a(own.span_s.0 + moment_s(own, other, k)).abs());
        let most = most.fold(0.0, f64::max);
        differ(own, other, a, b, SAME_BESIDE * most) * 50 < MOMENTS
    };
    let sent = |(a, b): (&Option<Steps>, &Option<Steps>)| match (a, b) {
        (None, None) => true,
        (Some(a), Some(b)) => same(&|t| a.at(t), &|t| b.at(t)),
        _ => false,
    };
    let pushed = |(a, b): (&Force, &Force)| {
        let along = |axis: usize| same(&|t| a.at(t)[axis], &|t| b.at(t)[axis]);
        (a.link, a.at_m) == (b.link, b.at_m) && (0..3).all(along)
    };
    own.speeds.iter().zip(&other.speeds).all(sent)
        && own.torques.iter().zip(&other.torques).all(sent)
        && own.forces.len() == other.forces.len()
        && own.forces.iter().zip(&other.forces).all(pushed)
}

/// How often two runs are compared.
const MOMENTS: usize = 400;

/// Moment `k` of as many, from the start, s.
fn moment_s(own: &Trial, other: &Trial, k: usize) -> f64 {
    own.duration_s().min(other.duration_s()) * (k as f64 + 0.5) / MOMENTS as f64
}

/// In how many of the moments what two runs were sent differs by more than `within`, wherever up to 12 ms on either
/// side it is nearest.
fn differ(
    own: &Trial,
    other: &Trial,
    mine: impl Fn(f64) -> f64,
    theirs: impl Fn(f64) -> f64,
    within: f64,
) -> usize {
    let differs = |k: &usize| {
        let s = moment_s(own, other, *k);
        let there = theirs(other.span_s.0 + s);
        let near = (-6..=6)
            .map(|k| (mine(own.span_s.0 + s + 0.002 * f64::from(k)) - there).abs())
            .fold(f64::INFINITY, f64::min);
        near > within
    };
    (0..MOMENTS).filter(differs).count()
}

#[cfg(test)]
mod tests {
    use caudata_runlog::BaseHold;

    use super::*;

    fn turned(yaw_rad: [f64; 3]) -> Trial {
        let channel = |index, value: [f64; 3]| Channel {
            kind: Kind::BaseAttitude,
            index,
            name: String::new(),
            time_s: vec![0.0, 0.5, 1.0],
            value: value.to_vec(),
        };
        let channels = vec![channel(0, [0.1, 0.2, 0.3]), channel(YAW, yaw_rad)];
        Trial::bare(BaseHold::Water, 1.0, channels)
    }

    #[test]
    fn the_same_motion_under_another_weight_is_no_repeat() {
        let mut runs = [turned([0.0; 3]), turned([0.0; 3]), turned([0.0; 3])];
        runs[1].meta.payload.push(caudata_runlog::Payload {
            link: "hand".to_owned(),
            mass_kg: 1.0,
            at_m: [0.0; 3],
        });
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        let model = RobotModel::load(file.as_ref()).unwrap();
        // gains that are noted and those of the file are the same
        runs[2].meta.kp = Some(model.kp_nm_per_rad(0));
        group(&model, &mut runs);
        assert_eq!([0, 1, 2].map(|k| runs[k].group), [0, 1, 0]);
        runs[2].meta.kp = Some(0.5);
        group(&model, &mut runs);
        assert_eq!([0, 1, 2].map(|k| runs[k].group), [0, 1, 2]);
    }

    #[test]
    fn a_hole_in_the_commands_that_are_replayed_stays_in_the_mean() {
        let mut runs = [turned([0.0; 3]), turned([0.0; 3])];
        runs[0].masked_s.push((0.0, 0.2));
        runs[0].holes_s.push((0.4, 0.6));
        let mean = collapse(&runs).swap_remove(0);
        assert!(!mean.is_left_out(0.1) && mean.is_left_out(0.5) && !mean.is_left_out(0.7));
    }

    #[test]
    fn headings_on_both_sides_of_half_a_turn_have_the_mean_between_them() {
        // 3.1 and −3.1 rad are 0.083 rad apart: their mean is half a turn, not none
        let runs = [turned([3.1, 3.2, 3.3]), turned([-3.1, -3.0, -2.9])];
        let mean = collapse(&runs).swap_remove(0);
        let yaw = &mean.channel(Kind::BaseAttitude, YAW).unwrap().value;
        for (got, off) in yaw.iter().zip([0.0, 0.1, 0.2]) {
            assert!((got - std::f64::consts::PI - off).abs() < 1e-9, "{yaw:?}");
        }
        let level = &mean.channel(Kind::BaseAttitude, 0).unwrap().value;
        assert!((level[2] - 0.3).abs() < 1e-12);
    }
}
