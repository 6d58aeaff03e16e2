//! How a log becomes a [`Trial`].

use caudata_model::{Link, RobotModel};
use caudata_runlog::{Axis, BaseHold, QuatPart, RunLog, Signal, Table};

use crate::check::{holes, series::median_step_s};
use crate::error::GapError;
use crate::trial::{Channel, Force, Kind, Run, Steps, Trial, attitude_of, nearest_turn};

/// Shortest run that can be replayed, s.
const MIN_DURATION_S: f64 = 1.0;

/// Reads a run of `model`.
///
/// # Errors
/// [`GapError::Run`] where it has no commands, no joint positions, foreign joints, or is too short.
pub fn trial(model: &RobotModel, run: &Run) -> Result<Trial, GapError> {
    let bad = |message: String| GapError::Run { run: run.name.clone(), message };
    let table = &run.log.table;
    let joints = model.actuated_names();
    let strange = |s: &&Signal| s.joint().is_some_and(|j| !joints.contains(&j));
    if let Some(signal) = table.signals().iter().find(strange) {
        return Err(bad(format!(
            "`{signal}`: the robot has no actuated joint `{}`; it has {}",
            signal.joint().unwrap_or_default(),
            joints.join(", ")
        )));
    }
    known_conditions(model, &run.log).map_err(bad)?;
    let time = table.time_s();
    let (Some(&first), Some(&last)) = (time.first(), time.last()) else {
        return Err(bad("has no rows".into()));
    };
    if last - first < MIN_DURATION_S {
        return Err(bad(format!(
            "lasts {:.2} s; at least {MIN_DURATION_S} s are needed",
            last - first
        )));
    }
    let commanded = |joint: &&str| steps(table, &Signal::Command((*joint).to_owned()));
    let commanded: Vec<Option<Steps>> = joints.iter().map(commanded).collect();
    let beside = |of: fn(String) -> Signal| -> Vec<Option<Steps>> {
        joints.iter().map(|joint| steps(table, &of((*joint).to_owned()))).collect()
    };
    let (speeds, torques) = (beside(Signal::CommandVelocity), beside(Signal::CommandTorque));
    if commanded.iter().chain(&speeds).chain(&torques).all(Option::is_none) {
        return Err(bad(
            "has no `cmd.<joint>` column; what was commanded is needed to replay it".into()
        ));
    }
    let commands = commanded.into_iter().zip(model.nominal_pos_rad());
    let commands = commands.map(|(steps, &nominal)| {
        steps.unwrap_or(Steps { time_s: vec![first], value: vec![nominal], frame_s: 0.0 })
    });
    let enabled = |joint: &&str| steps(table, &Signal::Enabled((*joint).to_owned()));
    let meta = &run.log.meta;
    let channels = channels(model, table, meta.base);
    if !channels.iter().any(|c| c.kind == Kind::Position) {
        return Err(bad("has no `pos.<joint>` column with values".into()));
    }
    let volt = channels.iter().find(|c| c.kind == Kind::Voltage);
    Ok(Trial {
        name: run.name.clone(),
        role: run.role,
        base: meta.base,
        span_s: (first, last),
        commands: commands.collect(),
        speeds,
        torques,
        forces: forces(model, &run.log),
        enabled: joints.iter().map(enabled).collect(),
        supply_v: volt.map_or(meta.supply_v, |v| Some(open_voltage(&v.value))),
        channels,
        meta: meta.clone(),
        group: 0,
        masked_s: Vec::new(),
        holes_s: holes(table).iter().map(|h| (h.from_s, h.until_s)).collect(),
        members: Vec::new(),
        session: 0.0,
    })
}

/// Whether the conditions of a run speak of joints and links that the robot has.
pub(crate) fn known_conditions(model: &RobotModel, log: &RunLog) -> Result<(), String> {
    let joints = model.actuated_names();
    let (meta, file) = (&log.meta, &log.meta_name);
    if let Some(joint) = meta.joint.keys().find(|j| !joints.contains(&j.as_str())) {
        return Err(format!(
            "{file}: `joint.{joint}`: the robot has no actuated joint `{joint}`; it has {}",
            joints.join(", ")
        ));
    }
    let links: Vec<&str> = model.links().iter().map(|l| l.name.as_str()).collect();
    if let Some(p) = meta.payload.iter().find(|p| !links.contains(&p.link.as_str())) {
        return Err(format!(
            "{file}: `payload`: the robot has no link `{}`; it has {}",
            p.link,
            links.join(", ")
        ));
    }
    if let Some(p) = meta.outer_force.iter().find(|p| !links.contains(&p.link.as_str())) {
        return Err(format!(
            "{file}: `outer_force`: the robot has no link `{}`; it has {}",
            p.link,
            links.join(", ")
        ));
    }
    let strange = |s: &&Signal| matches!(s, Signal::Force(l, _) if !links.contains(&l.as_str()));
    if let Some(signal) = log.table.signals().iter().find(strange) {
        return Err(format!("`{signal}`: the robot has no such link; it has {}", links.join(", ")));
    }
    in_their_units(model, log)
}

/// Forces from outside, at the links' centres of mass unless the log says where.
fn forces(model: &RobotModel, log: &RunLog) -> Vec<Force> {
    let component = |link: &str, axis: Axis| -> (Vec<f64>, Vec<f64>) {
        let column = log.table.column(&Signal::Force(link.to_owned(), axis));
        let rows = log.table.time_s().iter().zip(column.into_iter().flatten());
        rows.filter_map(|(t, value)| Some((*t, (*value)?))).unzip()
    };
    let of = |(l, link): (usize, &Link)| {
        let noted = log.meta.outer_force.iter().find(|p| p.link == link.name);
        Force {
            link: l,
            at_m: noted.map_or(link.com_m, |p| p.at_m),
            axes: Axis::ALL.map(|axis| component(&link.name, axis)),
        }
    };
    let all = model.links().iter().enumerate().map(of);
    all.filter(|force| force.axes.iter().any(|(time_s, _)| !time_s.is_empty())).collect()
}

/// So many times what the robot weighs, or its supply gives, is written in another unit.
const NOT_THIS_UNIT: f64 = 50.0;
/// No robot here carries a weight so far from a link, m.
const FARTHEST_M: f64 = 20.0;

/// Whether weights, places and the supply that a run notes are of a size that they can have.
fn in_their_units(model: &RobotModel, log: &RunLog) -> Result<(), String> {
    let (meta, file) = (&log.meta, &log.meta_name);
    let robot_kg: f64 = model.links().iter().map(|l| l.mass_kg).sum();
    for p in &meta.payload {
        if p.mass_kg.abs() > NOT_THIS_UNIT * robot_kg {
            return Err(format!(
                "{file}: `payload`: {} kg, and the whole robot weighs {robot_kg:.3} kg: write it in kg",
                p.mass_kg
            ));
        }
        if p.at_m.iter().any(|x| x.abs() > FARTHEST_M) {
            let at_m = p.at_m;
            return Err(format!("{file}: `payload`: {at_m:?} m from its link: write it in m"));
        }
    }
    if let Some(p) = meta.outer_force.iter().find(|p| p.at_m.iter().any(|x| x.abs() > FARTHEST_M)) {
        let at_m = p.at_m;
        return Err(format!("{file}: `outer_force`: {at_m:?} m from its link: write it in m"));
    }
    let usual_v = model.supply_v();
    match meta.supply_v {
        Some(volt) if volt > NOT_THIS_UNIT * usual_v || volt * NOT_THIS_UNIT < usual_v => {
            Err(format!(
                "{file}: `supply_v`: {volt} V, and the robot file's is {usual_v} V: write it in V"
            ))
        }
        _ => Ok(()),
    }
}

/// What a column sent, where it changes; none where it has no value.
fn steps(table: &Table, signal: &Signal) -> Option<Steps> {
    let (time, column) = (table.time_s(), table.column(signal)?);
    let sent = time.iter().zip(column).filter(|(_, v)| v.is_some());
    let sent_s: Vec<f64> = sent.map(|(t, _)| *t).collect();
    let mut steps = Steps { frame_s: median_step_s(&sent_s), ..Steps::default() };
    for (t, v) in time.iter().zip(column) {
        if let Some(v) = *v
            && steps.value.last() != Some(&v)
        {
            steps.time_s.push(*t);
            steps.value.push(v);
        }
    }
    (!steps.value.is_empty()).then_some(steps)
}

/// Voltage without load: what the upper half of the readings are on average, V.
fn open_voltage(volt_v: &[f64]) -> f64 {
    let mut sorted = volt_v.to_vec();
    sorted.sort_by(f64::total_cmp);
    let upper = &sorted[sorted.len() / 2..];
    upper.iter().sum::<f64>() / upper.len().max(1) as f64
}

/// Whether a signal is something that acts beside the position commands.
pub(crate) fn is_beside(signal: &Signal) -> bool {
    matches!(signal, Signal::CommandVelocity(_) | Signal::CommandTorque(_) | Signal::Force(..))
}

/// Whether a diagnosis reads a signal of a run whose base is so held.
pub fn is_read(signal: &Signal, base: BaseHold) -> bool {
    match signal {
        // of a held robot these say where the stand is, and nothing about the robot
        Signal::BasePosition(_) | Signal::BaseVelocity(_) | Signal::BaseQuaternion(_) => {
            base != BaseHold::Fixed
        }
        Signal::Temperature(_) | Signal::Duty(_) | Signal::Mocap(..) | Signal::Contact(_) => false,
        _ => true,
    }
}

fn channels(model: &RobotModel, table: &Table, base: BaseHold) -> Vec<Channel> {
    let time = table.time_s();
    let joints = model.actuated_names();
    let mut channels = Vec::new();
    let axis = |a: Axis| (a as usize, ["x", "y", "z"][a as usize].to_owned());
    for signal in table.signals().iter().filter(|s| is_read(s, base)) {
        let Some(column) = table.column(signal) else { continue };
        let joint = |kind: Kind, name: &String| {
            let index = joints.iter().position(|j| j == name)?;
            Some((kind, index, name.clone()))
        };
        let of_axis = |kind: Kind, a: Axis| {
            let (index, name) = axis(a);
            Some((kind, index, name))
        };
        let key = match signal {
            Signal::Position(j) => joint(Kind::Position, j),
            Signal::SecondPosition(j) => joint(Kind::SecondPosition, j),
            Signal::Velocity(j) => joint(Kind::Velocity, j),
            Signal::Current(j) => joint(Kind::Current, j),
            Signal::Torque(j) => joint(Kind::Torque, j),
            Signal::Voltage => Some((Kind::Voltage, 0, String::new())),
            Signal::Gyro(a) => of_axis(Kind::Gyro, *a),
            Signal::Acceleration(a) => of_axis(Kind::Acceleration, *a),
            Signal::Gravity(a) => of_axis(Kind::Gravity, *a),
            Signal::BasePosition(a) => of_axis(Kind::BasePosition, *a),
            Signal::BaseVelocity(a) => of_axis(Kind::BaseVelocity, *a),
            Signal::Foot(leg, a) => {
                let (index, word) = axis(*a);
                model
                    .feet()
                    .iter()
                    .position(|f| f.name == *leg)
                    .map(|f| (Kind::Foot, 3 * f + index, format!("{leg}.{word}")))
            }
            _ => None,
        };
        if let Some((kind, index, name)) = key {
            push(&mut channels, kind, index, name, time, column);
        }
    }
    let turns = is_read(&Signal::BaseQuaternion(QuatPart::W), base);
    if let Some(quaternions) = base_quaternions(table).filter(|_| turns) {
        let names = ["gravity_x", "gravity_y", "yaw", "gravity_z"];
        let mut parts = [(); 4].map(|()| vec![None; time.len()]);
        let mut turned: Option<f64> = None;
        for (k, wxyz) in quaternions.enumerate() {
            if let Some(wxyz) = wxyz {
                let [gx, gy, yaw, gz] = attitude_of(wxyz);
                turned = Some(turned.map_or(yaw, |last| nearest_turn(yaw, last)));
                for (part, value) in parts.iter_mut().zip([Some(gx), Some(gy), turned, Some(gz)]) {
                    part[k] = value;
                }
            }
        }
        for (index, column) in parts.iter().enumerate() {
            push(&mut channels, Kind::BaseAttitude, index, names[index].to_owned(), time, column);
        }
    }
    channels.sort_by_key(|c| (c.kind, c.index));
    channels
}

/// Orientation of the base by motion capture in every row, where the log has it.
fn base_quaternions(table: &Table) -> Option<impl Iterator<Item = Option<[f64; 4]>> + '_> {
    let column = |part| table.column(&Signal::BaseQuaternion(part));
    let [w, x, y, z] =
        [column(QuatPart::W)?, column(QuatPart::X)?, column(QuatPart::Y)?, column(QuatPart::Z)?];
    Some((0..w.len()).map(move |k| Some([w[k]?, x[k]?, y[k]?, z[k]?])))
}

fn push(
    channels: &mut Vec<Channel>,
    kind: Kind,
    index: usize,
    name: String,
    time: &[f64],
    column: &[Option<f64>],
) {
    let (mut time_s, mut value) = (Vec::new(), Vec::new());
    for (t, v) in time.iter().zip(column) {
        if let Some(v) = *v {
            time_s.push(*t);
            value.push(v);
        }
    }
    if value.len() >= 2 {
        channels.push(Channel { kind, index, name, time_s, value });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn open_voltage_ignores_sags() {
        // upper half of 11, 11.5, 12, 12: 12
        assert_eq!(open_voltage(&[12.0, 11.0, 11.5, 12.0]), 12.0);
    }
}
