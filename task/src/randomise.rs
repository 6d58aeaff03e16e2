//! Randomisation of the physics: each episode runs on a slightly different robot.
//!
//! Draws are multipliers and offsets on the nominal robot; what they mean for an engine is the business of
//! `caudata-env`.

use caudata_declare::settings;
use caudata_random::Stream;
use serde::{Deserialize, Serialize};

use crate::error::{checks, within};
use crate::{PerJoint, TaskError};

settings! {
    /// Table `[task.randomisation]`: ranges [min, max] of uniform draws, once per episode. `[1, 1]` (or `[0,
    /// 0]` for offsets) leaves a quantity alone. Ranges too narrow: the policy fits one simulator; too wide:
    /// it walks carefully everywhere and well nowhere. The paper names the quantities, not their ranges; the
    /// defaults are what MuJoCo Playground and ToddlerBot use for robots with such servos.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct RandomisationConfig {
        /// Whether anything is randomised. Default true.
        pub enabled: bool = true,
        /// Factor on the friction of the feet. Default 0.6 to 1.2.
        pub foot_friction_scale: [f32; 2] = [0.6, 1.2],
        /// Factor on the friction of everything else. Default 0.7 to 1.3.
        pub body_friction_scale: [f32; 2] = [0.7, 1.3],
        /// Factor on the mass and inertia of all links together (payload). Default 0.95 to 1.1.
        pub total_mass_scale: [f32; 2] = [0.95, 1.1],
        /// Factor on the mass and inertia of each link, on top. Default 0.9 to 1.1.
        pub link_mass_scale: [f32; 2] = [0.9, 1.1],
        /// Shift of each link's centre of mass along each axis, m. Default ±0.003.
        pub com_offset_m: [f32; 2] = [-0.003, 0.003],
        /// Factor on each joint's friction loss. Default 0.5 to 2: dry friction is what models know least.
        pub joint_friction_scale: [f32; 2] = [0.5, 2.0],
        /// Factor on each joint's armature. Default 0.9 to 1.2.
        pub armature_scale: [f32; 2] = [0.9, 1.2],
        /// Factor on each joint's viscous damping. Default 0.7 to 1.3.
        pub damping_scale: [f32; 2] = [0.7, 1.3],
        /// Factor on each servo's Kp. Default 0.85 to 1.1.
        pub kp_scale: [f32; 2] = [0.85, 1.1],
        /// Factor on each servo's Kd. Default 0.85 to 1.15.
        pub kd_scale: [f32; 2] = [0.85, 1.15],
        /// Factor on all servos' torque limits (heat). Default 0.85 to 1.
        pub torque_scale: [f32; 2] = [0.85, 1.0],
        /// Factor on the supply voltage (battery charge). Default 0.85 to 1.02.
        pub supply_scale: [f32; 2] = [0.85, 1.02],
        /// Delay from a command to the servo acting on it, s. Default 0 to 0.02: bus and loop of the real
        /// robot.
        pub command_delay_s: [f32; 2] = [0.0, 0.02],
        /// Factor on the width of each backlash joint's play. Default 0.5 to 1.2.
        pub backlash_scale: [f32; 2] = [0.5, 1.2],
        /// Mass that the torso carries in the middle of its frame, kg. Default 0: nothing.
        pub payload_kg: [f32; 2] = [0.0, 0.0],
        /// Share of the episodes in which one servo, any of them, gives no torque (a torn cable), 0 to 1.
        /// Default 0. Too large: little is trained with all of them.
        pub limp_share: f32 = 0.0,
        /// Share of the episodes in which one servo, any of them, does not turn (a jammed gear), 0 to 1;
        /// together with `limp_share` at most 1. It stays where the episode begins. Default 0.
        pub stuck_share: f32 = 0.0,
    }
}

/// Longest command delay that may be asked for, s (engines keep a bounded history of commands).
const MAX_COMMAND_DELAY_S: f32 = 0.1;
/// Largest load that may be asked for, kg: as heavy as the heaviest robots that walk on legs.
const MAX_PAYLOAD_KG: f32 = 100.0;

impl RandomisationConfig {
    /// Draws which of `joints` servos fails, if any; takes nothing from `stream` where none may.
    fn failure(&self, joints: usize, stream: &mut Stream) -> Option<Failure> {
        if self.limp_share + self.stuck_share <= 0.0 || joints == 0 {
            return None;
        }
        let (drawn, joint) = (stream.uniform(0.0, 1.0), stream.below(joints as u64) as usize);
        if drawn < self.limp_share {
            return Some(Failure::Limp(joint));
        }
        (drawn < self.limp_share + self.stuck_share).then_some(Failure::Stuck(joint))
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        // A mass, gain or voltage of zero is no robot; friction, damping and play may vanish.
        let (positive, any) =
            ("must be [min, max] within 0.05 to 20", "must be [min, max] within 0 to 20");
        let delay = "must be [min, max] within 0 to 0.1 s";
        let share = |value: f32, most: f32| (0.0..=most).contains(&value);
        checks! {
            self, "randomisation.";
            total_mass_scale: within(self.total_mass_scale, 0.05, 20.0), positive;
            link_mass_scale: within(self.link_mass_scale, 0.05, 20.0), positive;
            kp_scale: within(self.kp_scale, 0.05, 20.0), positive;
            torque_scale: within(self.torque_scale, 0.05, 20.0), positive;
            supply_scale: within(self.supply_scale, 0.05, 20.0), positive;
            foot_friction_scale: within(self.foot_friction_scale, 0.0, 20.0), any;
            body_friction_scale: within(self.body_friction_scale, 0.0, 20.0), any;
            joint_friction_scale: within(self.joint_friction_scale, 0.0, 20.0), any;
            armature_scale: within(self.armature_scale, 0.0, 20.0), any;
            damping_scale: within(self.damping_scale, 0.0, 20.0), any;
            kd_scale: within(self.kd_scale, 0.0, 20.0), any;
            backlash_scale: within(self.backlash_scale, 0.0, 20.0), any;
            payload_kg: within(self.payload_kg, 0.0, MAX_PAYLOAD_KG), "must be [min, max] within 0 to 100 kg";
            com_offset_m: within(self.com_offset_m, -0.5, 0.5), "must be [min, max] within ±0.5 m";
            command_delay_s: within(self.command_delay_s, 0.0, MAX_COMMAND_DELAY_S), delay;
            limp_share: share(self.limp_share, 1.0), "must be 0 to 1";
            stuck_share: share(self.stuck_share, 1.0 - self.limp_share), "must be 0 to 1, with limp_share at most 1";
        }
    }
}

/// A servo that has failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Failure {
    /// This one (policy order) gives no torque.
    Limp(usize),
    /// This one (policy order) does not turn.
    Stuck(usize),
}

/// The physics of one episode, relative to the nominal robot.
#[derive(Clone, Debug, PartialEq)]
pub struct RandomDraw {
    /// Factor on the friction of the feet.
    pub foot_friction_scale: f32,
    /// Factor on the friction of everything else.
    pub body_friction_scale: f32,
    /// Factor on each link's mass and inertia. `[L]`
    pub link_mass_scale: Vec<f32>,
    /// Shift of each link's centre of mass, m, link frame. `[L]`
    pub com_offset_m: Vec<[f32; 3]>,
    /// Factor on each joint's friction loss.
    pub joint_friction_scale: PerJoint,
    /// Factor on each joint's armature.
    pub armature_scale: PerJoint,
    /// Factor on each joint's viscous damping.
    pub damping_scale: PerJoint,
    /// Factor on each servo's Kp.
    pub kp_scale: PerJoint,
    /// Factor on each servo's Kd.
    pub kd_scale: PerJoint,
    /// Factor on all torque limits.
    pub torque_scale: f32,
    /// Factor on the supply voltage.
    pub supply_scale: f32,
    /// Delay of commands, s.
    pub command_delay_s: f32,
    /// Factor on each backlash joint's play. `[B]`
    pub backlash_scale: Vec<f32>,
    /// Mass that the torso carries, kg.
    pub payload_kg: f32,
    /// A servo that has failed, if one has.
    pub failure: Option<Failure>,
}

impl RandomDraw {
    /// The nominal robot: every factor 1, every offset 0.
    pub fn nominal(links: usize, joints: usize, backlash_joints: usize) -> Self {
        let one = PerJoint::filled(joints, 1.0);
        Self {
            foot_friction_scale: 1.0,
            body_friction_scale: 1.0,
            link_mass_scale: vec![1.0; links],
            com_offset_m: vec![[0.0; 3]; links],
            joint_friction_scale: one,
            armature_scale: one,
            damping_scale: one,
            kp_scale: one,
            kd_scale: one,
            torque_scale: 1.0,
            supply_scale: 1.0,
            command_delay_s: 0.0,
            backlash_scale: vec![1.0; backlash_joints],
            payload_kg: 0.0,
            failure: None,
        }
    }

    /// Draws anew in place (the lengths stay); the nominal robot when randomisation is off.
    pub fn redraw(&mut self, config: &RandomisationConfig, stream: &mut Stream) {
        if !config.enabled {
            let (links, play) = (self.link_mass_scale.len(), self.backlash_scale.len());
            *self = Self::nominal(links, self.kp_scale.len(), play);
            return;
        }
        let mut draw = |[lo, hi]: [f32; 2]| stream.uniform(lo, hi);
        self.foot_friction_scale = draw(config.foot_friction_scale);
        self.body_friction_scale = draw(config.body_friction_scale);
        let total = draw(config.total_mass_scale);
        for scale in &mut self.link_mass_scale {
            *scale = total * draw(config.link_mass_scale);
        }
        for offset in self.com_offset_m.iter_mut().flatten() {
            *offset = draw(config.com_offset_m);
        }
        for i in 0..self.kp_scale.len() {
            self.joint_friction_scale[i] = draw(config.joint_friction_scale);
            self.armature_scale[i] = draw(config.armature_scale);
            self.damping_scale[i] = draw(config.damping_scale);
            self.kp_scale[i] = draw(config.kp_scale);
            self.kd_scale[i] = draw(config.kd_scale);
        }
        self.torque_scale = draw(config.torque_scale);
        self.supply_scale = draw(config.supply_scale);
        self.command_delay_s = draw(config.command_delay_s);
        for scale in &mut self.backlash_scale {
            *scale = draw(config.backlash_scale);
        }
        // where nothing is carried nothing is drawn, so that the draws after it stay what they are
        self.payload_kg = match config.payload_kg {
            [least, most] if most > 0.0 => draw([least, most]),
            _ => 0.0,
        };
        self.failure = config.failure(self.kp_scale.len(), stream);
    }
}

/// Draws the physics of one episode for a robot with `links` links, `joints` servos and `backlash_joints`
/// joints with play.
pub fn draw(
    config: &RandomisationConfig,
    stream: &mut Stream,
    links: usize,
    joints: usize,
    backlash_joints: usize,
) -> RandomDraw {
    let mut drawn = RandomDraw::nominal(links, joints, backlash_joints);
    drawn.redraw(config, stream);
    drawn
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_random::{Key, Purpose};

    fn stream() -> Stream {
        Stream::new(Key::for_run(11), Purpose::Randomisation)
    }

    #[test]
    fn draws_stay_within_their_ranges_and_use_them() {
        let config = RandomisationConfig::default();
        let mut stream = stream();
        let draws: Vec<_> = (0..300).map(|_| draw(&config, &mut stream, 19, 16, 4)).collect();
        let spans = |get: &dyn Fn(&RandomDraw) -> f32, [lo, hi]: [f32; 2]| {
            let values: Vec<f32> = draws.iter().map(get).collect();
            let (min, max) =
                values.iter().fold((f32::MAX, f32::MIN), |(a, b), &v| (a.min(v), b.max(v)));
            let slack = 0.05 * (hi - lo);
            assert!(min >= lo - 1e-6 && min < lo + slack, "{min} against {lo}");
            assert!(max <= hi + 1e-6 && max > hi - slack, "{max} against {hi}");
        };
        spans(&|d| d.foot_friction_scale, config.foot_friction_scale);
        spans(&|d| d.body_friction_scale, config.body_friction_scale);
        spans(&|d| d.com_offset_m[18][2], config.com_offset_m);
        spans(&|d| d.joint_friction_scale[15], config.joint_friction_scale);
        spans(&|d| d.armature_scale[0], config.armature_scale);
        spans(&|d| d.damping_scale[3], config.damping_scale);
        spans(&|d| d.kp_scale[7], config.kp_scale);
        spans(&|d| d.kd_scale[8], config.kd_scale);
        spans(&|d| d.torque_scale, config.torque_scale);
        spans(&|d| d.supply_scale, config.supply_scale);
        spans(&|d| d.command_delay_s, config.command_delay_s);
        spans(&|d| d.backlash_scale[3], config.backlash_scale);
        assert!(draws.iter().all(|d| d.payload_kg == 0.0));
        // Ratio of two links' factors: the payload cancels, 0.9/1.1 to 1.1/0.9 remain.
        for d in &draws {
            let ratio = d.link_mass_scale[0] / d.link_mass_scale[5];
            assert!((0.81..1.23).contains(&ratio));
        }
    }

    #[test]
    fn a_load_is_drawn_after_all_else() {
        let empty = RandomisationConfig::default();
        let laden = RandomisationConfig { payload_kg: [0.1, 0.3], ..empty };
        let (mut with, without) =
            (draw(&laden, &mut stream(), 19, 16, 4), draw(&empty, &mut stream(), 19, 16, 4));
        assert!((0.1..=0.3).contains(&with.payload_kg));
        with.payload_kg = 0.0;
        assert_eq!(with, without);
        let negative = RandomisationConfig { payload_kg: [-0.1, 0.3], ..empty };
        assert!(negative.validate().is_err());
    }

    #[test]
    fn servos_fail_as_often_as_asked_and_any_of_them() {
        let config = RandomisationConfig {
            limp_share: 0.3,
            stuck_share: 0.5,
            ..RandomisationConfig::default()
        };
        config.validate().unwrap();
        let mut stream = stream();
        let (mut limp, mut stuck) = ([0; 16], [0; 16]);
        for _ in 0..2000 {
            match draw(&config, &mut stream, 19, 16, 4).failure {
                Some(Failure::Limp(joint)) => limp[joint] += 1,
                Some(Failure::Stuck(joint)) => stuck[joint] += 1,
                None => {}
            }
        }
        // 600 and 1,000 of 2,000, standard deviations 20 and 22
        let (limps, stucks): (i32, i32) = (limp.iter().sum(), stuck.iter().sum());
        assert!((limps - 600).abs() < 100 && (stucks - 1000).abs() < 110, "{limps} {stucks}");
        assert!(limp.iter().chain(&stuck).all(|&n| n > 0), "{limp:?} {stuck:?}");
        let more_than_all = RandomisationConfig { limp_share: 0.6, ..config };
        assert!(more_than_all.validate().is_err());
    }

    #[test]
    fn switched_off_is_the_nominal_robot() {
        let config = RandomisationConfig { enabled: false, ..RandomisationConfig::default() };
        assert_eq!(draw(&config, &mut stream(), 19, 16, 4), RandomDraw::nominal(19, 16, 4));
        let mut used = draw(&RandomisationConfig::default(), &mut stream(), 19, 16, 4);
        used.redraw(&config, &mut stream());
        assert_eq!(used, RandomDraw::nominal(19, 16, 4));
    }

    #[test]
    fn the_same_stream_gives_the_same_robot() {
        let config = RandomisationConfig::default();
        assert_eq!(
            draw(&config, &mut stream(), 19, 16, 4),
            draw(&config, &mut stream(), 19, 16, 4)
        );
    }

    #[test]
    fn values_out_of_range_are_named() {
        let good = RandomisationConfig::default();
        good.validate().unwrap();
        let bad = [
            (RandomisationConfig { kp_scale: [0.0, 1.0], ..good }, "randomisation.kp_scale"),
            (RandomisationConfig { kd_scale: [-0.1, 1.0], ..good }, "randomisation.kd_scale"),
            (
                RandomisationConfig { com_offset_m: [0.1, -0.1], ..good },
                "randomisation.com_offset_m",
            ),
            (
                RandomisationConfig { command_delay_s: [0.0, 0.2], ..good },
                "randomisation.command_delay_s",
            ),
            (
                RandomisationConfig { link_mass_scale: [f32::NAN, 1.0], ..good },
                "randomisation.link_mass_scale",
            ),
        ];
        for (config, name) in bad {
            let error = config.validate().unwrap_err();
            assert!(matches!(&error, TaskError::Config { field, .. } if *field == name), "{error}");
        }
    }
}
