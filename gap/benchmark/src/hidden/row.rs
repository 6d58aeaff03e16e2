//! What a row of the catalogue of hidden effects says.

use caudata_model::RobotModel;

use crate::truth::sensors::Sensing;
use crate::truth::spec::{JointSpec, Spec};

/// A robot, its sensors, and what its log says about it.
#[derive(Clone, Debug)]
pub struct World {
    /// The robot.
    pub spec: Spec,
    /// What is read of it.
    pub sensing: Sensing,
    /// Supply that `log.toml` gives; `None`: the true one.
    pub declared_supply_v: Option<f64>,
    /// What the battery loses from the first run to the held-out ones, V.
    pub drained_v: f64,
}

impl World {
    pub(super) fn joint(&mut self, a: usize) -> &mut JointSpec {
        &mut self.spec.joints[a]
    }
}

/// How an effect is placed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// At one joint.
    Joint,
    /// At the robot as a whole.
    Global,
    /// At the robot as a whole, and only with several joints.
    Chain,
}

/// Where a true parameter ends up.
#[derive(Clone, Copy, Debug)]
pub struct TrueParameter {
    /// Words of which a reported parameter's name must have one (they name the quantity, not a spelling).
    pub names: &'static [&'static str],
    /// Unit.
    pub unit: &'static str,
    /// True value.
    pub value: f64,
    /// Value without the effect: errors are shares of the distance from it.
    pub nominal: f64,
}

/// How an effect gets into a world.
enum Change {
    /// Its size is added to one number of joint `a`, or of the robot.
    Adds(fn(&mut World, usize) -> &mut f64),
    /// At joint `a`, with a size.
    Does(fn(&mut World, &RobotModel, usize, f64)),
}

/// What a perfect diagnosis would report of an effect.
pub(super) struct Measure {
    pub names: &'static [&'static str],
    pub unit: &'static str,
    pub of: Of,
}

pub(super) enum Of {
    /// The number that the effect's size is added to; what it is without the effect.
    Sum(fn(&RobotModel, usize) -> f64),
    /// True value, and the one without the effect.
    Value(fn(&World, &RobotModel, usize) -> (f64, f64)),
    /// Which of the names it has, and the true value; 0 without the effect.
    Axis(fn(&World, &RobotModel, usize) -> (usize, f64)),
}

/// One effect that can be hidden.
pub struct Hidden {
    /// Id of the catalogue; laws outside it have a name that is in no catalogue.
    pub id: &'static str,
    /// Layer of the catalogue; of a law outside it, the layer where it acts.
    pub layer: &'static str,
    /// Where.
    pub scope: Scope,
    /// First guess and largest plausible size.
    pub sizes: (f64, f64),
    /// Whether the sign may be turned round.
    pub signed: bool,
    /// Ids that the same data fit exactly as well (on a rig with one joint, on one with several).
    pub equivalent: (&'static [&'static str], &'static [&'static str]),
    change: Change,
    truth: [Option<Measure>; 2],
}

/// What changes a link that hangs on one hinge, of which two numbers show: its moment of gravity and its inertia
/// about the hinge. Two of these are one robot with any other two, but for the two that are inertia alone, and with
/// a weight on the link.
const HANGING: [&str; 4] = ["link_mass", "link_com", "link_inertia", "armature"];
const INERTIA_ALONE: [&str; 2] = ["link_inertia", "armature"];
const WEIGHT: &str = "point_mass";

impl Hidden {
    /// Ids that the same data fit exactly as well where one of those is named too that they come with, on a
    /// rig with `joints` joints where the effects `hidden` are hidden: (id, named too).
    pub fn same_beside(&self, joints: usize, hidden: &[&str]) -> Vec<(&'static str, &'static str)> {
        let two = |a: &str, b: &str| {
            a != b
                && HANGING.contains(&a)
                && HANGING.contains(&b)
                && !(INERTIA_ALONE.contains(&a) && INERTIA_ALONE.contains(&b))
        };
        if joints != 1 || !hidden.iter().any(|other| two(self.id, other)) {
            return Vec::new();
        }
        let others = HANGING.into_iter().filter(|a| *a != self.id);
        let beside = others.flat_map(|a| HANGING.map(|b| (a, b))).filter(|(a, b)| two(a, b));
        beside.chain([(WEIGHT, WEIGHT)]).collect()
    }

    /// Puts it into `world`, at joint `a` where it has one.
    pub fn apply(&self, world: &mut World, model: &RobotModel, a: usize, size: f64) {
        match self.change {
            Change::Adds(number) => *number(world, a) += size,
            Change::Does(change) => change(world, model, a, size),
        }
    }

    /// What a perfect diagnosis of `world` would report.
    pub fn truth(&self, world: &World, model: &RobotModel, a: usize) -> Vec<TrueParameter> {
        let measured = self.truth.iter().flatten().map(|m| {
            let mut names = m.names;
            let (value, nominal) = match (&m.of, &self.change) {
                (Of::Value(of), _) => of(world, model, a),
                (Of::Axis(of), _) => {
                    let (axis, value) = of(world, model, a);
                    names = &m.names[axis..=axis];
                    (value, 0.0)
                }
                (Of::Sum(nominal), Change::Adds(number)) => {
                    (*number(&mut world.clone(), a), nominal(model, a))
                }
                (Of::Sum(_), Change::Does(_)) => (f64::NAN, f64::NAN),
            };
            TrueParameter { names, unit: m.unit, value, nominal }
        });
        measured.collect()
    }

    const fn new(id: &'static str, layer: &'static str, sizes: (f64, f64), change: Change) -> Self {
        Self {
            id,
            layer,
            scope: Scope::Joint,
            sizes,
            signed: false,
            equivalent: (&[], &[]),
            change,
            truth: [const { None }; 2],
        }
    }

    pub(super) const fn signed(mut self) -> Self {
        self.signed = true;
        self
    }

    pub(super) const fn global(mut self) -> Self {
        self.scope = Scope::Global;
        self
    }

    pub(super) const fn chain(mut self) -> Self {
        self.scope = Scope::Chain;
        self
    }

    pub(super) const fn like(
        mut self,
        one_joint: &'static [&'static str],
        several: &'static [&'static str],
    ) -> Self {
        self.equivalent = (one_joint, several);
        self
    }

    /// Reported as the number that is added to, which is 0 without the effect.
    pub(super) const fn sum(self, names: &'static [&'static str], unit: &'static str) -> Self {
        self.sum_on(names, unit, |_, _| 0.0)
    }

    /// Reported as the number that is added to, which is not 0 without the effect.
    pub(super) const fn sum_on(
        self,
        names: &'static [&'static str],
        unit: &'static str,
        nominal: fn(&RobotModel, usize) -> f64,
    ) -> Self {
        self.reported(Measure { names, unit, of: Of::Sum(nominal) })
    }

    pub(super) const fn value(
        self,
        names: &'static [&'static str],
        unit: &'static str,
        of: fn(&World, &RobotModel, usize) -> (f64, f64),
    ) -> Self {
        self.reported(Measure { names, unit, of: Of::Value(of) })
    }

    pub(super) const fn reported(mut self, as_this: Measure) -> Self {
        self.truth[0] = Some(as_this);
        self
    }

    /// Or reported as another quantity.
    pub(super) const fn or(
        mut self,
        names: &'static [&'static str],
        unit: &'static str,
        of: fn(&World, &RobotModel, usize) -> (f64, f64),
    ) -> Self {
        self.truth[1] = Some(Measure { names, unit, of: Of::Value(of) });
        self
    }
}

/// An effect whose size is added to a number.
pub(super) const fn adds(
    id: &'static str,
    layer: &'static str,
    sizes: (f64, f64),
    number: fn(&mut World, usize) -> &mut f64,
) -> Hidden {
    Hidden::new(id, layer, sizes, Change::Adds(number))
}

/// An effect that does something else.
pub(super) const fn does(
    id: &'static str,
    layer: &'static str,
    sizes: (f64, f64),
    change: fn(&mut World, &RobotModel, usize, f64),
) -> Hidden {
    Hidden::new(id, layer, sizes, Change::Does(change))
}
