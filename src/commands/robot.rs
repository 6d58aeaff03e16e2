//! `caudata robot`: what a robot file says.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_model::import::{self, ImportError, ImportOptions, Weld};
use caudata_model::{BaseKind, JointMotion, ModelError, RobotModel};
use caudata_sim::{Engine, EngineConfig, InitialState, SimError, TerrainConfig};
use caudata_studies::files;
use caudata_task::{PolicyContract, TaskConfig};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Subcommand;
use serde::Serialize;

use crate::say;

#[derive(Debug, Subcommand)]
pub enum RobotCommand {
    /// Read a robot file and its MJCF, check them, and print a summary
    Check {
        /// The robot file
        #[arg(value_name = "FILE.robot.toml")]
        file: PathBuf,
        /// One JSON object instead of a table
        #[arg(long)]
        json: bool,
    },
    /// Make a robot file and an MJCF out of any MJCF or URDF; what cannot be had is refused, all at once
    Import(ImportArgs),
    /// Write a robot for tools that read another format
    Export {
        /// The robot file
        #[arg(value_name = "FILE.robot.toml")]
        file: PathBuf,
        /// The URDF to write
        #[arg(long, value_name = "FILE.urdf")]
        urdf: PathBuf,
    },
}

#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    /// The MJCF or URDF
    #[arg(value_name = "FILE.xml|FILE.urdf")]
    file: PathBuf,
    /// Folder for NAME.robot.toml and NAME.xml
    #[arg(long, value_name = "DIR", default_value = "robots")]
    out: PathBuf,
    /// Name of the robot [default: the file's own]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Whether the base moves; only a URDF needs to be told [default: free if several chains hang on it]
    #[arg(long, value_enum, value_name = "WORD")]
    base: Option<BaseWord>,
    /// Weld these joints (of an arm, a head): in the file's pose, else at 0, or at so many rad (m)
    #[arg(long, value_name = "JOINT[=POSITION]", num_args = 1..)]
    weld: Vec<Weld>,
    /// Overwrite files that are there
    #[arg(long)]
    force: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, clap::ValueEnum)]
enum BaseWord {
    Free,
    Fixed,
}

pub fn run(command: &RobotCommand) -> Result<(), Failure> {
    match command {
        RobotCommand::Check { file, json } => {
            let model = load(file)?;
            let cannot_stand = check(&model)
                .map_err(|failure| failure.context(format!("robot file {}", file.display())))?;
            say::either(*json, &Summary::of(&model, cannot_stand), |summary| print(&model, summary))
        }
        RobotCommand::Import(args) => import(args),
        RobotCommand::Export { file, urdf } => {
            let text = load(file)?.to_urdf();
            files::write(urdf, text)?;
            say::line(format!("wrote {}", urdf.display()));
            Ok(())
        }
    }
}

/// What training asks of a robot beyond that its files are right; why it does not stand, if it does not.
fn check(model: &RobotModel) -> Result<Option<String>, Failure> {
    caudata_sim::check_extension(model).or_exit(ExitCode::BadInput)?;
    let (config, terrain) = (EngineConfig::default(), TerrainConfig::default());
    let held = EngineConfig { fixed_base: true, ..config.clone() };
    let finer = EngineConfig { dt_s: 0.001, substeps: 20, ..config.clone() };
    let robot = Arc::new(model.clone());
    let built = |config| {
        caudata_sim::build(Arc::clone(&robot), 1, config, &terrain, 0, 1)
            .or_exit(ExitCode::BadInput)
    };
    let mut engine = built(&config)?;
    let contract = PolicyContract::new(model, &TaskConfig::default());
    contract.or_exit(ExitCode::BadInput)?;
    let mut why = shake(model, engine.as_mut()).or_exit(ExitCode::BadInput)?;
    if why.is_none() && model.base() == BaseKind::Free {
        why = rings(model, built(&held)?.as_mut()).or_exit(ExitCode::BadInput)?;
        if why.is_none() && !model.feet().is_empty() {
            why = stand(model, engine.as_mut()).or_exit(ExitCode::BadInput)?;
            if let Some(why) = &mut why
                && stand(model, built(&finer)?.as_mut()).or_exit(ExitCode::BadInput)?.is_none()
            {
                why.push_str("; it stands with --set engine.dt_s=0.001 --set engine.substeps=20, as feet so light need: train with these");
            }
        }
    }
    Ok(why)
}

/// Commands small swings about the nominal pose; what keeps the robot from following them.
fn shake(model: &RobotModel, engine: &mut dyn Engine) -> Result<Option<String>, SimError> {
    engine.reset(0, &InitialState::nominal(model))?;
    let pose = model.nominal_pos_rad();
    let joints = model.actuated();
    let mut span = vec![(f32::INFINITY, f32::NEG_INFINITY); joints.len()];
    let period_s = engine.config().control_period_s();
    for step in 0..(SHAKING_S / period_s).round() as u64 {
        let swing = SWING_RAD * (std::f64::consts::TAU * SWING_HZ * step as f64 * period_s).sin();
        let own = |(a, angle): (usize, &f64)| (angle + swing * model.per_radian(a)) as f32;
        let targets: Vec<f32> = pose.iter().enumerate().map(own).collect();
        engine.step(&targets, &[0.0; 6])?;
        let state = engine.state();
        if state.diverged[0] {
            let speed = |j: usize| state.joint_vel_radps[j].abs();
            let worst = (0..model.joints().len()).max_by(|&a, &b| speed(a).total_cmp(&speed(b)));
            let joint = &model.joints()[worst.unwrap_or(0)];
            let ms = 1e3 * step as f64 * period_s;
            return Ok(Some(format!(
                "the simulation breaks down after {ms:.0} ms at `{}`: too stiff a gain for what it moves, `{}` of \
                 {:.2e} kg and armature {:.1e} kg·m²; check its <inertial> and armature_kgm2",
                joint.name,
                model.links()[joint.child_link].name,
                model.links()[joint.child_link].mass_kg,
                joint.armature_kgm2
            )));
        }
        for (span, &joint) in span.iter_mut().zip(joints) {
            let at = state.joint_pos_rad[joint];
            *span = (span.0.min(at), span.1.max(at));
        }
    }
    let held = |a: &usize| {
        f64::from(span[*a].1 - span[*a].0) < STUCK_SHARE * SWING_RAD * model.per_radian(*a)
    };
    let stuck = (0..span.len()).find(held).filter(|_| model.base() == BaseKind::Fixed);
    if let Some(a) = stuck {
        let name = model.actuated_names()[a];
        return Ok(Some(format!(
            "`{name}` does not move when it is told to: does what it carries touch the ground (z = 0)?"
        )));
    }
    Ok(None)
}

/// Moves each joint by a step, held in the air where no ground damps; which drive does not move its joint, or
/// lets it swing on.
fn rings(model: &RobotModel, engine: &mut dyn Engine) -> Result<Option<String>, SimError> {
    let mut start = InitialState::nominal(model);
    start.base_z_m = Some(IN_THE_AIR_M);
    engine.reset(0, &start)?;
    let limits = model.joint_limits_rad().iter();
    let pose = model.nominal_pos_rad().iter().zip(limits);
    let step = |a: usize| SWING_RAD * model.per_radian(a);
    let inwards = |(a, (angle, (low, high))): (usize, (&f64, &(f64, f64)))| {
        let back = *angle > 0.5 * (low + high);
        (angle + if back { -step(a) } else { step(a) }) as f32
    };
    let targets: Vec<f32> = pose.enumerate().map(inwards).collect();
    let steps = (RINGING_S / engine.config().control_period_s()).round() as usize;
    let mut seen = Vec::new();
    for _ in 0..steps {
        engine.step(&targets, &[0.0; 6])?;
        seen.push(engine.state().joint_pos_rad.to_vec());
    }
    let moved = |a: &usize| {
        let (joint, began) = (model.actuated()[*a], model.nominal_pos_rad()[*a]);
        let off = seen.iter().map(|at| (f64::from(at[joint]) - began).abs());
        off.fold(0.0, f64::max) >= STUCK_SHARE * step(*a)
    };
    if let Some(a) = (0..model.actuated().len()).find(|a| !moved(a)) {
        let (name, told) = (model.actuated_names()[a], told(model, a, step(a)));
        let link = &model.links()[model.joints()[model.actuated()[a]].child_link];
        return Ok(Some(format!(
            "`{name}` does not move when its target takes a step of {told}, held in the air: is `{}` of {:.2e} kg \
             too heavy, its inertia in another unit, its friction above what its gain gives?",
            link.name, link.mass_kg
        )));
    }
    // what hangs from a held trunk sways as well, but slowly
    Ok(swinging(model, &seen[steps / 3..]).map(|(a, swing)| {
        let (name, by, of) = (model.actuated_names()[a], told(model, a, swing), told(model, a, step(a)));
        format!(
            "`{name}` still swings by {by} half a second and more after its target took a step of {of}, \
             held in the air: its drive hardly damps it (kd_nm_s_per_rad)"
        )
    }))
}

/// The joint (policy order) that swings on most in positions over time, if one does, and by how much, rad or m.
fn swinging(model: &RobotModel, seen: &[Vec<f32>]) -> Option<(usize, f64)> {
    let of = |joint: usize| smallest_swing(seen.iter().map(|at| f64::from(at[joint])), SWINGS);
    let swings = model.actuated().iter().map(|&joint| of(joint)).enumerate();
    let in_angles = |(a, swing): &(usize, f64)| swing / model.per_radian(*a);
    let most = swings.max_by(|x, y| in_angles(x).total_cmp(&in_angles(y)))?;
    (in_angles(&most) > RINGING_SHARE * SWING_RAD).then_some(most)
}

/// A distance that joint `a` (policy order) goes, in degrees or millimetres.
fn told(model: &RobotModel, a: usize, distance: f64) -> String {
    match model.joints()[model.actuated()[a]].motion {
        JointMotion::Hinge => format!("{:.1}°", distance.to_degrees()),
        JointMotion::Slide => format!("{:.1} mm", 1e3 * distance),
    }
}

/// The smallest of the `count` largest swings to and fro of a joint, rad; 0 where it has fewer.
fn smallest_swing(angles: impl Iterator<Item = f64>, count: usize) -> f64 {
    let (mut turns, mut last): (Vec<f64>, Option<f64>) = (Vec::new(), None);
    let mut rises = None;
    for angle in angles {
        if let Some(before) = last.filter(|before| *before != angle) {
            let up = angle > before;
            if rises.is_some_and(|rising| rising != up) {
                turns.push(before);
            }
            rises = Some(up);
        }
        last = Some(angle);
    }
    let mut swings: Vec<f64> = turns.windows(2).map(|w| (w[1] - w[0]).abs()).collect();
    swings.sort_by(|a, b| b.total_cmp(a));
    swings.get(count - 1).copied().unwrap_or(0.0)
}

/// How long a robot is shaken, s, and with what swing.
const SHAKING_S: f64 = 0.5;
const SWING_RAD: f64 = 0.05;
const SWING_HZ: f64 = 4.0;
/// A joint that moves by less of the swing is stuck.
const STUCK_SHARE: f64 = 0.01;
/// A joint rings that swings at least so often, each time by at least this share of a step, from a third of this
/// time, s, on: at 5 Hz one with less than a thirtieth of critical damping.
const RINGING_S: f64 = 1.5;
const SWINGS: usize = 4;
const RINGING_SHARE: f64 = 0.3;
/// Height at which a robot is held so that it touches nothing, m.
const IN_THE_AIR_M: f32 = 10.0;

/// Holds the nominal pose on flat ground for a while; what is wrong with how the robot stands then.
fn stand(model: &RobotModel, engine: &mut dyn Engine) -> Result<Option<String>, SimError> {
    engine.reset(0, &InitialState::nominal(model))?;
    let pose = model.nominal_pos_rad();
    let targets: Vec<f32> = pose.iter().map(|&angle| angle as f32).collect();
    let height_m = f64::from(engine.state().base_pos_m[2]);
    let stands_s = STANDING_S.max(FALLS * (2.0 * height_m / STANDARD_GRAVITY_MPS2).sqrt());
    let periods = (stands_s / engine.config().control_period_s()).round() as u64;
    let mut seen = Vec::new();
    for _ in 0..periods {
        engine.step(&targets, &[0.0; 6])?;
        seen.push(engine.state().joint_pos_rad.to_vec());
    }
    let state = engine.state();
    let stops = model.joint_limits_rad().iter().zip(pose);
    let at_stop = (stops.enumerate()).find(|(a, ((low, high), angle))| {
        (*angle - low).min(high - *angle) < AT_STOP_RAD * model.per_radian(*a)
    });
    let weight_n = model.total_mass_kg() * STANDARD_GRAVITY_MPS2;
    let lies = f64::from(state.trunk_force_n[0]) / weight_n;
    let angles = model.actuated().iter().map(|&joint| state.joint_pos_rad[joint]);
    let off = (pose.iter().zip(angles)).map(|(&wanted, is)| (wanted - f64::from(is)).abs());
    let in_angles = |(a, off): &(usize, f64)| off / model.per_radian(*a);
    let worst = (off.enumerate())
        .max_by(|x, y| in_angles(x).total_cmp(&in_angles(y)))
        .filter(|one| in_angles(one) > SAG_MAX_RAD);
    let names = model.actuated_names();
    let [w, x, y, z] = std::array::from_fn(|i| f64::from(state.base_quat_wxyz[i]));
    let up = w * w - x * x - y * y + z * z;
    Ok(if up < 0.5 {
        Some("it falls over".to_owned())
    } else if let Some((a, off)) = worst {
        Some(format!("`{}` ends {} off its nominal pose", names[a], told(model, a, off)))
    } else if let Some((a, _)) = at_stop {
        Some(format!("`{}` is at its end stop", names[a]))
    } else if lies > LYING_MAX {
        let percent = 100.0 * lies;
        Some(format!("{percent:.0} % of its weight lies on trunk or legs"))
    } else {
        swinging(model, &seen[seen.len() / 2..]).map(|(a, swing)| {
            let (joint, by) = (names[a], told(model, a, swing));
            format!("`{joint}` swings on by {by} as it stands: its drive hardly damps it (kd_nm_s_per_rad)")
        })
    })
}

/// How long a robot has to stand, s, or how many times as long as its height takes to fall freely: what is large
/// falls slowly, and what soft ankles hold up begins slowly.
const STANDING_S: f64 = 1.0;
const FALLS: f64 = 6.0;
const STANDARD_GRAVITY_MPS2: f64 = 9.81;
/// How far a servo may give way under the weight, rad: 15°.
const SAG_MAX_RAD: f64 = 0.26;
/// Nearer to its limit a joint has no room to move, rad: 1°.
const AT_STOP_RAD: f64 = 0.017;
/// How much of the weight may lie on anything but feet and tail.
const LYING_MAX: f64 = 0.05;

fn import(args: &ImportArgs) -> Result<(), Failure> {
    let a_file = |end: &OsStr| ["toml", "xml"].iter().any(|&e| end.eq_ignore_ascii_case(e));
    if !args.out.is_dir() && args.out.extension().is_some_and(a_file) {
        let why = format!("--out {} is no name of a folder", args.out.display());
        let hint = "--out says where NAME.robot.toml goes, --name what the robot is called";
        return Err(Failure::message(ExitCode::BadConfig, why).hint(hint));
    }
    let options = ImportOptions {
        name: args.name.clone(),
        free_base: args.base.map(|word| word == BaseWord::Free),
        weld: args.weld.clone(),
    };
    let made = match import::import(&args.file, &options) {
        Err(ImportError::Refused { refusals: all, notes }) => {
            notes.iter().for_each(|remark| say::line(format!("note: {remark}")));
            all.iter().for_each(|remark| say::line(format!("refused: {remark}")));
            let count = all.len();
            let message = format!("{}: {count} refused", args.file.display());
            let hint = "each is said above, with what to do";
            return Err(Failure::message(ExitCode::BadInput, message).hint(hint));
        }
        Err(ImportError::File(ModelError::Read { path, source, .. })) => {
            let message = format!("cannot read {}: {source}", path.display());
            return Err(Failure::message(ExitCode::NoInput, message));
        }
        other => other.or_exit(ExitCode::BadInput)?,
    };
    for note in &made.notes {
        say::line(format!("note: {note}"));
    }
    let written = [
        (format!("{}.xml", made.name), &made.mjcf),
        (format!("{}.robot.toml", made.name), &made.robot_toml),
    ]
    .map(|(name, text)| (args.out.join(name), text));
    for (path, _) in &written {
        not_there(path, args)?;
    }
    let written_robot = written[1].0.clone();
    files::make_folder(&args.out)?;
    for (path, text) in written {
        files::write(&path, text)?;
        say::line(format!("wrote {}", path.display()));
    }
    let robot = written_robot.display();
    say::line(format!("next: caudata robot check {robot}"));
    let trains = load(&written_robot).is_ok_and(|model| caudata_config::can_walk(&model).is_ok());
    if trains {
        say::line(format!("      caudata train --robot {robot}"));
    }
    Ok(())
}

/// Refuses to overwrite a file; the one that is imported even with `--force`.
fn not_there(path: &Path, args: &ImportArgs) -> Result<(), Failure> {
    let Ok(there) = path.canonicalize() else { return Ok(()) };
    let (what, hint) = if args.file.canonicalize().is_ok_and(|source| source == there) {
        ("is the file to import", "--out takes another folder")
    } else if args.force {
        return Ok(());
    } else {
        ("is there already", "--force overwrites it")
    };
    let why = format!("{} {what}", path.display());
    Err(Failure::message(ExitCode::BadInput, why).hint(hint))
}

/// Reads a robot file; the failure says whether it is missing or wrong.
pub use caudata_studies::files::robot as load;

/// What the flags say, and the robot of it.
pub fn configured(flags: &ConfigArgs) -> Result<(Config, Arc<RobotModel>), Failure> {
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let model = Arc::new(load(&config.robot_path())?);
    Ok((config, model))
}

#[derive(Serialize)]
struct Summary<'a> {
    name: &'a str,
    hash: String,
    links: usize,
    joints: usize,
    actuated: Vec<&'a str>,
    total_mass_kg: f64,
    supply_v: f64,
    /// One per actuated joint.
    kp_nm_per_rad: Vec<f64>,
    /// One per actuated joint.
    kd_nm_s_per_rad: Vec<f64>,
    /// One per actuated joint.
    servos: Vec<&'a str>,
    feet: Vec<&'a str>,
    imu: Option<&'a str>,
    /// Why it cannot be trained to walk; `None` where it can.
    cannot_walk: Option<String>,
    /// Why it does not stand in its nominal pose for some seconds; `None` where it does, or has no feet.
    cannot_stand: Option<String>,
}

impl<'a> Summary<'a> {
    fn of(model: &'a RobotModel, cannot_stand: Option<String>) -> Self {
        Self {
            name: model.name(),
            hash: model.hash_hex(),
            links: model.links().len(),
            joints: model.joints().len(),
            actuated: model.actuated_names(),
            total_mass_kg: model.total_mass_kg(),
            supply_v: model.supply_v(),
            kp_nm_per_rad: model.gains().iter().map(|g| g.kp_nm_per_rad).collect(),
            kd_nm_s_per_rad: model.gains().iter().map(|g| g.kd_nm_s_per_rad).collect(),
            servos: (0..model.actuated().len()).map(|a| model.servo_name(a)).collect(),
            feet: model.feet().iter().map(|foot| foot.name.as_str()).collect(),
            imu: model.imu_site().map(|site| model.links()[site.link].name.as_str()),
            cannot_walk: caudata_config::can_walk(model).err().map(|error| error.to_string()),
            cannot_stand,
        }
    }
}

fn print(model: &RobotModel, summary: &Summary<'_>) {
    say::line(format!(
        "{}: {} links, {} joints ({} actuated), {:.3} kg, {:.1} V",
        summary.name,
        summary.links,
        summary.joints,
        summary.actuated.len(),
        summary.total_mass_kg,
        summary.supply_v,
    ));
    say::line(format!(
        "feet: {}; IMU: {}",
        or_none(&summary.feet.join(", ")),
        summary.imu.map_or_else(
            || format!("not said, taken on {}", model.links()[0].name),
            |link| format!("on {link}")
        ),
    ));
    say::line(format!("hash {}", summary.hash));
    if let Some(why) = &summary.cannot_walk {
        say::line(format!("no preset trains it: {why}"));
    }
    if let Some(why) = &summary.cannot_stand {
        say::line(format!(
            "it does not move or stand as told: {why}; angles in [pose.nominal_rad] and gains in [control] may help"
        ));
    }
    let row = |(index, name): (usize, &&str)| {
        let (lower, upper) = model.joint_limits_rad()[index];
        let slides = model.joints()[model.actuated()[index]].motion == JointMotion::Slide;
        let shown = |x: f64| match slides {
            true => format!("{:.1} mm", 1e3 * x),
            false => format!("{:.1}", x.to_degrees()),
        };
        let mut angles = [model.nominal_pos_rad()[index], lower, upper].map(shown);
        if model.rolls(index) {
            angles[1..].fill("rolls".to_owned());
        }
        let gain = |x: f64, unit: &str| {
            let x: f64 = format!("{x:.3e}").parse().unwrap_or(x);
            if slides { format!("{x} {unit}") } else { x.to_string() }
        };
        let kp = gain(summary.kp_nm_per_rad[index], "N/m");
        let kd = gain(summary.kd_nm_s_per_rad[index], "N·s/m");
        let own = vec![index.to_string(), (*name).to_owned()];
        let servo = vec![summary.servos[index].to_owned()];
        [own, angles.to_vec(), vec![kp, kd], servo].concat()
    };
    let head =
        ["#", "joint", "nominal °", "lower °", "upper °", "kp N·m/rad", "kd N·m·s/rad", "servo"];
    say::table(&head, summary.actuated.iter().enumerate().map(row));
}

fn or_none(list: &str) -> &str {
    if list.is_empty() { "none" } else { list }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A joint without a drive that stands before all others in the file.
    #[test]
    fn a_robot_with_a_passive_joint_is_seen_to_stand() {
        let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("robots");
        let read = |name: &str| std::fs::read_to_string(robots.join(name)).unwrap();
        let toml = read("quadruped.robot.toml")
            + "\n[passive]\nlocked = false\n[passive.joint.ear]\nstiffness_nm_per_rad = 1.0\n\
               damping_nm_s_per_rad = 0.01\nfriction_loss_nm = 0.0\n";
        let ear = "<freejoint/>\n<body name=\"ear\" pos=\"0.2 0 0.1\"><inertial pos=\"0 0 0.03\" mass=\"0.05\" \
                   diaginertia=\"1e-4 1e-4 1e-4\"/><joint name=\"ear\" axis=\"0 1 0\" range=\"-1 1\"/></body>";
        let xml = read("quadruped.xml").replace("<freejoint/>", ear);
        let model = RobotModel::from_bytes("eared", toml.as_bytes(), xml.as_bytes()).unwrap();
        assert!(model.actuated()[0] > 0, "the ear is first");
        assert_eq!(check(&model).unwrap(), None);
    }

    /// A trunk on four legs of a hip and a slide of ± `range_m`, with so stiff a slide.
    fn hopper(range_m: f64, kp_n_per_m: f64) -> RobotModel {
        let (mut legs, mut motors) = (String::new(), String::new());
        for (i, (x, y)) in
            [(0.1, 0.07), (0.1, -0.07), (-0.1, 0.07), (-0.1, -0.07)].iter().enumerate()
        {
            legs += &format!(
                r#"<body name="l{i}" pos="{x} {y} 0"><joint name="h{i}" axis="0 1 0" range="-1 1" armature="0.002"/>
                <geom type="capsule" fromto="0 0 0 0 0 -0.06" size="0.01" mass="0.08"/><body name="f{i}" pos="0 0 -0.06">
                <joint name="s{i}" type="slide" axis="0 0 -1" range="-{range_m} {range_m}" armature="0.02" damping="5"/>
                <geom type="sphere" pos="0 0 -0.06" size="0.012" mass="0.05"/></body></body>"#
            );
            motors += &format!(
                r#"<position joint="h{i}" kp="12" kv="0.3" forcerange="-3 3"/>
                <position joint="s{i}" kp="{kp_n_per_m}" kv="20" forcerange="-40 40"/>"#
            );
        }
        let xml = format!(
            r#"<mujoco model="hop"><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 0.2"><freejoint/>
            <geom type="box" size="0.12 0.08 0.02" mass="1.5"/>{legs}</body></worldbody>
            <actuator>{motors}</actuator></mujoco>"#
        );
        imported(&xml)
    }

    fn imported(xml: &str) -> RobotModel {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mine.xml");
        std::fs::write(&file, xml).unwrap();
        let made = import::import(&file, &ImportOptions::default()).unwrap();
        RobotModel::from_bytes("mine", made.robot_toml.as_bytes(), made.mjcf.as_bytes()).unwrap()
    }

    /// In the middle of ± 12 mm a slide is at no stop, and follows within a period. 2 kg on four slides of 100 N/m
    /// sink by 2.02·9.81/4/100 = 50 mm, less what lies below the slides.
    #[test]
    fn slides_are_measured_in_metres() {
        assert_eq!(check(&hopper(0.012, 4000.0)).unwrap(), None);
        let why = check(&hopper(0.08, 100.0)).unwrap().unwrap();
        assert!(why.contains("mm off its nominal pose"), "{why}");
    }

    /// 1 kg half a metre above an ankle of 3 N·m/rad, which would have to give 4.9: it begins to fall slowly.
    #[test]
    fn a_slow_fall_is_seen() {
        let why = |kp: f64| {
            check(&imported(&format!(
                r#"<mujoco model="pole"><compiler angle="radian"/><worldbody><body name="pole" pos="0 0 0.55"><freejoint/>
                <geom type="sphere" size="0.05" mass="1"/><body name="foot" pos="0 0 -0.5">
                <joint name="ankle" axis="0 1 0" range="-1 1" armature="0.01"/>
                <geom type="box" pos="0 0 -0.04" size="0.1 0.06 0.01" mass="0.3"/></body></body></worldbody><actuator>
                <position joint="ankle" kp="{kp}" kv="0.3" forcerange="-9 9"/></actuator><keyframe>
                <key name="home" qpos="0 0 0.55 1 0 0 0 0.02"/></keyframe></mujoco>"#
            )))
        };
        assert_eq!(why(30.0).unwrap(), None);
        let slow = why(3.0).unwrap().unwrap();
        assert!(slow.contains("it falls over"), "{slow}");
    }

    /// 40 N·m/rad that nothing damps: the legs go on swinging.
    #[test]
    fn a_drive_without_damping_rings() {
        let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("robots");
        let read = |name: &str| std::fs::read_to_string(robots.join(name)).unwrap();
        let toml = read("quadruped.robot.toml")
            .replace("kd_nm_s_per_rad = 1.0 ", "kd_nm_s_per_rad = 0.0 ")
            .replace("kd_nm_s_per_rad = 1.5 ", "kd_nm_s_per_rad = 0.0 ")
            .replace("friction_loss_nm = 0.2", "friction_loss_nm = 0.0");
        let xml = read("quadruped.xml");
        let why = |toml: &str, xml: &str| {
            let model = RobotModel::from_bytes("rings", toml.as_bytes(), xml.as_bytes()).unwrap();
            check(&model).unwrap()
        };
        let swings = why(&toml, &xml).unwrap();
        assert!(swings.contains("still swings by"), "{swings}");
        let stiff = toml.replace("friction_loss_nm = 0.0", "friction_loss_nm = 20.0");
        let stuck = why(&stiff, &xml).unwrap();
        assert!(stuck.contains("does not move when its target"), "{stuck}");
        // feet that give way by 16 mm, as in many files of others, carry it
        let soft =
            xml.replace("size=\"0.022\"", "size=\"0.022\" solimp=\"0.015 0.9999 0.03 0.5 2\"");
        assert_ne!(soft, xml);
        assert_eq!(why(&read("quadruped.robot.toml"), &soft), None);
    }
}
