//! What a policy is tried in.

use caudata_sim::{TerrainConfig, TerrainKind};
use caudata_task::push::PushConfig;
use caudata_task::randomise::RandomisationConfig;
use serde::Serialize;

/// How far from the middle of rough ground episodes start, m: a 20 s walk at 0.3 m/s stays on it.
const SPAWN_HALF_EXTENT_M: f32 = 6.0;
/// Edge of rough ground, m.
const ROUGH_SIZE_M: f64 = 32.0;
/// The command that the paper's figures are for, m/s.
pub const PAPER_COMMAND_MPS: f32 = 0.3;

/// A named list of scenarios.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Suite {
    /// Flat ground: forward at 0.3 m/s, standing still, and faster commands up to 0.8 m/s.
    Flat,
    /// The paper's three grades of rough ground at 0.3 m/s.
    Rough,
    /// A grid of vx, vy and yaw rate on flat ground.
    Omni,
    /// Pushes of 0.5 m/s in random directions, every 3 s.
    Push,
    /// The worst corners of the randomisation, one by one and all together.
    Robust,
    /// All of them.
    Paper,
}

impl Suite {
    /// All suites, in the order of the declaration.
    pub const ALL: [Self; 6] = [
        Self::Flat,
        Self::Rough,
        Self::Omni,
        Self::Push,
        Self::Robust,
        Self::Paper,
    ];

    /// Its name on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Flat => "flat",
            Self::Rough => "rough",
            Self::Omni => "omni",
            Self::Push => "push",
            Self::Robust => "robust",
            Self::Paper => "paper",
        }
    }

    /// Its scenarios. `mass_kg`: of the robot, since pushes are given as a change of speed.
    #[must_use]
    pub fn scenarios(self, mass_kg: f64) -> Vec<Scenario> {
        match self {
            Self::Flat => flat(),
            Self::Rough => rough(),
            Self::Omni => vec![omni()],
            Self::Push => vec![push(mass_kg)],
            Self::Robust => robust(),
            Self::Paper => [
                Self::Flat,
                Self::Rough,
                Self::Omni,
                Self::Push,
                Self::Robust,
            ]
            .into_iter()
            .flat_map(|suite| suite.scenarios(mass_kg))
            .collect(),
        }
    }
}

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
    /// The robot's parameters.
    pub corner: Corner,
    /// Pushes, if any.
    pub push: Option<PushConfig>,
    /// Whether it must pass the gates to count as walking (standing still need not).
    pub judged: bool,
}

impl Scenario {
    /// An undisturbed walk on flat ground at a constant command.
    #[must_use]
    pub fn walk(name: &str, command: [f32; 3]) -> Self {
        Self {
            name: name.to_owned(),
            commands: vec![command],
            terrain: TerrainConfig::default(),
            spawn_half_extent_m: 0.0,
            corner: Corner::nominal(),
            push: None,
            judged: true,
        }
    }

    /// Whether the ground is flat, so that a trunk on it is a fault.
    #[must_use]
    pub fn is_flat(&self) -> bool {
        self.terrain.kind == TerrainKind::Flat
    }
}

/// A robot that differs from its file in a few known ways.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Corner {
    /// Delay of commands, s.
    pub command_delay_s: f32,
    /// Factor on the friction of the feet.
    pub foot_friction_scale: f32,
    /// Factor on Kp.
    pub kp_scale: f32,
    /// Factor on all masses.
    pub mass_scale: f32,
}

impl Corner {
    /// The robot as its file says.
    #[must_use]
    pub fn nominal() -> Self {
        Self {
            command_delay_s: 0.0,
            foot_friction_scale: 1.0,
            kp_scale: 1.0,
            mass_scale: 1.0,
        }
    }

    /// As a randomisation without any width.
    #[must_use]
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
            backlash_scale: all(1.0),
        }
    }
}

fn flat() -> Vec<Scenario> {
    let mut all = vec![
        Scenario::walk("flat 0.3 m/s", [PAPER_COMMAND_MPS, 0.0, 0.0]),
        Scenario {
            judged: false,
            ..Scenario::walk("stand", [0.0; 3])
        },
    ];
    for command in [0.4_f32, 0.5, 0.6, 0.8] {
        let name = format!("flat {command:.1} m/s");
        all.push(Scenario::walk(&name, [command, 0.0, 0.0]));
    }
    all
}

fn rough() -> Vec<Scenario> {
    let grade = |name: &str, kind| Scenario {
        terrain: TerrainConfig {
            size_m: ROUGH_SIZE_M,
            ..TerrainConfig::of(kind)
        },
        spawn_half_extent_m: SPAWN_HALF_EXTENT_M,
        ..Scenario::walk(name, [PAPER_COMMAND_MPS, 0.0, 0.0])
    };
    vec![
        grade("rough easy", TerrainKind::RoughEasy),
        grade("rough medium", TerrainKind::RoughMedium),
        grade("rough hard", TerrainKind::RoughHard),
    ]
}

fn omni() -> Scenario {
    let mut commands = Vec::new();
    for vx in [-0.25, -0.125, 0.0, 0.125, 0.25] {
        for vy in [-0.12, 0.0, 0.12] {
            for yaw_rate in [-0.6, -0.3, 0.0, 0.3, 0.6] {
                commands.push([vx, vy, yaw_rate]);
            }
        }
    }
    Scenario {
        commands,
        // many of these are slow turns on the spot, for which a stride has no length
        judged: false,
        ..Scenario::walk("omni", [0.0; 3])
    }
}

fn push(mass_kg: f64) -> Scenario {
    const SPEED_MPS: f64 = 0.5;
    const DURATION_S: f32 = 0.2;
    let force_n = (mass_kg * SPEED_MPS) as f32 / DURATION_S;
    Scenario {
        push: Some(PushConfig {
            enabled: true,
            interval_s: [3.0 - DURATION_S; 2],
            duration_s: [DURATION_S; 2],
            force_n: [force_n; 2],
            full_after_env_steps: 0,
        }),
        judged: false,
        ..Scenario::walk("push 0.5 m/s", [PAPER_COMMAND_MPS, 0.0, 0.0])
    }
}

fn robust() -> Vec<Scenario> {
    let nominal = Corner::nominal();
    let corners = [
        ("nominal", nominal),
        (
            "latency 18 ms",
            Corner {
                command_delay_s: 0.018,
                ..nominal
            },
        ),
        (
            "friction 0.6",
            Corner {
                foot_friction_scale: 0.6,
                ..nominal
            },
        ),
        (
            "Kp 0.75",
            Corner {
                kp_scale: 0.75,
                ..nominal
            },
        ),
        (
            "mass 1.15",
            Corner {
                mass_scale: 1.15,
                ..nominal
            },
        ),
        (
            "worst corner",
            Corner {
                command_delay_s: 0.018,
                foot_friction_scale: 0.6,
                kp_scale: 0.75,
                mass_scale: 1.15,
            },
        ),
    ];
    let scenario = |(name, corner)| Scenario {
        corner,
        ..Scenario::walk(&format!("robust: {name}"), [PAPER_COMMAND_MPS, 0.0, 0.0])
    };
    corners.map(scenario).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_configurations_valid() {
        let all = Suite::Paper.scenarios(2.596);
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
    fn a_push_changes_the_speed_by_half_a_metre_per_second() {
        // 2.6 kg · 0.5 m/s / 0.2 s = 6.5 N
        let push = push(2.6).push.unwrap();
        assert!((push.force_n[0] - 6.5).abs() < 1e-5);
    }

    #[test]
    fn the_grid_covers_every_combination_once() {
        let commands = omni().commands;
        assert_eq!(commands.len(), 5 * 3 * 5);
        assert!(commands.contains(&[-0.25, 0.12, 0.6]));
    }
}
