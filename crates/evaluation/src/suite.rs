//! The lists of scenarios.

use caudata_declare::named;
use std::f32::consts::PI;

use caudata_sim::{TerrainConfig, TerrainKind};
use caudata_task::push::PushConfig;
use serde::{Deserialize, Serialize};

use crate::scenario::{Corner, Goal, Leg, Order, Scenario, Start};

/// How far from the middle of rough ground episodes start, m: a 20 s walk at 0.3 m/s stays on it.
const SPAWN_HALF_EXTENT_M: f32 = 6.0;
/// Edge of rough ground, m.
const ROUGH_SIZE_M: f64 = 32.0;
/// Names that other parts look for.
pub(crate) const FLAT: &str = "flat 0.3 m/s";
pub(crate) const STAND: &str = "stand";
pub(crate) const ROUGH: [&str; 3] = ["rough easy", "rough medium", "rough hard"];
pub(crate) const OMNI: &str = "omni";
pub(crate) const PUSH: &str = "push 0.5 m/s";
/// Change of speed by a push, m/s.
const PUSH_MPS: f32 = 0.5;
pub(crate) const NOMINAL: &str = "robust: nominal";
pub(crate) const WORST_CORNER: &str = "robust: worst corner";
pub(crate) const INTO_WATER: &str = "shore: into the water";
pub(crate) const ONTO_LAND: &str = "shore: onto land";
/// The same on a gentle beach.
const ONTO_GENTLE_LAND: &str = "shore: onto land, 10°";
pub(crate) const THERE_AND_BACK: &str = "shore: there and back";
pub(crate) const SWIM: &str = "swim 0.3 m/s";
/// Swimming and turning, to the left and to the right.
pub(crate) const SWIM_TURN: [&str; 2] = ["swim 0.3 m/s, turn left", "swim 0.3 m/s, turn right"];
/// Yaw rate that they ask for, rad/s.
const SWIM_TURN_RADPS: f32 = 0.5;
pub(crate) const BACK: &str = "back 0.2 m/s";

/// The command that the paper's figures are for, m/s.
pub const PAPER_COMMAND_MPS: f32 = 0.3;

named! {
    /// A named list of scenarios.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "lowercase")]
    pub enum Suite {
        /// Flat ground: forward at 0.3 m/s, standing still, other commands from 0.1 to 0.8 m/s, and backward.
        Flat = "flat",
        /// The paper's three grades of rough ground at 0.3 m/s.
        Rough = "rough",
        /// A grid of vx, vy and yaw rate on flat ground.
        Omni = "omni",
        /// Pushes of 0.5 m/s (in proportion to the speed that the robot is judged at) in random directions,
        /// every 3 s.
        Push = "push",
        /// The worst corners of the randomisation, one by one and all together.
        Robust = "robust",
        /// From land into water, back onto land, and swimming and turning in deep water.
        Transition = "transition",
        /// Swimming in deep water: straight ahead, and turning to either side at 0.5 rad/s.
        Swim = "swim",
        /// One servo without torque, and one that does not turn; another in every episode.
        Servo = "servo",
        /// Thrown onto flat ground in any attitude: on its feet within 3 s, then walking.
        Righting = "righting",
        /// Terraces, each 3 or 5 cm below the one before: down and up.
        Steps = "steps",
        /// Walks at speeds from 0.1 to 0.8 m/s and swimming, beside what is published of salamanders.
        Animal = "animal",
        /// All that walks: every suite before `transition`.
        Paper = "paper",
        /// Everything that the project's table of targets asks about, transition included.
        Acceptance = "acceptance",
    }
}

impl Suite {
    /// Its scenarios. `mass_kg`: of the robot, since pushes are given as a change of speed. `speed_mps`: what
    /// it is judged at; all velocities are as many times those named here as it is of the paper's 0.3 m/s.
    pub fn scenarios(self, mass_kg: f64, speed_mps: f32) -> Vec<Scenario> {
        match self {
            Self::Flat => flat(speed_mps),
            Self::Rough => rough(speed_mps),
            Self::Omni => vec![omni(speed_mps)],
            Self::Push => vec![push(mass_kg, speed_mps)],
            Self::Robust => robust(mass_kg, speed_mps),
            Self::Transition => transition(speed_mps),
            Self::Swim => swim(speed_mps),
            Self::Servo => servo(speed_mps),
            Self::Righting => vec![Scenario {
                fallen: true,
                judged: false,
                ..Scenario::walk("on its feet again", [speed_mps, 0.0, 0.0])
            }],
            Self::Steps => steps(speed_mps),
            Self::Animal => {
                let mut all = flat(speed_mps);
                all.retain(|s| s.judged && s.commands.iter().all(|c| c[0] > 0.0));
                all.extend(swim(speed_mps).into_iter().filter(|s| s.name == SWIM));
                all
            }
            Self::Paper => [Self::Flat, Self::Rough, Self::Omni, Self::Push, Self::Robust]
                .into_iter()
                .flat_map(|suite| suite.scenarios(mass_kg, speed_mps))
                .collect(),
            Self::Acceptance => {
                let mut all = Self::Paper.scenarios(mass_kg, speed_mps);
                all.extend(transition(speed_mps));
                all
            }
        }
    }
}

/// Name of the walk straight ahead on flat ground at `speed_mps`.
pub fn flat_name(speed_mps: f32) -> String {
    match (speed_mps * 10.0).fract() == 0.0 || speed_mps == PAPER_COMMAND_MPS {
        true => format!("flat {speed_mps:.1} m/s"),
        false => format!("flat {speed_mps:.2} m/s"),
    }
}

/// How many times the paper's speed `speed_mps` is: exactly 1 for 0.3 m/s.
fn times(speed_mps: f32) -> f32 {
    speed_mps / PAPER_COMMAND_MPS
}

fn flat(speed_mps: f32) -> Vec<Scenario> {
    let mut all = vec![
        Scenario::walk(&flat_name(speed_mps), [speed_mps, 0.0, 0.0]),
        Scenario { judged: false, ..Scenario::walk(STAND, [0.0; 3]) },
    ];
    for command in [0.1, 0.2, 0.4, 0.5, 0.6, 0.7, 0.8] {
        let (name, command) = scaled("flat", command, speed_mps);
        all.push(Scenario::walk(&name, [command, 0.0, 0.0]));
    }
    let (name, back) = scaled("back", 0.2, speed_mps);
    all.push(Scenario::walk(&name, [-back, 0.0, 0.0]));
    all.push(changing(speed_mps));
    all
}

/// A velocity of the paper's robot, m/s, as it is asked of one that is judged at `speed_mps`, and its name.
fn scaled(what: &str, mps: f32, speed_mps: f32) -> (String, f32) {
    let mps = mps * times(speed_mps);
    let name = match speed_mps == PAPER_COMMAND_MPS {
        true => format!("{what} {mps:.1} m/s"),
        false => format!("{what} {mps:.3} m/s"),
    };
    (name, mps)
}

/// Commands that change every 4 s, within what the paper's robot was asked for.
fn changing(speed_mps: f32) -> Scenario {
    let commands =
        [[0.3, 0.0, 0.0], [0.3, 0.0, 0.3], [0.15, 0.0, -0.3], [0.2, 0.05, 0.0], [0.0, 0.0, 0.0]]
            .map(|[vx, vy, yaw_rate]| [vx * times(speed_mps), vy * times(speed_mps), yaw_rate]);
    let leg = |(i, command)| Leg { from_s: 4.0 * i as f64, order: Order::Command(command) };
    Scenario {
        course: commands.into_iter().enumerate().map(leg).collect(),
        judged: false,
        ..Scenario::walk("changing commands", commands[0])
    }
}

fn rough(speed_mps: f32) -> Vec<Scenario> {
    let grade = |name: &str, kind| Scenario {
        terrain: TerrainConfig { size_m: ROUGH_SIZE_M, ..TerrainConfig::of(kind) },
        spawn_half_extent_m: SPAWN_HALF_EXTENT_M,
        ..Scenario::walk(name, [speed_mps, 0.0, 0.0])
    };
    vec![
        grade(ROUGH[0], TerrainKind::RoughEasy),
        grade(ROUGH[1], TerrainKind::RoughMedium),
        grade(ROUGH[2], TerrainKind::RoughHard),
    ]
}

fn omni(speed_mps: f32) -> Scenario {
    let mut commands = Vec::new();
    for vx in [-0.25, -0.125, 0.0, 0.125, 0.25] {
        for vy in [-0.12, 0.0, 0.12] {
            for yaw_rate in [-0.6, -0.3, 0.0, 0.3, 0.6] {
                commands.push([vx * times(speed_mps), vy * times(speed_mps), yaw_rate]);
            }
        }
    }
    Scenario {
        commands,
        // many of these are slow turns on the spot, for which a stride has no length
        judged: false,
        // forward and turning left: 0.25 m/s, 0.6 rad/s
        film: Some(69),
        ..Scenario::walk(OMNI, [0.0; 3])
    }
}

fn push(mass_kg: f64, speed_mps: f32) -> Scenario {
    const DURATION_S: f32 = 0.2;
    let (name, change_mps) = scaled("push", PUSH_MPS, speed_mps);
    let force_n = (mass_kg * f64::from(change_mps)) as f32 / DURATION_S;
    Scenario {
        push: Some(PushConfig {
            enabled: true,
            interval_s: [3.0 - DURATION_S; 2],
            duration_s: [DURATION_S; 2],
            force_n: [force_n; 2],
            full_after_env_steps: 0,
        }),
        judged: false,
        ..Scenario::walk(&name, [speed_mps, 0.0, 0.0])
    }
}

/// Share of the robot's mass that it carries in front: 300 g of the salamander's 2.6 kg.
const LOAD_SHARE: f64 = 0.3 / 2.596;

fn robust(mass_kg: f64, speed_mps: f32) -> Vec<Scenario> {
    let nominal = Corner::default();
    let corners = [
        (NOMINAL, nominal),
        ("robust: latency 18 ms", Corner { command_delay_s: 0.018, ..nominal }),
        ("robust: friction 0.6", Corner { foot_friction_scale: 0.6, ..nominal }),
        ("robust: Kp 0.75", Corner { kp_scale: 0.75, ..nominal }),
        ("robust: mass 1.15", Corner { mass_scale: 1.15, ..nominal }),
        (
            "robust: a load in front",
            Corner { payload_kg: (LOAD_SHARE * mass_kg) as f32, ..nominal },
        ),
        ("robust: play twice as wide", Corner { backlash_scale: 2.0, ..nominal }),
        (
            WORST_CORNER,
            Corner {
                command_delay_s: 0.018,
                foot_friction_scale: 0.6,
                kp_scale: 0.75,
                mass_scale: 1.15,
                ..nominal
            },
        ),
    ];
    let scenario = |(name, corner)| Scenario {
        corner,
        film: (name == WORST_CORNER).then_some(0),
        ..Scenario::walk(name, [speed_mps, 0.0, 0.0])
    };
    corners.map(scenario).into()
}

/// Risers that the suite of steps has, m.
const STEP_HEIGHTS_M: [f64; 2] = [0.03, 0.05];
/// Headings are drawn within ± this about the way to go, rad.
const SHORE_YAW_RANGE_RAD: f32 = 0.1;

/// The beach, degrees: the paper's steepest hills.
const STEEP_BEACH_DEG: f64 = 15.0;
/// An easier one to come out by, degrees: on a steeper one than about 14° the nose, 20 cm ahead of the fore
/// legs, touches before they can.
const GENTLE_BEACH_DEG: f64 = 10.0;

fn transition(speed_mps: f32) -> Vec<Scenario> {
    let beach = |slope_deg| TerrainConfig { slope_deg, ..TerrainConfig::of(TerrainKind::Shore) };
    let ahead = [speed_mps, 0.0, 0.0];
    let shore = |name: &str, xy_m, yaw_rad, goal| Scenario {
        terrain: beach(STEEP_BEACH_DEG),
        start: Start { xy_m, yaw_rad, yaw_range_rad: Some(SHORE_YAW_RANGE_RAD) },
        goal: Some(goal),
        judged: false,
        ..Scenario::walk(name, ahead)
    };
    // the nose is where the start is; the rest of the robot lies behind it, in deep water
    let afloat = [2.6, 0.0];
    let onto_land = |name: &str, slope_deg| Scenario {
        terrain: beach(slope_deg),
        episode_s: Some(30.0),
        // as a pilot does who wants to get ashore: what drifts for half a minute does not arrive
        course: vec![Leg { from_s: 0.0, order: Order::Heading(PI) }],
        ..shore(name, afloat, PI, Goal::OntoLand)
    };
    let mut all = vec![
        shore(INTO_WATER, [0.0; 2], 0.0, Goal::IntoWater),
        onto_land(ONTO_LAND, STEEP_BEACH_DEG),
        onto_land(ONTO_GENTLE_LAND, GENTLE_BEACH_DEG),
        Scenario {
            episode_s: Some(60.0),
            course: vec![
                Leg { from_s: 0.0, order: Order::Heading(0.0) },
                Leg { from_s: 15.0, order: Order::Heading(PI) },
            ],
            ..shore(THERE_AND_BACK, [0.0; 2], 0.0, Goal::ThereAndBack)
        },
    ];
    all.extend(swim(speed_mps));
    all
}

/// In deep water: straight ahead, and turning.
fn swim(speed_mps: f32) -> Vec<Scenario> {
    let swim = |name: &str, yaw_radps| Scenario {
        terrain: TerrainConfig::of(TerrainKind::DeepWater),
        judged: false,
        ..Scenario::walk(name, [speed_mps, 0.0, yaw_radps])
    };
    let [left, right] = SWIM_TURN;
    vec![swim(left, SWIM_TURN_RADPS), swim(right, -SWIM_TURN_RADPS), swim(SWIM, 0.0)]
}

/// Straight over terraces, as a pilot does who holds a course.
fn steps(speed_mps: f32) -> Vec<Scenario> {
    let over = |height_m: f64, way: &str, yaw_rad| Scenario {
        terrain: TerrainConfig {
            height_m,
            size_m: ROUGH_SIZE_M,
            ..TerrainConfig::of(TerrainKind::Steps)
        },
        // half of a terrace: feet meet the risers at any phase
        spawn_half_extent_m: 0.75,
        start: Start { yaw_rad, yaw_range_rad: Some(SHORE_YAW_RANGE_RAD), ..Start::default() },
        course: vec![Leg { from_s: 0.0, order: Order::Heading(yaw_rad) }],
        goal: Some(Goal::Ahead),
        judged: false,
        ..Scenario::walk(
            &format!("steps of {:.0} cm {way}", 100.0 * height_m),
            [speed_mps, 0.0, 0.0],
        )
    };
    STEP_HEIGHTS_M
        .into_iter()
        .flat_map(|height_m| [over(height_m, "down", 0.0), over(height_m, "up", PI)])
        .collect()
}

/// Straight ahead with a servo that has failed.
fn servo(speed_mps: f32) -> Vec<Scenario> {
    let nominal = Corner::default();
    let scenario = |name: &str, corner| Scenario {
        corner,
        judged: false,
        ..Scenario::walk(name, [speed_mps, 0.0, 0.0])
    };
    vec![
        scenario("one servo limp", Corner { limp_share: 1.0, ..nominal }),
        scenario("one servo stuck", Corner { stuck_share: 1.0, ..nominal }),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_configurations_valid() {
        let suites = [Suite::Acceptance, Suite::Servo, Suite::Righting, Suite::Steps];
        let all: Vec<Scenario> =
            suites.iter().flat_map(|suite| suite.scenarios(2.596, PAPER_COMMAND_MPS)).collect();
        let mut names: Vec<&str> = all.iter().map(|s| s.name.as_str()).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), all.len());
        for scenario in &all {
            scenario.terrain.validate().unwrap();
            scenario.corner.randomisation().validate().unwrap();
            if let Some(push) = scenario.push {
                push.validate().unwrap();
            }
        }
    }

    #[test]
    fn other_robots_are_asked_for_other_speeds() {
        let all = Suite::Paper.scenarios(12.0, 0.6);
        assert_eq!(all[0].name, "flat 0.6 m/s");
        assert_eq!(all[0].commands, [[0.6, 0.0, 0.0]]);
        let names: std::collections::BTreeSet<_> = all.iter().map(|s| &s.name).collect();
        assert_eq!(names.len(), all.len());
        let biped = Suite::Flat.scenarios(0.8, 0.15);
        assert_eq!(
            (biped[0].name.as_str(), biped[4].name.as_str()),
            ("flat 0.15 m/s", "flat 0.200 m/s")
        );
        // 0.8 kg · 0.25 m/s / 0.2 s = 1 N
        let push = &Suite::Push.scenarios(0.8, 0.15)[0];
        assert_eq!(push.name, "push 0.250 m/s");
        assert!((push.push.unwrap().force_n[0] - 1.0).abs() < 1e-5);
        let paper = Suite::Push.scenarios(2.6, PAPER_COMMAND_MPS);
        assert_eq!(paper[0].name, PUSH);
        assert_eq!(flat_name(PAPER_COMMAND_MPS), FLAT);
    }

    #[test]
    fn the_filmed_command_walks_and_turns() {
        let omni = omni(PAPER_COMMAND_MPS);
        assert_eq!(omni.commands[omni.film.unwrap()], [0.25, 0.0, 0.6]);
    }

    #[test]
    fn a_push_changes_the_speed_by_half_a_metre_per_second() {
        // 2.6 kg · 0.5 m/s / 0.2 s = 6.5 N
        let push = push(2.6, PAPER_COMMAND_MPS).push.unwrap();
        assert!((push.force_n[0] - 6.5).abs() < 1e-5);
    }

    #[test]
    fn the_grid_covers_every_combination_once() {
        let commands = omni(PAPER_COMMAND_MPS).commands;
        assert_eq!(commands.len(), 5 * 3 * 5);
        assert!(commands.contains(&[-0.25, 0.12, 0.6]));
    }
}
