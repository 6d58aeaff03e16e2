//! `[run]` and `[evaluation]`: what is trained, for how long, and how the result is looked at.

use std::path::PathBuf;

use caudata_declare::settings;
use serde::{Deserialize, Serialize};

settings! {
    /// `[run]`.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct RunConfig {
        /// Name of the run, the end of its folder's name. Letters, digits, `-` and `_`, 1 to 40 of them.
        pub name: String = "caudata".into(),
        /// Seed of everything random. 0 to 2⁶³ − 1. Same seed, same build, same machine type: same run.
        pub seed: u64 = 1,
        /// PPO iterations at which the run ends. 1 to 10,000,000.
        pub iterations: u64 = 500,
        /// Folder under which run folders are made.
        pub out_dir: PathBuf = "runs".into(),
    }
}

settings! {
    /// `[evaluation]`: what `caudata train` does with the policy at the end, and how `caudata eval` judges
    /// it.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct EvaluationConfig {
        /// Forward velocity at which a policy is judged, m/s; the other commands of the suites keep their
        /// proportion to it. Above 0 to 5. Default 0.3 (the paper's).
        pub command_mps: f64 = 0.3,
        /// Episodes of the deterministic policy in the environment. 0 to 10,000; 0 leaves the evaluation out.
        /// Fewer: a wider standard error.
        pub episodes: u32 = 16,
        /// From how many of the last published versions the policy is chosen: the newest that walks by every
        /// gate at the commands and on the ground that it was trained for, and at a shore gets there, else the
        /// one that misses least. 0 to 64; 0 keeps the last one.
        pub choose_from: u32 = 12,
        /// Seconds that the robot client runs the pulled policy on the simulated robot. 0 to 600; 0 leaves it
        /// out.
        pub robot_run_s: f64 = 10.0,
        /// Forward velocity that the robot client is told to walk with, m/s. −5 to 5.
        pub robot_command_mps: f64 = 0.2,
        /// What counts as walking.
        pub gates: GatesConfig,
    }
}

settings! {
    /// `[evaluation.gates]`: what counts as walking, on means over a scenario's episodes. A gate at the end
    /// of its range is never missed. Defaults are the project's for a salamander of 2.6 kg at 0.3 m/s.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct GatesConfig {
        /// Smallest share of the commanded forward speed that is reached, 0 to 1. Default 0: speed is not
        /// judged.
        pub speed_share: f64 = 0.0,
        /// Largest |stride frequency / clock − 1|; not judged without feet or clock. Default 0.15.
        pub stride_off_clock: f64 = 0.15,
        /// Smallest and largest duty factor of each foot, 0 to 1. Default 0.4 to 0.7.
        pub duty_factor: [f64; 2] = [0.4, 0.7],
        /// Largest mean power, W. Default 12.
        pub power_w: f64 = 12.0,
        /// Largest share of time with the trunk on the ground, 0 to 1; judged on flat ground, for robots with
        /// feet. Default 0.01.
        pub trunk_contact_share: f64 = 0.01,
        /// Largest slip of a foot in stance, m/s. Default 0.06.
        pub slip_mps: f64 = 0.06,
        /// Smallest height that every foot reaches, m. Default 0.03.
        pub clearance_m: f64 = 0.03,
        /// Largest share of the joints' power above `vibration_hz`, 0 to 1. Default 0.05.
        pub vibration_share: f64 = 0.05,
        /// Joint power above this is vibration, not walking, Hz. Default 6, four strides and a half.
        pub vibration_hz: f64 = 6.0,
        /// Largest |yaw rate − commanded| on flat ground, rad/s; with `posture` it is 0.02. Default 0.1: who is
        /// told to go straight turns by less than a quarter in 15 s.
        pub yaw_off_radps: f64 = 0.1,
        /// Whether posture and going straight are judged too: joints off nominal, end stops, left against
        /// right, the tail's share, drift. Default true; their limits are the salamander's.
        pub posture: bool = true,
    }
}
