//! A robot file and an MJCF of the supported subset from what other tools write: any MJCF, or a URDF.
//!
//! Reading goes on after a fault: all that is refused is said at once, each with file, line and what to do.
//! What cannot be kept but does not stand in the way (meshes for the eye, cameras, closed loops) is passed over
//! with a note. Bodies that are welded together become one; what is not written (inertia of a body, a name)
//! follows as in MuJoCo.

mod doubts;
mod finish;
mod options;
mod robot_toml;
mod sole;
mod stance;
mod urdf;
mod weld;
mod write;

use std::path::Path;

use crate::error::ModelError;
use crate::mjcf;
use crate::model::RobotModel;
use crate::tree::{self, Element, Remarks};

pub use crate::error::Remark;
pub use options::{ImportOptions, Weld};

/// What became of a file.
#[derive(Clone, Debug)]
pub struct Imported {
    /// Name of the robot, and of both files.
    pub name: String,
    /// `NAME.xml`.
    pub mjcf: String,
    /// `NAME.robot.toml`.
    pub robot_toml: String,
    /// What was passed over or assumed.
    pub notes: Vec<Remark>,
}

/// Why a file is no robot.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// It cannot be read, or is not XML.
    #[error(transparent)]
    File(#[from] ModelError),
    /// It has what cannot be had here.
    #[error("{}", all(refusals))]
    Refused {
        /// What, each with what to do.
        refusals: Vec<Remark>,
        /// What was passed over, assumed or doubted until then: often why.
        notes: Vec<Remark>,
    },
}

impl From<Remarks> for ImportError {
    fn from(Remarks { refusals, notes, .. }: Remarks) -> Self {
        Self::Refused { refusals, notes }
    }
}

/// Every refusal, one a line.
fn all(refusals: &[Remark]) -> String {
    let lines: Vec<String> = refusals.iter().map(ToString::to_string).collect();
    lines.join("\n")
}

/// Reads an MJCF or a URDF.
///
/// # Errors
/// [`ImportError`]; of what is refused, everything at once.
pub fn import(file: &Path, options: &ImportOptions) -> Result<Imported, ImportError> {
    let mut remarks = Remarks::default();
    let mut root = tree::read(file, &mut remarks)?;
    let robot = match root.tag.as_str() {
        "mujoco" => mjcf::read(&root, file, &mut remarks),
        "robot" => {
            unexpanded(&root, file, &mut remarks)?;
            let free_base = options.free_base.or(floats(&mut root).then_some(true));
            urdf::read(&root, file, &ImportOptions { free_base, ..options.clone() }, &mut remarks)
        }
        other => {
            remarks.refuse(&root, format!("<{other}> is neither <mujoco> nor <robot>"));
            None
        }
    };
    let read = remarks.refusals.is_empty();
    if let (false, Some(robot)) = (read, &robot) {
        doubts::say(robot, &root, &mut remarks);
    }
    let Some(mut robot) = robot.filter(|_| read) else {
        return Err(remarks.into());
    };
    let stem = file.file_stem().map(|s| s.to_string_lossy().into_owned());
    let name = options.name.clone().or(robot.name.take()).or(stem);
    let name = plain(&name.unwrap_or_default());
    weld::weld(&mut robot, &options.weld, &root, &mut remarks);
    finish::finish(&mut robot, &root, &mut remarks);
    doubts::say(&robot, &root, &mut remarks);
    if !remarks.refusals.is_empty() {
        return Err(remarks.into());
    }
    if robot.home.is_empty() && robot.free_base {
        robot.home_is_ours = stance::find(&mut robot);
        stance::off_the_stops(&mut robot);
        let message = if robot.home_is_ours {
            "no pose to stand in: one was worked out, with feet or wheels below where their legs begin; look at it \
             (`caudata sim show`), or put angles of yours into [pose.nominal_rad]"
        } else {
            "no pose to stand in: the nominal pose is 0, or near it and off the end of a joint's range; where `caudata \
             robot check` says that it does not stand so, put angles in which it does into [pose.nominal_rad]"
        };
        remarks.note(&root, message);
    }
    let base = &robot.bodies[0];
    let limbs = robot.bodies.iter().filter(|body| body.parent == Some(0)).count();
    let held = match base.joints.len() {
        0 if root.tag == "mujoco" && limbs > 1 => Some("has no joint"),
        2.. if !finish::driven(&robot, 0) => Some("moves on joints without a drive"),
        _ => None,
    };
    if let Some(why) = held.filter(|_| !robot.free_base) {
        let message = format!(
            "{why}, so it counts as held and no preset trains it; for a robot that walks in space write <freejoint/> there"
        );
        remarks.note_of(&base.element, message);
    }
    if root.tag == "mujoco" && options.free_base.is_some_and(|free| free != robot.free_base) {
        let message =
            "`--base` is of a URDF: an MJCF has a <freejoint/> in its root body where that is free";
        remarks.note_of(&robot.bodies[0].element, message);
    }
    let rolls = robot.bodies.iter().any(finish::wheel);
    if robot.free_base && !rolls && robot_toml::feet(&robot).is_empty() {
        let message = "no foot and no wheel: no shape at the end of a leg touches the ground (a mesh that is missing does \
                       not); for a robot that walks give each a sphere, for one that rolls each wheel a cylinder";
        remarks.note(&root, message);
    }
    weld::name_others(&robot, &root, &mut remarks);
    robot_toml::raise(&mut robot, &root, &mut remarks);
    let mjcf = write::mjcf(&name, &robot);
    let robot_toml = robot_toml::write(&name, file, &robot, &remarks.notes);
    // whatever this reader let through that the strict one does not
    let label = format!("{name}.robot.toml");
    if let Err(error) = RobotModel::from_bytes(&label, robot_toml.as_bytes(), mjcf.as_bytes()) {
        let message = format!("the robot made of it could not be read again: {error}");
        remarks.refuse_plain(&root.file, message);
        return Err(remarks.into());
    }
    Ok(Imported { name, mjcf, robot_toml, notes: remarks.notes })
}

/// Takes a floating joint out, and the world that it hangs on if that holds nothing else: what it carries is the base
/// of a URDF. Whether there was one.
fn floats(root: &mut Element) -> bool {
    let on = |e: &Element, tag: &str| Some(e.first(tag)?.get("link")?.to_owned());
    let floating = |e: &Element| e.tag == "joint" && e.get("type") == Some("floating");
    let Some(at) = root.children.iter().position(floating) else { return false };
    let world = on(&root.children[at], "parent");
    let joints = || root.all("joint").map(|j| [on(j, "parent"), on(j, "child")]);
    let alone = joints().flatten().filter(|link| *link == world).count() == 1;
    let is_world = |e: &Element| e.tag == "link" && e.get("name") == world.as_deref();
    let empty = root.children.iter().any(|e| is_world(e) && e.children.is_empty());
    if alone && empty {
        root.children.remove(at);
        root.children.retain(|e| !is_world(e));
    }
    alone && empty
}

/// Macros that nobody expanded are no robot yet.
fn unexpanded(root: &Element, file: &Path, remarks: &mut Remarks) -> Result<(), ImportError> {
    let Some(macros) =
        root.find(&|e| e.of_xacro || e.attributes.values().any(|v| v.contains("${")))
    else {
        return Ok(());
    };
    let name = file.display();
    let plain = file.with_extension("");
    let plain = match plain.extension() {
        Some(_) => plain,
        // not onto itself: the shell would empty it first
        None if file.extension().is_some_and(|e| e == "urdf") => file.with_extension("plain.urdf"),
        None => file.with_extension("urdf"),
    };
    let message = format!(
        "{} is of xacro, whose macros are to be expanded first: `xacro {name} > {}`, then import that",
        macros.label(),
        plain.display()
    );
    remarks.refuse(macros, message);
    Err(std::mem::take(remarks).into())
}

/// Letters, digits, _ and - only, in small letters.
fn plain(name: &str) -> String {
    let name = finish::word(name).trim_matches('_').to_lowercase();
    if name.is_empty() { "robot".to_owned() } else { name }
}
