//! MJCF: what every element is read with: settings, default classes, places.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use super::compiler::Compiler;
use crate::geometry::Inertial;
use crate::mesh::Meshes;
use crate::pose::{self, Pose, z_to};
use crate::tree::{Element, Remarks};
use crate::types::Softness;

/// Between these MuJoCo holds impedances.
const IMPEDANCE: (f64, f64) = (1e-4, 0.9999);

/// Elements that are actuators of a joint; all share one kind of default.
const KINDS: &[&str] = &[
    "general",
    "motor",
    "position",
    "velocity",
    "intvelocity",
    "damper",
    "cylinder",
    "muscle",
    "adhesion",
    "plugin",
];

/// Under which element a class keeps the defaults of `tag`.
fn default_tag(tag: &str) -> &str {
    if KINDS.contains(&tag) { "actuator" } else { tag }
}

/// Everything needed to read an element.
pub(super) struct Context<'a> {
    pub compiler: Compiler,
    pub classes: BTreeMap<String, Class>,
    pub meshes: Meshes,
    pub remarks: &'a mut Remarks,
    pub from_geoms: FromGeoms,
    pub balance: bool,
    pub least_mass: f64,
    pub least_inertia: f64,
}

/// Attributes by element, and where each stands.
pub(super) type Class = BTreeMap<String, Element>;

#[derive(Clone, Copy, PartialEq)]
pub(super) enum FromGeoms {
    Never,
    Missing,
    Always,
}

impl<'a> Context<'a> {
    pub fn new(root: &Element, file: &Path, remarks: &'a mut Remarks) -> Self {
        let mut context = Self {
            compiler: Compiler::default(),
            classes: BTreeMap::from([("main".to_owned(), Class::new())]),
            meshes: Meshes::default(),
            remarks,
            from_geoms: FromGeoms::Missing,
            balance: false,
            least_mass: 0.0,
            least_inertia: 0.0,
        };
        for compiler in root.all("compiler") {
            context.compiler(compiler);
        }
        for default in root.all("default") {
            context.class(default, "main", true);
        }
        let meshes = root.all("asset").flat_map(|a| a.all("mesh"));
        let meshes: Vec<Element> = meshes.map(|mesh| context.resolved(mesh, None)).collect();
        context.meshes = Meshes::read(&meshes, root, file, context.remarks);
        context
    }

    fn compiler(&mut self, e: &Element) {
        for (key, value) in &e.attributes {
            match (key.as_str(), value.as_str()) {
                ("angle", "radian") => self.compiler.rad_per_unit = 1.0,
                ("angle", "degree") => self.compiler.rad_per_unit = 1f64.to_radians(),
                ("angle", other) => {
                    let what = "is neither radian nor degree";
                    self.remarks.refuse(e, format!("<compiler>: angle `{other}` {what}"));
                }
                ("autolimits", on) => self.compiler.autolimits = on != "false",
                ("eulerseq", sequence) if self.compiler.set_euler(sequence) => {}
                ("eulerseq", sequence) => {
                    let what = "is not three of x y z X Y Z";
                    self.remarks.refuse(e, format!("<compiler>: eulerseq `{sequence}` {what}"));
                }
                ("coordinate", "global") => {
                    self.remarks.refuse(e, "<compiler>: coordinate=\"global\" is not read; convert the file to local coordinates");
                }
                ("inertiafromgeom", "true") => self.from_geoms = FromGeoms::Always,
                ("inertiafromgeom", "false") => self.from_geoms = FromGeoms::Never,
                ("balanceinertia", "true") => self.balance = true,
                ("boundmass", _) => self.least_mass = e.number(key, self.remarks).unwrap_or(0.0),
                ("boundinertia", _) => {
                    self.least_inertia = e.number(key, self.remarks).unwrap_or(0.0)
                }
                ("settotalmass", total) if total.parse().is_ok_and(|x: f64| x > 0.0) => {
                    self.remarks.refuse(
                        e,
                        "<compiler>: settotalmass is not read; write the masses themselves",
                    );
                }
                ("discardvisual", "true") => {
                    self.remarks.refuse(e, "<compiler>: discardvisual=\"true\" is not read; take the visual shapes out");
                }
                _ => {}
            }
        }
    }

    /// Reads a class and those inside it.
    fn class(&mut self, e: &Element, parent: &str, outermost: bool) {
        let name = match (e.get("class"), outermost) {
            (Some(name), _) => name.to_owned(),
            (None, true) => "main".to_owned(),
            (None, false) => {
                self.remarks.refuse(e, "<default>: `class` is missing");
                return;
            }
        };
        let known = self.classes.get(&name);
        if known.is_some() && !outermost {
            self.remarks
                .refuse_if_strict(e, format!("attribute `class`: `{name}` is defined twice"));
        }
        let base = known.or_else(|| self.classes.get(parent));
        let mut class = base.cloned().unwrap_or_default();
        for child in e.children.iter().filter(|c| c.tag != "default") {
            let tag = default_tag(&child.tag).to_owned();
            let own = class.entry(tag).or_default();
            own.attributes.extend(child.attributes.clone());
            let place = Arc::new((child.file.clone(), child.line));
            let keys = child.attributes.keys().cloned();
            own.elsewhere.extend(keys.map(|key| (key, Arc::clone(&place))));
        }
        self.classes.insert(name.clone(), class);
        for child in e.all("default") {
            self.class(child, &name, false);
        }
    }

    /// The element with what its class adds.
    pub fn resolved(&mut self, e: &Element, childclass: Option<&str>) -> Element {
        let name = e.get("class").or(childclass).unwrap_or("main");
        let Some(class) = self.classes.get(name) else {
            // a childclass is refused where it stands
            if e.get("class").is_some() {
                let message = format!("attribute `class`: there is no default class `{name}`");
                self.remarks.refuse_of(e, message);
            }
            return e.clone();
        };
        let mut out = Element { children: Vec::new(), ..e.clone() };
        let Some(class) = class.get(default_tag(&e.tag)) else { return out };
        for (key, value) in &class.attributes {
            // one way of saying where something lies replaces the other
            let said = |other: &&str| e.attributes.contains_key(*other);
            let turns = ["quat", "euler", "axisangle", "xyaxes", "zaxis"];
            let is_turn = turns.contains(&key.as_str());
            if is_turn && turns.iter().any(said) || (is_turn || key == "pos") && said(&"fromto") {
                continue;
            }
            if !said(&key.as_str()) {
                out.attributes.insert(key.clone(), value.clone());
                out.elsewhere.insert(key.clone(), Arc::clone(&class.elsewhere[key]));
            }
        }
        out
    }

    /// Place and orientation of an element that is written in `frame`.
    pub fn place(&mut self, e: &Element, frame: &Pose) -> Pose {
        within(frame, self.pose(e))
    }

    /// Place and orientation of an element.
    pub fn pose(&mut self, e: &Element) -> Pose {
        let pos_m = e.array("pos", self.remarks).unwrap_or([0.0; 3]);
        let mut quat_wxyz = Pose::IDENTITY.quat_wxyz;
        if let Some(q) = e.array::<4>("quat", self.remarks) {
            let unit = pose::quat_normalised(q);
            if unit.is_none() {
                let message = "attribute `quat`: has length zero; it needs a direction";
                self.remarks.refuse_if_strict(e, message);
            }
            quat_wxyz = unit.unwrap_or(quat_wxyz);
        } else if let Some(angles) = e.array::<3>("euler", self.remarks) {
            quat_wxyz = self.compiler.euler_to_quat(angles);
        } else if let Some([x, y, z, angle]) = e.array::<4>("axisangle", self.remarks) {
            let length = pose::norm([x, y, z]).max(1e-12);
            let axis = [x, y, z].map(|c| c / length);
            quat_wxyz = pose::quat_from_axis_angle(axis, angle * self.compiler.rad_per_unit);
        } else if let Some([a, b, c, d, e2, f]) = e.array::<6>("xyaxes", self.remarks) {
            quat_wxyz = pose::quat_from_axes([a, b, c], [d, e2, f]).unwrap_or(quat_wxyz);
        } else if let Some(z) = e.array::<3>("zaxis", self.remarks) {
            let length = pose::norm(z).max(1e-12);
            quat_wxyz = z_to(z.map(|c| c / length));
        }
        Pose { pos_m, quat_wxyz }
    }

    pub fn bounded(&self, mut inertial: Inertial) -> Inertial {
        inertial.mass_kg = inertial.mass_kg.max(self.least_mass);
        for i in 0..3 {
            let moment = &mut inertial.inertia_kgm2[i][i];
            *moment = moment.max(self.least_inertia);
        }
        inertial
    }
}

/// What is written in `frame`. Without one, signs of zeros stay as they are: the same bits.
pub(super) fn within(frame: &Pose, own: Pose) -> Pose {
    if *frame == Pose::IDENTITY { own } else { frame.compose(&own) }
}

/// Whether there is a joint in it.
pub(super) fn moves(e: &Element) -> bool {
    let own = |c: &Element| matches!(c.tag.as_str(), "joint" | "freejoint");
    e.children.iter().any(|c| own(c) || moves(c))
}

/// How a constraint gives way, held within MuJoCo's limits.
pub(super) fn softness(e: &Element, solref: &str, solimp: &str, remarks: &mut Remarks) -> Softness {
    let mut out = Softness::default();
    let mut put = |key: &str, slots: &mut [f64]| {
        let given = e.some_numbers(key, slots.len(), remarks);
        for (slot, x) in slots.iter_mut().zip(given.unwrap_or_default()) {
            *slot = x;
        }
    };
    put(solref, &mut out.solref);
    put(solimp, &mut out.solimp);
    if !out.is_usable() {
        out.solref = Softness::default().solref;
        let message =
            "must be a time constant and a damping ratio above zero, or -stiffness and -damping";
        remarks.refuse_if_strict(e, format!("attribute `{solref}`: {message}"));
        remarks.note_of(e, format!("{solref} is not usable; MuJoCo's default is written"));
    }
    let [low, high, width, middle, _] = out.solimp;
    if !([low, high, middle].iter().all(|x| (0.0..1.0).contains(x)) && width >= 0.0) {
        let message = format!(
            "attribute `{solimp}`: must be two shares below one, a width, a share below one"
        );
        remarks.refuse_if_strict(e, message);
    }
    for i in [0, 1, 3].into_iter().filter(|_| !remarks.strict) {
        out.solimp[i] = out.solimp[i].clamp(IMPEDANCE.0, IMPEDANCE.1);
    }
    out.solimp[2] = out.solimp[2].max(0.0);
    let power = out.solimp[4];
    if power != 1.0 && power != 2.0 {
        out.solimp[4] = if power < 1.5 { 1.0 } else { 2.0 };
        let message = format!(
            "attribute `{solimp}`: has a power other than 1 and 2, which are those supported"
        );
        remarks.refuse_if_strict(e, message);
        remarks.note_once(e, format!("{solimp}: the power {power} is rounded to 1 or 2"));
    }
    out
}
