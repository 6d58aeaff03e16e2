//! The configurations that come with the program.

/// A named configuration, embedded.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    /// Its name on the command line.
    pub name: &'static str,
    /// One line about it.
    pub about: &'static str,
    /// Its TOML text: only what differs from the defaults.
    pub text: &'static str,
}

/// All presets.
pub const PRESETS: [Preset; 5] = [
    Preset {
        name: "quick",
        about: "a minute on two cores: the robot learns to walk on flat ground",
        text: include_str!("../presets/quick.toml"),
    },
    Preset {
        name: "flat",
        about: "minutes on two cores: walks in every direction on flat ground, all randomisation and pushes on",
        text: include_str!("../presets/flat.toml"),
    },
    Preset {
        name: "rough",
        about: "minutes on two cores, from the policy of flat: hills and rugged ground",
        text: include_str!("../presets/rough.toml"),
    },
    Preset {
        name: "amphibious",
        about: "a quarter of an hour on two cores, from the policy of flat: from land into water and back with one policy",
        text: include_str!("../presets/amphibious.toml"),
    },
    Preset {
        name: "paper",
        about: "the paper's table as printed: 3e8 steps, for a GPU or a night",
        text: include_str!("../presets/paper.toml"),
    },
];

impl Preset {
    /// The preset of this name.
    pub fn find(name: &str) -> Option<&'static Preset> {
        PRESETS.iter().find(|preset| preset.name == name)
    }
}
