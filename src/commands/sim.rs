//! `caudata sim`: simulate without training.

use caudata_telemetry::{Failure, StopFlag};
use clap::Subcommand;

use super::{sim_robot, sim_rollout, sim_show, sim_verify};

#[derive(Debug, Subcommand)]
pub enum SimCommand {
    /// Open loop: joint commands in, simulated signals out
    ///
    /// `--set lane.KEY=VALUE` changes the robot's physical parameters: lane.foot_friction=0.5,
    /// lane.kp_nm_per_rad=12 (all joints), lane.kp_nm_per_rad.FL_hip=9 (one), lane.joints.dead_band_rad=0.01,
    /// lane.joints.FL_hip.dead_band_rad=0.01 (one). docs/reference/simulation.md says more.
    Rollout(sim_rollout::RolloutArgs),
    /// A picture or a short animation of a model, a scene or a log
    Show(sim_show::ShowArgs),
    /// The engines against MuJoCo, closed forms, conservation laws and each other, as one table
    Verify(sim_verify::VerifyArgs),
    /// A simulated robot as a process of its own, for caudata-robot
    Robot(sim_robot::SimRobotArgs),
}

pub fn run(command: &SimCommand, stop: &StopFlag) -> Result<(), Failure> {
    match command {
        SimCommand::Rollout(args) => sim_rollout::run(args, stop),
        SimCommand::Show(args) => sim_show::run(args, stop),
        SimCommand::Verify(args) => sim_verify::run(args),
        SimCommand::Robot(args) => sim_robot::run(args, stop),
    }
}

#[cfg(test)]
mod tests {
    //! Rolling out, looking at what came out, and what each refuses.

    use super::*;
    use caudata_runlog::{RunLog, Signal};
    use caudata_telemetry::ExitCode;
    use clap::Parser;
    use std::path::Path;

    #[derive(Parser)]
    struct Line {
        #[command(subcommand)]
        command: SimCommand,
    }

    /// Runs `caudata sim ARGS` with paths below `folder`.
    fn sim(folder: &Path, args: &str) -> Result<(), Failure> {
        let root = env!("CARGO_MANIFEST_DIR");
        let robot = format!("{root}/robots/polymander.robot.toml");
        let words = args.split_whitespace().map(|word| {
            let word = word.replace("ROBOT", &robot);
            word.replace("DIR", &folder.display().to_string())
        });
        let line = Line::try_parse_from(std::iter::once("sim".to_owned()).chain(words)).unwrap();
        run(&line.command, &StopFlag::default())
    }

    fn refused(folder: &Path, args: &str, code: ExitCode, words: &[&str]) {
        let failure = sim(folder, args).unwrap_err();
        assert_eq!(failure.code(), code, "{failure}");
        for word in words {
            assert!(failure.to_string().contains(word), "{failure}");
        }
    }

    #[test]
    fn a_rollout_is_a_log_that_can_be_shown() {
        let folder = tempfile::tempdir().unwrap();
        let dir = folder.path();
        std::fs::write(dir.join("c.csv"), "t,cmd.FL_hip\n0.0,0.0\n0.1,0.3\n").unwrap();
        let rollout = "rollout --robot ROBOT --commands DIR/c.csv --out DIR/log.csv --engine rapier --terrain rugged --seed 5 \
            --duration-s 0.5 --rate-hz 100 --set terrain.height_m=0.02 --set lane.foot_friction=0.6 --set lane.kp_nm_per_rad=12";
        sim(dir, rollout).unwrap();
        let log = RunLog::read(dir).unwrap();
        // 0.5 s at 100 Hz, both ends
        assert_eq!(log.table.len(), 51);
        assert_eq!((log.meta.rate_hz, log.meta.kp), (100.0, Some(12.0)));
        assert_eq!(log.meta.terrain, "rugged");
        let command = log.table.column(&Signal::Command("FL_hip".into())).unwrap();
        assert_eq!((command[9], command[50]), (Some(0.0), Some(0.3f32.into())));
        let height = log.table.column(&"base.pos.z".parse().unwrap()).unwrap();
        assert!(height[50].unwrap() > 0.03, "it stands on the ground");
        let first = std::fs::read(dir.join("log.csv")).unwrap();
        sim(dir, rollout).unwrap();
        assert!(first == std::fs::read(dir.join("log.csv")).unwrap(), "same bits");
        sim(dir, "show --log DIR --at 0.2 --out DIR/f.png --width 160 --robot ROBOT").unwrap();
        sim(dir, "show --log DIR --fps 5 --out DIR/f.gif --width 80 --robot ROBOT").unwrap();
        assert!(std::fs::read(dir.join("f.png")).unwrap().starts_with(b"\x89PNG"));
        assert!(std::fs::read(dir.join("f.gif")).unwrap().starts_with(b"GIF89a"));
    }

    #[test]
    fn bad_input_is_one_line_and_its_code() {
        let folder = tempfile::tempdir().unwrap();
        let dir = folder.path();
        let good = "rollout --robot ROBOT --commands DIR/c.csv --out DIR/o.csv";
        refused(dir, good, ExitCode::NoInput, &["c.csv"]);
        std::fs::write(dir.join("c.csv"), "t,cmd.wing\n0.0,0.1\n").unwrap();
        refused(dir, good, ExitCode::BadInput, &["wing"]);
        std::fs::write(dir.join("c.csv"), "t,cmd.FL_hip\n0.0,high\n").unwrap();
        refused(dir, good, ExitCode::BadInput, &["c.csv:2"]);
        std::fs::write(dir.join("c.csv"), "t,cmd.FL_hip\n0.0,0.1\n").unwrap();
        let with = |flags: &str| format!("{good} {flags}");
        refused(dir, &with("--rate-hz 999"), ExitCode::BadConfig, &["999"]);
        refused(dir, &with("--duration-s -1"), ExitCode::BadConfig, &["-1"]);
        refused(dir, &with("--set lane.grip=1"), ExitCode::BadConfig, &["grip"]);
        refused(dir, &with("--set terrain.depth=1"), ExitCode::BadConfig, &["depth"]);
        // No folder is made for what is refused, and none can be made inside a file.
        let elsewhere = good.replace("DIR/o.csv", "DIR/new/o.csv");
        let refused_there = format!("{elsewhere} --rate-hz 999");
        refused(dir, &refused_there, ExitCode::BadConfig, &["999"]);
        assert!(!dir.join("new").exists());
        sim(dir, &elsewhere).unwrap();
        assert!(dir.join("new/o.toml").is_file());
        let inside = good.replace("DIR/o.csv", "DIR/c.csv/o.csv");
        refused(dir, &inside, ExitCode::CannotCreate, &["c.csv"]);
        refused(dir, "show --out DIR/f.jpg", ExitCode::BadConfig, &[".png or .gif"]);
        refused(dir, "show --out DIR/f.png --log DIR", ExitCode::NoInput, &["log"]);
        refused(dir, "show --out DIR/f.png --robot DIR/r.toml", ExitCode::NoInput, &["r.toml"]);
        refused(
            dir,
            "show --out DIR/f.png --distance 0 --robot ROBOT",
            ExitCode::BadConfig,
            &["distance"],
        );
        refused(
            dir,
            "show --out DIR/f.png --width 9999 --robot ROBOT",
            ExitCode::BadConfig,
            &["width"],
        );
    }
}
