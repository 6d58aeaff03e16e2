//! What an effect is: a record with a hook, and what most records share.

use caudata_declare::named;
use caudata_model::{JointMotion, Measured, RobotModel, ServoParams};

use crate::excitation::Excitation;
use crate::place::{Domain, Place, places};
use crate::plant::{Plant, lever};
use crate::units::at_joint;

named! {
    /// Where in the chain an effect acts.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Layer {
        /// What is read.
        Sensing = "sensing",
        /// When it is sent and read.
        Timing = "timing",
        /// Position loop, motor, supply.
        Actuation = "actuation",
        /// Friction, gear.
        Transmission = "transmission",
        /// Play, springs, stops.
        Structure = "structure",
        /// Masses.
        Inertia = "inertia",
        /// Ground.
        Contact = "contact",
        /// Water.
        Water = "water",
    }
}

/// Measure of a parameter on a given robot, so that one grid serves small and large servos.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reference {
    /// 1.
    One,
    /// A radian; of slides what counts as one.
    Angle,
    /// The same of a compliance: its square.
    AngleSquared,
    /// A radian; of slides so many metres as friction springs before it slides for one that a hinge's does.
    Presliding,
    /// The servo's largest torque, N·m.
    Torque,
    /// The servo's speed without load, rad/s.
    Speed,
    /// Torque over speed, N·m·s/rad.
    Damping,
    /// Rotor inertia at the joint, kg·m².
    Armature,
    /// The position gain, N·m/rad.
    Gain,
    /// Mass of the link, kg.
    Mass,
    /// From the link's joint to its centre of mass, m.
    Lever,
}

/// One parameter of an effect.
#[derive(Debug, Clone, Copy)]
pub struct ParameterSpec {
    /// Name with unit, as in reports.
    pub name: &'static str,
    /// SI unit.
    pub unit: &'static str,
    /// Smallest value, in units of the reference.
    pub low: f64,
    /// Largest value, in units of the reference.
    pub high: f64,
    /// Value without the effect, in units of the reference. Not a number: what the robot file has.
    pub neutral: f64,
    /// Smallest change that matters, in units of the reference.
    pub scale: f64,
    /// What the above are measured in.
    pub reference: Reference,
}

/// One physical effect.
pub struct Effect {
    /// Id of GAP.md.
    pub id: &'static str,
    /// Where in the chain.
    pub layer: Layer,
    /// On what.
    pub domain: Domain,
    /// The first is its size, with those of the same unit (a centre of mass has three).
    pub parameters: &'static [ParameterSpec],
    /// Sizes to try, one value per parameter, in units of the references. What is smooth is tried the other way
    /// round with them.
    pub grid: &'static [&'static [f64]],
    /// Whether its trace starts with a threshold (gap, stop, limit), so that a derivative at nothing says
    /// nothing.
    pub hinge: bool,
    /// Changes as a run or a session goes on, so that what one shows of it says nothing of the next.
    pub drifts: bool,
    /// Whether at one joint of a held robot it moves the others so much that it is looked for there with few others.
    pub apart: bool,
    /// Whether its parameters are the lowest and the highest position of a joint: where the joint came to is tried too.
    pub ends: bool,
    /// Whether runs have what it is about at all.
    pub of_runs: fn(&Excitation) -> bool,
    /// Whether a joint with this servo may have it.
    pub of_servo: fn(&ServoParams) -> bool,
    /// How far the parameters of a link's effect may be from neutral where the robot file says how well that was
    /// measured, SI: by a link's tolerances and mass (kg).
    pub measured: fn(&Measured, f64) -> Option<f64>,
    /// Puts it into a plant. `values` in SI, one per parameter.
    pub apply: fn(&mut Plant, &Place, &[f64]),
    /// Effects that look like it: ids, with spaces between.
    pub look_alikes: &'static str,
    /// Figures of the robot file that it scales or adds to: of the servo, or by their paths; with spaces between.
    pub corrects: &'static str,
    /// Why the runs cannot show it, if so.
    pub unseen: fn(&Excitation, &Place) -> Option<&'static str>,
    /// A trial that shows it.
    pub trial: &'static str,
    /// How it differs from its look-alikes, in one line.
    pub signature: &'static str,
}

impl std::fmt::Debug for Effect {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.id)
    }
}

impl PartialEq for Effect {
    fn eq(&self, other: &Self) -> bool {
        self.id == other.id
    }
}

impl Effect {
    /// Everywhere that it can act on a robot, widest first.
    pub fn places(&self, model: &RobotModel) -> Vec<Place> {
        let mut all = places(model, self.domain);
        all.retain(|p| self.may_be(model, p));
        // N and N·m, m and rad are no one size
        let of_joint = |p: &ParameterSpec| p.reference != Reference::One || p.unit == "rad";
        if self.domain == Domain::Joints && self.parameters.iter().any(of_joint) {
            all.retain(|p| {
                p.items.iter().all(|&a| model.per_radian(a) == model.per_radian(p.items[0]))
            });
        }
        all
    }

    /// Whether what stands at `place` may have it at all: no servo without what it needs has it, and no link that was
    /// measured more finely than what matters.
    pub fn may_be(&self, model: &RobotModel, place: &Place) -> bool {
        let joints = Some(&place.items).filter(|_| place.domain == Domain::Joints);
        let matters = |far: f64| far >= self.scale(model, place, 0);
        joints.into_iter().flatten().all(|&a| (self.of_servo)(model.servo(a)))
            && self.farthest(model, place, 0).is_none_or(matters)
    }

    /// How far parameter `index` may be from neutral by what was measured of the link at `place`, SI: only the first
    /// is a size, and those of its unit.
    fn farthest(&self, model: &RobotModel, place: &Place, index: usize) -> Option<f64> {
        let of_link = place.domain == Domain::Links;
        let size = self.parameters[index].unit == self.parameters[0].unit;
        let of = |&l: &usize| (self.measured)(&model.measured()[l], model.links()[l].mass_kg);
        let own = Some(&place.items).filter(|_| of_link && size)?.iter().filter_map(of);
        own.reduce(f64::min)
    }

    /// Ids of the effects that look like it.
    pub fn look_alikes(&self) -> impl Iterator<Item = &'static str> + use<> {
        self.look_alikes.split_ascii_whitespace()
    }

    /// Figures that it corrects at `place` and that nobody looked up, by their paths in the robot file.
    pub fn assumed(&self, model: &RobotModel, place: &Place) -> Vec<String> {
        let joints: Vec<usize> = match place.domain {
            Domain::Joints => place.items.clone(),
            _ => (0..model.actuated().len()).collect(),
        };
        let mut out: Vec<String> = Vec::new();
        for figure in self.corrects.split_ascii_whitespace() {
            let by_path = model.assumed().iter().filter(|path| *path == figure);
            let of_servos = joints.iter().filter_map(|&a| model.assumed_of_servo(a, figure));
            out.extend(by_path.cloned().chain(of_servos.map(str::to_owned)));
        }
        out.sort();
        out.dedup();
        out
    }

    /// Value of parameter `index` that is `units` references at `place`.
    pub fn value(&self, model: &RobotModel, place: &Place, index: usize, units: f64) -> f64 {
        units * reference(model, place, self.parameters[index].reference)
    }

    /// Grid point `k` at `place`, SI. `[P]`
    pub fn sizes(&self, model: &RobotModel, place: &Place, k: usize) -> Vec<f64> {
        (self.grid[k].iter().enumerate())
            .map(|(i, &units)| self.value(model, place, i, units))
            .collect()
    }

    /// Values without the effect, SI. `[P]`
    pub fn neutral(&self, model: &RobotModel, place: &Place) -> Vec<f64> {
        (0..self.parameters.len())
            .map(|i| {
                let neutral = self.parameters[i].neutral;
                if neutral.is_nan() {
                    return model.backlash().half_width_rad;
                }
                self.value(model, place, i, neutral)
            })
            .collect()
    }

    /// SI unit of parameter `index`: at joints that slide without radians.
    pub fn unit(&self, model: &RobotModel, place: &Place, index: usize) -> &'static str {
        let unit = self.parameters[index].unit;
        match place.items.first() {
            Some(&a) if place.domain == Domain::Joints => at_joint(model, a, unit),
            _ => unit,
        }
    }

    /// Lowest and highest value of parameter `index`, SI.
    pub fn bounds(&self, model: &RobotModel, place: &Place, index: usize) -> (f64, f64) {
        let p = &self.parameters[index];
        let low = self.value(model, place, index, p.low);
        // of friction or inertia nobody can take more away than there is
        let there = match index {
            0 if model.extension().is_none() => of_joints(model, place, self.corrects),
            _ => None,
        };
        let high = self.value(model, place, index, p.high);
        let low = there.map_or(low, |there| low.max(0.0 - there));
        let neutral = self.value(model, place, index, p.neutral);
        match self.farthest(model, place, index) {
            Some(far) => (low.max(neutral - far), high.min(neutral + far)),
            None => (low, high),
        }
    }

    /// Whether parameter `index` wants to go further than is plausible: its value lies on a bound. Without
    /// the effect, and where there is none at all of what it counts, nothing does; nor where there is all of
    /// what it is a share of.
    pub fn at_bound(&self, model: &RobotModel, place: &Place, index: usize, value: f64) -> bool {
        let spec = &self.parameters[index];
        let a_share = spec.unit.is_empty() && (spec.low, spec.high) == (0.0, 1.0);
        let (low, high) = self.bounds(model, place, index);
        let near = 1e-6 * (high - low);
        let neutral = self.neutral(model, place)[index];
        let moved = (value - neutral).abs() >= near && value.abs() >= near;
        !a_share && moved && (value <= low + near || value >= high - near)
    }

    /// Smallest change of parameter `index` that matters, SI.
    pub fn scale(&self, model: &RobotModel, place: &Place, index: usize) -> f64 {
        self.value(model, place, index, self.parameters[index].scale)
    }
}

/// The greatest value of a joint's `figure` that is never below zero at `place`; `None` of any other figure.
fn of_joints(model: &RobotModel, place: &Place, figure: &str) -> Option<f64> {
    let of = |&a: &usize| {
        let joint = &model.joints()[model.actuated()[a]];
        match figure {
            "friction_loss_nm" => Some(joint.friction_loss_nm),
            "damping_nm_s_per_rad" => Some(joint.damping_nm_s_per_rad),
            _ => None,
        }
    };
    let joints = Some(&place.items).filter(|_| place.domain == Domain::Joints)?;
    joints.iter().filter_map(of).reduce(f64::max)
}

fn reference(model: &RobotModel, place: &Place, reference: Reference) -> f64 {
    let joints: Vec<usize> = match place.domain {
        Domain::Joints => place.items.clone(),
        _ => (0..model.actuated().len()).collect(),
    };
    let mean = |f: &dyn Fn(usize) -> f64| {
        joints.iter().map(|&a| f(a)).sum::<f64>() / joints.len().max(1) as f64
    };
    let joint = |a: usize| &model.joints()[model.actuated()[a]];
    let of_links = |f: &dyn Fn(usize) -> f64| {
        place.items.iter().map(|&l| f(l)).sum::<f64>() / place.items.len().max(1) as f64
    };
    match reference {
        Reference::One => 1.0,
        Reference::Angle => mean(&|a| model.per_radian(a)),
        Reference::AngleSquared => mean(&|a| model.per_radian(a).powi(2)),
        Reference::Presliding => mean(&|a| match joint(a).motion {
            JointMotion::Hinge => 1.0,
            JointMotion::Slide => 0.05,
        }),
        Reference::Torque => mean(&|a| model.servo(a).tau_max_nm),
        Reference::Speed => mean(&|a| model.servo(a).qd_max_radps),
        Reference::Damping => mean(&|a| model.servo(a).tau_max_nm / model.servo(a).qd_max_radps),
        Reference::Armature => mean(&|a| joint(a).armature_kgm2.max(1e-4)),
        Reference::Gain => mean(&|a| model.kp_nm_per_rad(a)).max(1e-6),
        Reference::Mass => of_links(&|l| model.links()[l].mass_kg),
        Reference::Lever => of_links(&|l| lever(model, l).1),
    }
}

/// A parameter: name, unit, neutral, low, high, smallest that matters, reference.
pub(super) const fn parameter(
    name: &'static str,
    unit: &'static str,
    neutral: f64,
    (low, high): (f64, f64),
    scale: f64,
    reference: Reference,
) -> ParameterSpec {
    ParameterSpec { name, unit, low, high, neutral, scale, reference }
}

/// What a record says unless it says otherwise; a family's record builds on it.
pub(super) const PLAIN: Effect = Effect {
    id: "",
    layer: Layer::Sensing,
    domain: Domain::Robot,
    parameters: &[],
    grid: &[],
    hinge: false,
    drifts: false,
    apart: false,
    ends: false,
    of_runs: |_| true,
    of_servo: |_| true,
    measured: |_, _| None,
    apply: |_, _, _| {},
    look_alikes: "",
    corrects: "",
    unseen: |_, _| None,
    trial: "",
    signature: "",
};

/// For effects that any motion of the joints shows.
pub(super) fn needs_motion(e: &Excitation, place: &Place) -> Option<&'static str> {
    (e.fastest_radps(place) < 0.2).then_some("the joint hardly moves in these runs")
}

/// A grid for an effect of one parameter.
pub(super) const fn one<const N: usize>(sizes: &'static [f64; N]) -> [&'static [f64]; N] {
    let mut grid: [&[f64]; N] = [&[]; N];
    let mut k = 0;
    while k < N {
        grid[k] = std::slice::from_ref(&sizes[k]);
        k += 1;
    }
    grid
}

/// A grid from an array of its points.
pub(super) const fn rows<const N: usize, const P: usize>(
    points: &'static [[f64; P]; N],
) -> [&'static [f64]; N] {
    let mut grid: [&[f64]; N] = [&[]; N];
    let mut k = 0;
    while k < N {
        grid[k] = points[k].as_slice();
        k += 1;
    }
    grid
}
