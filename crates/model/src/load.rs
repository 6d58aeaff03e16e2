//! From two files to a checked [`RobotModel`].

use std::path::Path;

use sha2::{Digest, Sha256};

use crate::assemble::{
    actuated_joints, backlash, base_kind, feet, find, joints, parts, pose, water,
};
use crate::error::ModelError;
use crate::mjcf;
use crate::model::RobotModel;
use crate::of_joint;
use crate::params::{Gains, Measured, SensorParams};
use crate::parts::Robot;
use crate::pose::Pose;
use crate::robot_file::{self, Checker, RobotFile};
use crate::servos::servos;
use crate::tree::{Element, bytes};
use crate::types::{Joint, Link, Site};

impl RobotModel {
    /// Reads a robot file and the MJCF that it names (a file in the same folder), and checks both completely.
    ///
    /// # Errors
    /// [`ModelError`] with file, place and reason.
    pub fn load(robot_toml: &Path) -> Result<Self, ModelError> {
        from_path(robot_toml)
    }

    /// As [`RobotModel::load`], from bytes; `label` names the robot file in error messages.
    ///
    /// # Errors
    /// [`ModelError`] with place and reason.
    pub fn from_bytes(label: &str, robot_toml: &[u8], mjcf: &[u8]) -> Result<Self, ModelError> {
        from_bytes(label, robot_toml, mjcf)
    }
}

fn from_path(robot_toml: &Path) -> Result<RobotModel, ModelError> {
    let label = robot_toml.display().to_string();
    let toml_bytes = bytes(robot_toml)?;
    let file = robot_file::parse(&label, utf8(&label, &toml_bytes)?)?;
    let mjcf_path = robot_toml.with_file_name(&file.mjcf);
    let mjcf_bytes = bytes(&mjcf_path).map_err(|error| match error {
        ModelError::Read { path, source, .. } => {
            ModelError::Read { path, of: Some(format!(", `mjcf` of {label}")), source }
        }
        other => other,
    })?;
    build(&label, &mjcf_path.display().to_string(), file, &toml_bytes, &mjcf_bytes)
}

fn from_bytes(label: &str, robot_toml: &[u8], mjcf: &[u8]) -> Result<RobotModel, ModelError> {
    let file = robot_file::parse(label, utf8(label, robot_toml)?)?;
    let mjcf_label = file.mjcf.clone();
    build(label, &mjcf_label, file, robot_toml, mjcf)
}

fn utf8<'a>(file: &str, bytes: &'a [u8]) -> Result<&'a str, ModelError> {
    std::str::from_utf8(bytes).map_err(|e| ModelError::RobotFile {
        file: file.to_owned(),
        line: 1 + bytes[..e.valid_up_to()].iter().filter(|b| **b == b'\n').count(),
        message: "is not UTF-8 text".to_owned(),
    })
}

/// SHA-256 over both files, each preceded by its length: no byte can move from one to the other unnoticed.
fn hash(robot_toml: &[u8], mjcf: &[u8]) -> [u8; 32] {
    let mut h = Sha256::new();
    for bytes in [robot_toml, mjcf] {
        h.update((bytes.len() as u64).to_le_bytes());
        h.update(bytes);
    }
    h.finalize().into()
}

fn build(
    label: &str,
    mjcf_label: &str,
    file: RobotFile,
    toml_bytes: &[u8],
    mjcf_bytes: &[u8],
) -> Result<RobotModel, ModelError> {
    let mj = mjcf::parse(mjcf_label, utf8(mjcf_label, mjcf_bytes)?)?;
    let c = Checker { file: label };
    let base = base_kind(&c, &file, &mj)?;
    let actuated = actuated_joints(&c, &file, &mj)?;
    of_joint::check_groups(&c, &file)?;
    let gains = gains(&c, &file)?;
    let (servo_presets, servo_of) = servos(&c, &file)?;
    let backlash = backlash(&c, &file, &mj)?;
    let joints = joints(&c, &file, &mj, &actuated, &backlash, &servo_presets, &servo_of)?;
    let limits_rad = limits(&c, &file, &mj, &actuated, &joints)?;
    let pose = |at, by_name| pose(&c, at, by_name, &file, &limits_rad);
    let nominal_pos_rad = pose("pose.nominal_rad", &file.pose.nominal_rad)?;
    let swimming = file.pose.swimming_rad.as_ref();
    let swimming_pos_rad = swimming.map(|p| pose("pose.swimming_rad", p)).transpose()?;
    let gravity_mps2 = mj.gravity_mps2;
    let (mut links, sites, world_geoms, excluded_pairs) = parts(mj);
    let feet = feet(&c, &file, &mut links)?;
    let measured = measured(&c, &file, &links)?;
    let water = water(&c, &file, &links)?;
    let imu_site = match &file.imu {
        Some(imu) => Some(site(&c, &sites, "imu.site", &imu.site)?),
        None => None,
    };
    let (torso_link, heading_line) = frames(&c, &file, &links, &sites)?;
    Ok(RobotModel {
        hash: hash(toml_bytes, mjcf_bytes),
        name: file.name,
        assumed: file.assumed,
        measured,
        base,
        gravity_mps2,
        links,
        joints,
        sites,
        world_geoms,
        excluded_pairs,
        actuated,
        nominal_pos_rad,
        swimming_pos_rad,
        limits_rad,
        gains,
        servo_presets,
        servo_of,
        sensors: SensorParams { imu: file.imu },
        supply: file.supply,
        extension: file.extension,
        backlash,
        contact: file.contact,
        water,
        feet,
        imu_site,
        heading_line,
        torso_link,
    })
}

/// Lower and upper limit of each actuated joint, rad.
fn limits(
    c: &Checker<'_>,
    file: &RobotFile,
    mj: &Robot,
    actuated: &[usize],
    joints: &[Joint],
) -> Result<Vec<(f64, f64)>, ModelError> {
    let elements: Vec<&Element> = mj.joints().map(|joint| &joint.element).collect();
    let missing = "attribute `range`: is missing; an actuated joint needs limits";
    let limit = |&j: &usize| {
        let none = || ModelError::Mjcf(elements[j].remark_of(missing));
        joints[j].range_rad.ok_or_else(none)
    };
    of_joint::known(c, "joints.limits_rad", file.joints.limits_rad.keys(), file)?;
    let narrowed = |j: &usize| {
        let (low, high) = limit(j)?;
        let name = &joints[*j].name;
        let Some((key, &[own_low, own_high])) = of_joint::find(&file.joints.limits_rad, name, file)
        else {
            return Ok((low, high));
        };
        if !(low <= own_low && own_low < own_high && own_high <= high) {
            let message = format!("of `{name}` are not within the MJCF's {low} to {high}");
            return c.refuse(format!("joints.limits_rad.{key}"), message);
        }
        Ok((own_low, own_high))
    };
    actuated.iter().map(narrowed).collect()
}

/// Gains of each actuated joint.
fn gains(c: &Checker<'_>, file: &RobotFile) -> Result<Vec<Gains>, ModelError> {
    let table = &file.control;
    of_joint::known(c, "control.joint", table.joint.keys(), file)?;
    let of = |name: &String| {
        let own = of_joint::find(&table.joint, name, file).map(|(_, gains)| gains);
        Gains {
            kp_nm_per_rad: own.and_then(|g| g.kp_nm_per_rad).unwrap_or(table.kp_nm_per_rad),
            kd_nm_s_per_rad: own.and_then(|g| g.kd_nm_s_per_rad).unwrap_or(table.kd_nm_s_per_rad),
        }
    };
    Ok(file.joints.actuated.iter().map(of).collect())
}

/// How well the figures of each link were measured.
fn measured(
    c: &Checker<'_>,
    file: &RobotFile,
    links: &[Link],
) -> Result<Vec<Measured>, ModelError> {
    let mut all = vec![Measured::default(); links.len()];
    for (name, own) in &file.measured {
        let place = find(c, "measured", "body", name, links.iter().map(|l| l.name.as_str()))?;
        let mass_kg = links[place].mass_kg;
        for (key, tolerance, most) in [("mass_kg", own.mass_kg, mass_kg), ("com_m", own.com_m, 1.0)]
        {
            let at = format!("measured.{name}.{key}");
            c.within(&at, tolerance.unwrap_or(0.0), 0.0, most)?;
        }
        all[place] = *own;
    }
    Ok(all)
}

fn site(c: &Checker<'_>, sites: &[Site], at: &str, name: &str) -> Result<usize, ModelError> {
    find(c, at, "site", name, sites.iter().map(|s| s.name.as_str()))
}

/// How far ahead of its first end the heading line of a single site ends, m.
const HEADING_ARM_M: f64 = 0.1;

/// Index of the torso's link, and the hind and the front end of the heading line.
fn frames(
    c: &Checker<'_>,
    file: &RobotFile,
    links: &[Link],
    sites: &[Site],
) -> Result<(usize, Option<(Site, Site)>), ModelError> {
    let Some(f) = &file.frames else { return Ok((0, None)) };
    let links = links.iter().map(|l| l.name.as_str());
    let torso = find(c, "frames.torso", "body", &f.torso, links)?;
    let named = |key: &str, name: &str| {
        let place = site(c, sites, &format!("frames.{key}"), name)?;
        Ok(sites[place].clone())
    };
    let line = match (&f.heading, &f.heading_hind, &f.heading_front) {
        (None, Some(hind), Some(front)) => {
            Some((named("heading_hind", hind)?, named("heading_front", front)?))
        }
        (Some(axis), None, None) => {
            let hind = named("heading", axis)?;
            let ahead = Pose::from_pos([HEADING_ARM_M, 0.0, 0.0]);
            let link_from_site = hind.link_from_site.compose(&ahead);
            let front = Site { link_from_site, ..hind.clone() };
            Some((hind, front))
        }
        (None, None, None) => None,
        _ => {
            let message = "give `heading`, or heading_hind and heading_front, which go together";
            return c.refuse("frames", message);
        }
    };
    Ok((torso, line))
}
