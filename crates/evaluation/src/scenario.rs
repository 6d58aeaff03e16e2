//! One kind of episode: ground, command, disturbances, and what it is for.

use caudata_declare::settings;
use caudata_sim::{TerrainConfig, TerrainKind};
use caudata_task::command::yaw_rate_towards;
use caudata_task::push::PushConfig;
use caudata_task::randomise::RandomisationConfig;
use serde::Serialize;

settings! {
    /// One kind of episode.
    #[derive(Clone, Debug, PartialEq)]
    pub struct Scenario {
        /// Its name in results.
        pub name: String,
        /// Commands (vx, vy in m/s, yaw rate in rad/s) that episodes follow in turn.
        pub commands: Vec<[f32; 3]>,
        /// The ground.
        pub terrain: TerrainConfig,
        /// Start positions within ± this, m.
        pub spawn_half_extent_m: f32,
        /// Around what.
        pub start: Start,
        /// What is commanded instead, in order of time. Empty: the command alone.
        pub course: Vec<Leg>,
        /// Length of its episodes, s; `None`: as the settings say.
        pub episode_s: Option<f64>,
        /// The robot's parameters.
        pub corner: Corner,
        /// Pushes, if any.
        pub push: Option<PushConfig>,
        /// Whether episodes begin in any attitude, as a robot lies that was thrown.
        pub fallen: bool,
        /// Whether it must pass the gates to count as walking (standing still need not).
        pub judged: bool = true,
        /// Where it must get to, if anywhere.
        pub goal: Option<Goal>,
        /// Which episode reports show, if any: single corners look alike, and a page must stay small.
        pub film: Option<usize> = Some(0),
    }
}

impl Scenario {
    /// An undisturbed walk on flat ground at a constant command.
    pub fn walk(name: &str, command: [f32; 3]) -> Self {
        Self { name: name.to_owned(), commands: vec![command], ..Self::default() }
    }

    /// As a training is judged: [`Self::walk`], or in its deep water, where no gate is asked for.
    pub fn trained(name: &str, command: [f32; 3], terrain: &TerrainConfig) -> Self {
        let walk = Self::walk(name, command);
        match terrain.is_deep_water() {
            true => Self { terrain: terrain.clone(), judged: false, ..walk },
            false => walk,
        }
    }

    /// Whether the ground is flat, so that a trunk on it is a fault.
    pub fn is_flat(&self) -> bool {
        self.terrain.kind == TerrainKind::Flat
    }
}

/// Place and heading around which episodes start.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Start {
    /// World x and y of the base, m.
    pub xy_m: [f32; 2],
    /// Heading, rad.
    pub yaw_rad: f32,
    /// Headings are drawn within ± this, rad; `None`: as in training.
    pub yaw_range_rad: Option<f32>,
}

/// What is commanded from a time on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Leg {
    /// From when on, s.
    pub from_s: f64,
    /// What.
    pub order: Order,
}

/// What a leg asks for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Order {
    /// This command: vx, vy (m/s), yaw rate (rad/s).
    Command([f32; 3]),
    /// To keep a heading (world, rad), as a person with a joystick would ([`yaw_rate_towards`]): the
    /// episode's vx and vy, and a yaw rate within [`Leg::MOST_RADPS`].
    Heading(f32),
}

impl Leg {
    /// Largest yaw rate that is asked for to keep a heading, rad/s: the omni grid's.
    pub const MOST_RADPS: f32 = 0.6;

    /// The command at `time_s` and `heading_rad` in an episode that began with `first`; `None` without legs.
    pub fn command(
        legs: &[Self],
        first: [f32; 3],
        time_s: f64,
        heading_rad: f32,
    ) -> Option<[f32; 3]> {
        let leg = legs.iter().rev().find(|leg| leg.from_s <= time_s)?;
        Some(match leg.order {
            Order::Command(command) => command,
            Order::Heading(wanted_rad) => {
                let most = Self::MOST_RADPS;
                let yaw_radps = yaw_rate_towards(wanted_rad, heading_rad, [-most, most]);
                [first[0], first[1], yaw_radps]
            }
        })
    }
}

/// Where an episode must get to. At a shore land lies at small x, water at large x.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Goal {
    /// The centre of mass a body length beyond the waterline.
    IntoWater,
    /// The centre of mass half a body length before the waterline.
    OntoLand,
    /// First the one, then the other.
    ThereAndBack,
    /// Four fifths of the way that the command asks for, without a fall, on any ground.
    Ahead,
}

settings! {
    /// A robot that differs from its file in a few known ways; by default in none.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize)]
    pub struct Corner {
        /// Delay of commands, s.
        pub command_delay_s: f32,
        /// Factor on the friction of the feet.
        pub foot_friction_scale: f32 = 1.0,
        /// Factor on Kp.
        pub kp_scale: f32 = 1.0,
        /// Factor on all masses.
        pub mass_scale: f32 = 1.0,
        /// Mass that the torso carries, kg.
        pub payload_kg: f32,
        /// Factor on the play of the joints that have some.
        pub backlash_scale: f32 = 1.0,
        /// Share of the episodes in which one servo, any of them, gives no torque.
        pub limp_share: f32,
        /// Share of the episodes in which one servo, any of them, does not turn.
        pub stuck_share: f32,
    }
}

impl Corner {
    /// As a randomisation without any width.
    pub fn randomisation(&self) -> RandomisationConfig {
        let all = |value: f32| [value, value];
        RandomisationConfig {
            enabled: true,
            foot_friction_scale: all(self.foot_friction_scale),
            body_friction_scale: all(1.0),
            total_mass_scale: all(self.mass_scale),
            link_mass_scale: all(1.0),
            com_offset_m: all(0.0),
            joint_friction_scale: all(1.0),
            armature_scale: all(1.0),
            damping_scale: all(1.0),
            kp_scale: all(self.kp_scale),
            kd_scale: all(1.0),
            torque_scale: all(1.0),
            supply_scale: all(1.0),
            command_delay_s: all(self.command_delay_s),
            backlash_scale: all(self.backlash_scale),
            payload_kg: all(self.payload_kg),
            limp_share: self.limp_share,
            stuck_share: self.stuck_share,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::PI;

    const FIRST: [f32; 3] = [0.3, 0.1, 0.0];

    fn leg(from_s: f64, order: Order) -> Leg {
        Leg { from_s, order }
    }

    #[test]
    fn headings_are_kept_the_short_way_in_the_present_leg() {
        let legs = [leg(0.0, Order::Heading(0.0)), leg(10.0, Order::Heading(PI))];
        let at = |time_s, heading_rad| Leg::command(&legs, FIRST, time_s, heading_rad);
        assert_eq!(at(5.0, 0.25), Some([0.3, 0.1, -0.25]));
        assert_eq!(at(10.0, 0.25), Some([0.3, 0.1, 0.6]));
        // from −3 to π is −0.142 the short way
        let back = at(20.0, -3.0).unwrap()[2];
        assert!((back + (PI - 3.0)).abs() < 1e-5, "{back}");
        assert_eq!(Leg::command(&[], FIRST, 5.0, 0.25), None);
    }

    #[test]
    fn a_command_replaces_the_first_one() {
        let legs = [leg(4.0, Order::Command([0.1, 0.0, 0.4]))];
        let at = |time_s| Leg::command(&legs, FIRST, time_s, 0.0);
        assert_eq!((at(3.9), at(4.0)), (None, Some([0.1, 0.0, 0.4])));
    }
}
