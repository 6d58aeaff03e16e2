//! `caudata-robot doctor`: is this robot fit for torque?

use std::path::PathBuf;
use std::time::{Duration, Instant};

use caudata_dynamixel::setup::tick_us;
use caudata_dynamixel::{Answer, Bus, BusFault, GroupRead, Port, xm430};
use caudata_hardware::{JointWiring, Wiring};
use caudata_model::RobotModel;
use serde::Serialize;

use crate::DeployError;
use crate::bus::BusError;
use crate::commands::control_loop::fit;
use crate::commands::say::{say, say_json};
use crate::commands::source::load_model;
use crate::hardware::inspect::{self, Check, Inspection, Mark};
use crate::hardware::{PortOverrides, open_bus, open_imu, read_wiring};
use caudata_durable::shipped_flag;

/// Round trips that are timed.
const TIMED_TICKS: u32 = 50;
/// How much of a tick of 20 ms is the bus's.
const BUS_BUDGET: Duration = Duration::from_millis(7);
/// A joint that was moved by hand moved at least this far, rad.
const MOVED_RAD: f64 = 0.15;

#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Robot file
    #[arg(
        long,
        value_name = "FILE.robot.toml",
        default_value = "robots/polymander.robot.toml",
        value_parser = shipped_flag
    )]
    robot: PathBuf,
    /// Wiring file
    #[arg(
        long,
        value_name = "FILE.wiring.toml",
        default_value = "robots/polymander.wiring.toml",
        value_parser = shipped_flag
    )]
    wiring: PathBuf,
    #[command(flatten)]
    ports: PortOverrides,
    /// Set speeds and registers of servos right
    #[arg(long)]
    fix: bool,
    /// The robot stands in its nominal pose: compare every joint with it, which shows zero offsets
    #[arg(long)]
    nominal: bool,
    /// Watch for this long, s, while one joint after the other is moved by hand in its positive direction,
    /// which shows directions
    #[arg(long, value_name = "N", default_value_t = 0)]
    watch: u64,
    /// One JSON object as the last line of standard output
    #[arg(long)]
    json: bool,
}

/// How far a joint may be from the nominal pose, rad: 8°, the spline of a horn is 360°/22 = 16°.
const NOMINAL_RAD: f64 = 0.14;

#[derive(Serialize)]
struct Report<'a> {
    robot: &'a str,
    fit: bool,
    checks: &'a [Check],
}

pub fn run(args: &DoctorArgs) -> Result<(), DeployError> {
    let model = load_model(&args.robot)?;
    let (wiring, joints) = read_wiring(&args.wiring, &model, &args.ports)?;
    let mut bus = open_bus(&wiring)?;
    let mut all =
        inspect::servos(&mut bus, &wiring, &joints, &model, args.fix).map_err(BusError::from)?;
    if all.wrong().next().is_none() {
        all.checks.extend(timing(&mut bus, &wiring, &joints).map_err(BusError::from)?);
        if args.nominal {
            all.checks.extend(pose(&mut bus, &joints, &model).map_err(BusError::from)?);
        }
        if args.watch > 0 {
            let end = Instant::now() + Duration::from_secs(args.watch.min(600));
            all.checks.extend(watch(&mut bus, &joints, &model, end).map_err(BusError::from)?);
        }
    }
    all.checks.extend(match open_imu(&wiring) {
        Ok(mut imu) => inspect::imu(&mut imu).checks,
        Err(error) => vec![check("imu", "answers", error.to_string(), false)],
    });
    tell(args, &model, &all)?;
    fit(&all)
}

fn check(at: &str, what: &str, found: String, good: bool) -> Check {
    Check {
        at: at.to_owned(),
        what: what.to_owned(),
        found,
        mark: if good { Mark::Good } else { Mark::Wrong },
    }
}

fn tell(args: &DoctorArgs, model: &RobotModel, all: &Inspection) -> Result<(), DeployError> {
    if args.json {
        return say_json(&Report {
            robot: model.name(),
            fit: all.wrong().next().is_none(),
            checks: &all.checks,
        });
    }
    for check in &all.checks {
        let mark = match check.mark {
            Mark::Good => "ok   ",
            Mark::Fixed => "fixed",
            Mark::Wrong => "WRONG",
        };
        say(&format!("{mark}  {:<8}  {:<22}  {}", check.at, check.what, check.found));
    }
    Ok(())
}

/// Whether a tick's reading fits, measured and worked out.
fn timing<P: Port>(
    bus: &mut Bus<P>,
    wiring: &Wiring,
    joints: &[JointWiring],
) -> Result<Vec<Check>, BusFault> {
    let ids: Vec<u8> = joints.iter().map(|j| j.id).collect();
    let fast = wiring.bus.fast_sync_read;
    let mut group = GroupRead::new(&ids, xm430::TICK_ADDRESS, xm430::TICK_BYTES, fast);
    let (mut worst, mut missing) = (Duration::ZERO, 0);
    for _ in 0..TIMED_TICKS {
        let begun = Instant::now();
        bus.read_group(&mut group, Duration::from_millis(100))?;
        worst = worst.max(begun.elapsed());
        missing += (0..group.len()).filter(|i| group.answer(*i) == Answer::Silent).count();
    }
    let wire_us = tick_us(ids.len(), 10, fast, wiring.bus.return_delay_us, wiring.bus.baud);
    let text = format!(
        "worst of {TIMED_TICKS}: {:.1} ms; a tick is {:.1} ms on the wire",
        worst.as_secs_f64() * 1e3,
        wire_us as f64 * 1e-3
    );
    Ok(vec![
        check("bus", "round trip", text, worst < BUS_BUDGET),
        check(
            "bus",
            "answers missing",
            format!("{missing} of {}", TIMED_TICKS as usize * ids.len()),
            missing == 0,
        ),
    ])
}

/// Present angles of all joints, rad; not a number where one is silent.
fn angles<P: Port>(bus: &mut Bus<P>, joints: &[JointWiring]) -> Result<Vec<f64>, BusFault> {
    let ids: Vec<u8> = joints.iter().map(|j| j.id).collect();
    let register = &xm430::PRESENT_POSITION;
    let mut group = GroupRead::new(&ids, register.address, register.size, false);
    bus.read_group(&mut group, Duration::from_millis(100))?;
    let of = |(index, joint): (usize, &JointWiring)| match group.answer(index) {
        Answer::Data(_) => register
            .value_in(group.data(index), register.address)
            .map_or(f64::NAN, |counts| joint.joint_rad(counts)),
        _ => f64::NAN,
    };
    Ok(joints.iter().enumerate().map(of).collect())
}

fn pose<P: Port>(
    bus: &mut Bus<P>,
    joints: &[JointWiring],
    model: &RobotModel,
) -> Result<Vec<Check>, BusFault> {
    let found = angles(bus, joints)?;
    let names = model.actuated_names();
    let checks = found.iter().zip(model.nominal_pos_rad()).zip(names);
    Ok(checks
        .map(|((found, nominal), name)| {
            let text = format!("{:.1}°, nominal {:.1}°", found.to_degrees(), nominal.to_degrees());
            check(name, "zero offset", text, (found - nominal).abs() < NOMINAL_RAD)
        })
        .collect())
}

/// What was moved by hand, and which way the program saw it go.
fn watch<P: Port>(
    bus: &mut Bus<P>,
    joints: &[JointWiring],
    model: &RobotModel,
    end: Instant,
) -> Result<Vec<Check>, BusFault> {
    let start = angles(bus, joints)?;
    let mut far = vec![0.0_f64; joints.len()];
    while Instant::now() < end {
        for ((far, now), start) in far.iter_mut().zip(angles(bus, joints)?).zip(&start) {
            let moved = now - start;
            if moved.abs() > far.abs() {
                *far = moved;
            }
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let moved = far.iter().zip(model.actuated_names());
    Ok(moved
        .filter(|(far, _)| far.abs() > MOVED_RAD)
        .map(|(far, name)| {
            let text = format!("moved {:+.0}°; by hand it went the positive way", far.to_degrees());
            check(name, "direction", text, *far > 0.0)
        })
        .collect())
}
