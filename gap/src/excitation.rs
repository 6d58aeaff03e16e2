//! What the runs excite: speeds, loads, durations, channels.

use std::collections::BTreeSet;

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;

use crate::place::{Domain, Place};
use crate::trial::{Kind, Steps, Trial};

/// One joint's part in the runs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JointExcitation {
    /// 99th percentile of its speed, rad/s, of a slide what counts as a radian.
    pub fastest_radps: f64,
    /// Lowest and highest position, rad or m; nothing in between where it was not measured.
    pub range_rad: (f64, f64),
    /// Largest product of gain and error over the servo's largest torque.
    pub most_torque_share: f64,
    /// Largest gain on its speed, N·m·s/rad or N·s/m.
    pub kd_nms_per_rad: f64,
    /// Largest torque that is commanded beside its position, N·m or N.
    pub fed_nm: f64,
    /// Largest speed that is, where Kd heeds it, rad/s or m/s.
    pub fed_radps: f64,
}

/// What runs excite.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Excitation {
    /// Per actuated joint.
    pub joints: Vec<JointExcitation>,
    /// Kinds of channels that at least one run has.
    pub kinds: BTreeSet<Kind>,
    /// Fastest mean change of a command over 0.1 s, likewise.
    pub fastest_command_radps: f64,
    /// Longest run, s.
    pub longest_s: f64,
    /// Largest part of a force from outside along an axis, N.
    pub outer_n: f64,
    /// Number of runs.
    pub runs: usize,
    /// Whether a run stands on the ground.
    pub on_ground: bool,
    /// Whether a run is in the water.
    pub in_water: bool,
}

impl Excitation {
    /// What `trials` excite.
    pub fn of(model: &RobotModel, trials: &[&Trial]) -> Self {
        let mut all = Self {
            joints: vec![
                JointExcitation {
                    range_rad: (f64::INFINITY, f64::NEG_INFINITY),
                    ..JointExcitation::default()
                };
                model.actuated().len()
            ],
            runs: trials.len(),
            ..Self::default()
        };
        for trial in trials {
            all.longest_s = all.longest_s.max(trial.duration_s());
            all.on_ground |= trial.base == BaseHold::Free;
            all.in_water |= trial.base == BaseHold::Water;
            all.kinds.extend(trial.channels.iter().map(|c| c.kind));
            for (a, command) in trial.commands.iter().enumerate() {
                let (mut t, span) = (trial.span_s.0, 0.1);
                while t + span <= trial.span_s.1 {
                    let far = (command.at(t + span) - command.at(t)).abs();
                    let rate = far / (span * model.per_radian(a));
                    all.fastest_command_radps = all.fastest_command_radps.max(rate);
                    t += span;
                }
            }
            let outer = trial.forces.iter().flat_map(|f| &f.axes).flat_map(|axis| &axis.1);
            all.outer_n = outer.fold(all.outer_n, |most, f| most.max(f.abs()));
            for (a, joint) in all.joints.iter_mut().enumerate() {
                let most = |of: &[Option<Steps>]| {
                    let values = of.get(a).and_then(Option::as_ref).map_or(&[][..], |s| &s.value);
                    values.iter().fold(0.0, |most: f64, v| most.max(v.abs()))
                };
                joint.fed_nm = joint.fed_nm.max(most(&trial.torques));
                let kd = trial.meta.gains(model.actuated_names()[a]).1;
                let kd = kd.unwrap_or(model.kd_nm_s_per_rad(a));
                joint.kd_nms_per_rad = joint.kd_nms_per_rad.max(kd);
                // without damping a speed does nothing
                if kd > 0.0 {
                    joint.fed_radps = joint.fed_radps.max(most(&trial.speeds));
                }
            }
            for channel in trial.channels.iter().filter(|c| c.kind == Kind::Position) {
                let joint = &mut all.joints[channel.index];
                let name = model.actuated_names()[channel.index];
                let kp = trial.meta.gains(name).0.unwrap_or(model.kp_nm_per_rad(channel.index));
                let command = &trial.commands[channel.index];
                let fed = trial.torques.get(channel.index).and_then(Option::as_ref);
                let mut speeds = Vec::new();
                for (k, (&t, &q)) in channel.time_s.iter().zip(&channel.value).enumerate() {
                    joint.range_rad.0 = joint.range_rad.0.min(q);
                    joint.range_rad.1 = joint.range_rad.1.max(q);
                    let fed_nm = fed.map_or(0.0, |fed| fed.at(t));
                    let torque = (kp * (command.at(t) - q) + fed_nm).abs();
                    let share = torque / model.servo(channel.index).tau_max_nm;
                    joint.most_torque_share = joint.most_torque_share.max(share);
                    // over 40 ms or more: a count of the encoder is no speed
                    let later = channel.time_s[k..].partition_point(|&x| x < t + 0.04) + k;
                    if later < channel.value.len() {
                        speeds.push((channel.value[later] - q).abs() / (channel.time_s[later] - t));
                    }
                }
                speeds.sort_by(f64::total_cmp);
                let high = speeds.get(speeds.len() * 99 / 100).copied().unwrap_or(0.0);
                joint.fastest_radps =
                    joint.fastest_radps.max(high / model.per_radian(channel.index));
            }
        }
        all
    }

    /// Whether a kind of channel was recorded.
    pub fn has(&self, kind: Kind) -> bool {
        self.kinds.contains(&kind)
    }

    /// Fastest of the joints at `place`, rad/s.
    pub fn fastest_radps(&self, place: &Place) -> f64 {
        self.most(place, |j| j.fastest_radps)
    }

    /// Hardest-working of the joints at `place`.
    pub fn most_torque_share(&self, place: &Place) -> f64 {
        self.most(place, |j| j.most_torque_share)
    }

    fn most(&self, place: &Place, f: impl Fn(&JointExcitation) -> f64) -> f64 {
        let at = |a: usize| place.domain != Domain::Joints || place.items.contains(&a);
        (self.joints.iter().enumerate())
            .filter(|(a, _)| at(*a))
            .map(|(_, j)| f(j))
            .fold(0.0, f64::max)
    }
}
