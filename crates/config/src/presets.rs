//! The configurations that come with the program.

/// A named configuration, embedded.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    /// Its name on the command line.
    pub name: &'static str,
    /// One line about it.
    pub about: &'static str,
    /// Name of the robot that it is made for; `None`: any.
    pub robot: Option<&'static str>,
    /// Whether it stands on the preset [`Preset::ANY`] and on what follows from the robot file.
    pub derived: bool,
    /// Its TOML text: only what differs from the defaults.
    pub text: &'static str,
}

/// Name of the flagship in its robot file.
const POLYMANDER: &str = "polymander";

/// All presets.
pub const PRESETS: [Preset; 10] = [
    Preset {
        name: "quick",
        about: "a minute on two cores: the robot learns to walk on flat ground",
        robot: Some(POLYMANDER),
        derived: false,
        text: include_str!("../presets/quick.toml"),
    },
    Preset {
        name: "flat",
        about: "minutes on two cores: walks in every direction on flat ground, all randomisation and pushes on",
        robot: Some(POLYMANDER),
        derived: false,
        text: include_str!("../presets/flat.toml"),
    },
    Preset {
        name: "rough",
        about: "minutes on two cores, from the policy of flat: hills and rugged ground",
        robot: Some(POLYMANDER),
        derived: false,
        text: include_str!("../presets/rough.toml"),
    },
    Preset {
        name: "amphibious",
        about: "six minutes on two cores, from the policy of flat: from land into water and back with one policy",
        robot: Some(POLYMANDER),
        derived: false,
        text: include_str!("../presets/amphibious.toml"),
    },
    Preset {
        name: "paper",
        about: "the paper's table as printed: 3e8 steps, for a GPU or a night",
        robot: Some(POLYMANDER),
        derived: false,
        text: include_str!("../presets/paper.toml"),
    },
    Preset {
        name: "walk",
        about: "for any robot: forward on flat ground, with what follows from the robot file",
        robot: None,
        derived: true,
        text: include_str!("../presets/walk.toml"),
    },
    Preset {
        name: "quadruped",
        about: "a dog of twelve joints, forward at 0.6 m/s on flat ground",
        robot: Some("quadruped"),
        derived: true,
        text: include_str!("../presets/quadruped.toml"),
    },
    Preset {
        name: "biped",
        about: "a biped of fourteen small servos, forward at 0.15 m/s on flat ground",
        robot: Some("biped"),
        derived: true,
        text: include_str!("../presets/biped.toml"),
    },
    Preset {
        name: "hexapod",
        about: "six legs, three at a time, forward on flat ground",
        robot: Some("hexapod"),
        derived: true,
        text: include_str!("../presets/hexapod.toml"),
    },
    Preset {
        name: "snake",
        about: "a snake of twelve servos, forward on flat ground",
        robot: Some("snake"),
        derived: true,
        text: include_str!("../presets/snake.toml"),
    },
];

impl Preset {
    /// Name of the preset for any robot.
    pub const ANY: &str = "walk";

    /// The preset of this name.
    pub fn find(name: &str) -> Option<&'static Preset> {
        PRESETS.iter().find(|preset| preset.name == name)
    }

    /// The preset for a robot where none is asked for: `wanted` if it is made for it, else the first one
    /// that is, else the one for any robot.
    pub fn for_robot(wanted: &str, robot: &str) -> &'static str {
        let made = |preset: &&Preset| preset.robot == Some(robot);
        let wanted = Self::find(wanted).filter(made);
        let made_for_it = wanted.or_else(|| PRESETS.iter().find(made));
        made_for_it.map_or(Self::ANY, |preset| preset.name)
    }
}
