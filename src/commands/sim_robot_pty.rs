//! `caudata sim robot --bus pty`: the simulated robot behind emulated servos and an emulated IMU on
//! pseudo-terminals.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::Config;
use caudata_dynamixel::emulator::WireFaults;
use caudata_emulated_robot::{EmulatedRobot, Pace, SUBSTEPS, Terminals, Travel, serve};
use caudata_env::WaterSensor;
use caudata_hardware::Wiring;
use caudata_model::RobotModel;
use caudata_sim::{EngineConfig, InitialState};
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use serde::Serialize;
use std::io::Write;

/// Flags of the emulated robot.
#[derive(Debug, clap::Args)]
pub struct PtyArgs {
    /// Wiring file of the emulated robot (`--bus pty`); default: beside the robot file, NAME.wiring.toml
    #[arg(long, value_name = "FILE.wiring.toml")]
    wiring: Option<PathBuf>,
    /// Folder for the links `servos` and `imu` to the pseudo-terminals, and for the file `water`, which a
    /// wiring file may name as the line of its water sensor (`--bus pty`)
    #[arg(long, value_name = "DIR", default_value = "emulated-robot")]
    links: PathBuf,
    /// Let each write of goals move time by one control period instead of the clock (`--bus pty`): for slow
    /// machines
    #[arg(long)]
    in_step: bool,
    /// Chance that an answer of the servos is damaged, lost in part, preceded by noise (`--bus pty`)
    #[arg(long, value_name = "P", default_value_t = 0.0, value_parser = chance)]
    wire_faults: f32,
}

fn chance(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if (0.0..=1.0).contains(&value) => Ok(value),
        _ => Err("must be between 0 and 1".to_owned()),
    }
}

/// One line of standard output.
#[derive(Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
enum Event<'a> {
    /// The terminals can be opened.
    EmulatedRobot { servos: &'a std::path::Path, imu: &'a std::path::Path },
    /// The torque went on.
    TorqueOn { time_s: f64 },
    /// The torque went off.
    TorqueOff { time_s: f64, travel: Option<Travel> },
}

fn tell(event: &Event) {
    let mut out = std::io::stdout().lock();
    if let Ok(text) = serde_json::to_string(event) {
        // A reader that is gone does no harm.
        let _ = writeln!(out, "{text}").and_then(|()| out.flush());
    }
}

/// NAME.wiring.toml for NAME.robot.toml.
fn beside(robot: &Path) -> PathBuf {
    robot.with_extension("").with_extension("wiring.toml")
}

/// Serves until asked to stop.
pub fn run(
    args: &PtyArgs,
    config: &Config,
    model: Arc<RobotModel>,
    start: &InitialState,
    seed: u64,
    stop: &StopFlag,
) -> Result<(), Failure> {
    let path = args.wiring.clone();
    let path = path.unwrap_or_else(|| beside(&config.robot_path()));
    if args.wiring.is_none() && !path.exists() {
        let message = format!("there is no wiring file {}", path.display());
        return Err(Failure::message(ExitCode::NoInput, message).hint(
            "give one with --wiring; robots/polymander.wiring.toml says what belongs in it",
        ));
    }
    let wiring = Wiring::read(&path).or_exit(ExitCode::BadInput)?;
    let engine_config = EngineConfig { substeps: SUBSTEPS, ..config.engine.clone() };
    let water = WaterSensor::new(&model, &config.task).or_exit(ExitCode::BadInput)?;
    let engine = caudata_sim::build(model, 1, &engine_config, &config.terrain, seed, 1)
        .or_exit(ExitCode::BadConfig)?;
    let mut robot = EmulatedRobot::new(engine, &wiring, seed)
        .or_exit_with(ExitCode::BadInput, || path.display().to_string())?;
    robot.place(start).or_exit(ExitCode::BadInput)?;
    robot.water = Some(water);
    let p = args.wire_faults;
    robot.bus.faults =
        WireFaults { lost_byte: p, flipped_bit: p, noise: p, ..WireFaults::default() };
    let mut terminals = Terminals::open(&args.links)
        .or_exit_with(ExitCode::OsResource, || format!("cannot make {}", args.links.display()))?;
    tell(&Event::EmulatedRobot {
        servos: &args.links.join("servos"),
        imu: &args.links.join("imu"),
    });
    let pace = if args.in_step { Pace::Goals } else { Pace::RealTime };
    let mut event = |on: bool, robot: &EmulatedRobot| {
        let time_s = robot.time_s();
        tell(&match on {
            true => Event::TorqueOn { time_s },
            false => Event::TorqueOff { time_s, travel: robot.travel() },
        });
    };
    serve(&mut robot, &mut terminals, pace, &|| stop.is_set(), &mut event)
        .or_exit(ExitCode::Internal)
}
