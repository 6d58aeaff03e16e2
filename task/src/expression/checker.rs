//! Reading an expression into the steps of a program: names, numbers of values, units.

use super::parse::{Infix, Tree};
use super::program::{Act, FUNCTIONS, Pair, Program, STACK_MAX, Step};
use super::signal::{Known, Names, Reason, SIGNALS, Shape, Signal};
use super::unit::Unit;

/// What is known of a part of an expression.
#[derive(Clone, Copy, Debug)]
pub(super) struct Typed {
    pub shape: Shape,
    /// `None`: a plain number, of whatever unit is needed.
    pub unit: Option<Unit>,
}

/// Compiles, and keeps what it has found.
pub(super) struct Checker<'a> {
    /// `None`: the robot is not known, members of joints and feet are taken on trust.
    names: Option<Names<'a>>,
    steps: Vec<Step>,
    simulated: Option<Signal>,
}

impl<'a> Checker<'a> {
    pub fn new(names: Option<Names<'a>>) -> Self {
        Self { names, steps: Vec::new(), simulated: None }
    }

    pub fn finish(self, typed: Typed) -> Program {
        Program {
            len: self.len(typed.shape),
            steps: self.steps,
            shape: typed.shape,
            unit: typed.unit,
            simulated: self.simulated,
        }
    }

    fn len(&self, shape: Shape) -> usize {
        match (shape, self.names) {
            (Shape::Scalar, _) => 1,
            (Shape::Three, _) => 3,
            (Shape::Joints, Some(names)) => names.joints.len(),
            (Shape::Feet, Some(names)) => names.feet.len(),
            (_, None) => 1,
        }
    }

    pub fn compile(&mut self, tree: &Tree) -> Result<Typed, Reason> {
        if self.steps.len() >= STACK_MAX {
            return Err(format!("has more than {STACK_MAX} steps"));
        }
        match tree {
            Tree::Number(value) => {
                self.steps.push(Step::Number(*value));
                Ok(Typed { shape: Shape::Scalar, unit: None })
            }
            Tree::Name(name) => {
                let signal = self.signal(name)?;
                self.steps.push(Step::Load(signal));
                Ok(typed(signal))
            }
            Tree::Member(of, member) => self.member(of, member),
            Tree::Negative(of) => {
                let of = self.compile(of)?;
                let len = self.len(of.shape);
                self.steps.push(Step::Negate { len });
                Ok(of)
            }
            Tree::Power(of, power) => {
                let of = self.compile(of)?;
                let len = self.len(of.shape);
                let step = Step::Power { power: i32::from(*power), len };
                self.steps.push(step);
                Ok(Typed { unit: of.unit.map(|unit| unit.power(2 * power)), ..of })
            }
            Tree::Binary(infix, left, right) => {
                let (left, right) = (self.compile(left)?, self.compile(right)?);
                self.infix(*infix, left, right)
            }
            Tree::Call(name, arguments) => self.call(name, arguments),
        }
    }

    fn signal(&mut self, name: &str) -> Result<Signal, Reason> {
        let signal = Signal::named(name).ok_or_else(|| {
            let known: Vec<&str> = SIGNALS.iter().map(|row| row.name).collect();
            format!("names `{name}`, which is no signal; there are: {}", known.join(", "))
        })?;
        if signal.info().known == Known::Simulated {
            self.simulated.get_or_insert(signal);
        }
        Ok(signal)
    }

    fn member(&mut self, of: &Tree, member: &str) -> Result<Typed, Reason> {
        let Tree::Name(name) = of else {
            let of = self.compile(of)?;
            let at = axis(member).filter(|_| of.shape == Shape::Three);
            let at = at.ok_or_else(|| format!("has `.{member}` behind what has no such part"))?;
            self.steps.push(Step::Element { at, of: 3 });
            return Ok(Typed { shape: Shape::Scalar, ..of });
        };
        let signal = self.signal(name)?;
        let among = |names: &[String], what: &str| {
            let found = names.iter().position(|n| n == member);
            found.ok_or_else(|| {
                let known = names.join(", ");
                format!("has `{name}.{member}`, but the robot has no such {what}; it has: {known}")
            })
        };
        let at = match (signal.info().shape, self.names) {
            (Shape::Three, _) => axis(member)
                .ok_or_else(|| format!("has `{name}.{member}`; `{name}` has .x, .y and .z"))?,
            (Shape::Scalar, _) => {
                return Err(format!("has `{name}.{member}`, but `{name}` is one number"));
            }
            (_, None) => 0,
            (Shape::Joints, Some(names)) => among(names.joints, "joint")?,
            (Shape::Feet, Some(names)) => among(names.feet, "foot")?,
        };
        self.steps.push(Step::Pick(signal, at));
        Ok(Typed { shape: Shape::Scalar, ..typed(signal) })
    }

    fn infix(&mut self, infix: Infix, left: Typed, right: Typed) -> Result<Typed, Reason> {
        let (pair, word) = match infix {
            Infix::Plus => (Pair::Plus, "+"),
            Infix::Minus => (Pair::Minus, "-"),
            Infix::Times => (Pair::Times, "*"),
            Infix::Over => (Pair::Over, "/"),
            Infix::Less => (Pair::Less, "<"),
            Infix::LessOrEqual => (Pair::LessOrEqual, "<="),
        };
        let unit = match infix {
            Infix::Times => product(left, right, 1),
            Infix::Over => product(left, right, -1),
            Infix::Plus | Infix::Minus => same_unit(word, left, right)?,
            Infix::Less | Infix::LessOrEqual => {
                same_unit(word, left, right)?;
                Some(Unit::ONE)
            }
        };
        let shape = self.pair(pair, word, left, right)?;
        Ok(Typed { shape, unit })
    }

    /// Puts a step for two operands; the shape of its result.
    fn pair(&mut self, pair: Pair, word: &str, left: Typed, right: Typed) -> Result<Shape, Reason> {
        let shape = match (left.shape, right.shape) {
            (a, b) if a == b => a,
            (Shape::Scalar, b) => b,
            (a, Shape::Scalar) => a,
            (a, b) => {
                return Err(format!(
                    "has `{word}` between what is {} and what is {}",
                    a.name(),
                    b.name()
                ));
            }
        };
        // One value per joint of a robot with one joint is not stretched over x, y, z: shapes decide.
        let lens = [self.len(left.shape), self.len(right.shape)];
        self.steps.push(Step::Binary { pair, lens });
        Ok(shape)
    }

    fn call(&mut self, name: &str, arguments: &[Tree]) -> Result<Typed, Reason> {
        let function = FUNCTIONS.iter().find(|row| row.name == name);
        let function = function.ok_or_else(|| {
            let known: Vec<&str> = FUNCTIONS.iter().map(|row| row.name).collect();
            format!("calls `{name}`, which is no function; there are: {}", known.join(", "))
        })?;
        let (needs, given) = (function.arguments, arguments.len());
        if needs != given {
            return Err(format!("calls `{name}` with {given} arguments, it takes {needs}"));
        }
        match function.act {
            Act::Where => self.choose(arguments),
            Act::Clamp => {
                let (value, low) = (self.compile(&arguments[0])?, self.compile(&arguments[1])?);
                let value = self.bounded(Pair::Max, name, value, low)?;
                let high = self.compile(&arguments[2])?;
                self.bounded(Pair::Min, name, value, high)
            }
            Act::Min | Act::Max => {
                let (left, right) = (self.compile(&arguments[0])?, self.compile(&arguments[1])?);
                let pair = if function.act == Act::Min { Pair::Min } else { Pair::Max };
                self.bounded(pair, name, left, right)
            }
            act => {
                let of = self.compile(&arguments[0])?;
                self.one(act, name, of)
            }
        }
    }

    fn bounded(&mut self, pair: Pair, name: &str, a: Typed, b: Typed) -> Result<Typed, Reason> {
        let unit = same_unit(name, a, b)?;
        let shape = self.pair(pair, name, a, b)?;
        Ok(Typed { shape, unit })
    }

    /// `where(c, a, b)` as (a where c) + (b where not c): a value that is not finite on the side that is not
    /// taken does no harm.
    fn choose(&mut self, arguments: &[Tree]) -> Result<Typed, Reason> {
        let mut side = |which: usize, pair| {
            let value = self.compile(&arguments[which])?;
            let condition = self.compile(&arguments[0])?;
            let shape = self.pair(pair, "where", value, condition)?;
            Ok::<_, Reason>(Typed { shape, ..value })
        };
        let yes = side(1, Pair::Masked)?;
        let no = side(2, Pair::Unmasked)?;
        self.bounded(Pair::Plus, "where", yes, no)
    }

    /// A function of one argument.
    fn one(&mut self, act: Act, name: &str, of: Typed) -> Result<Typed, Reason> {
        let len = self.len(of.shape);
        match act {
            Act::Exp | Act::Sin | Act::Cos | Act::Tanh => {
                if let Some(unit) = of.unit.filter(|unit| *unit != Unit::ONE) {
                    return Err(format!(
                        "takes `{name}` of a quantity in {unit}; divide by one first"
                    ));
                }
                self.steps.push(Step::Each { act, len });
                Ok(Typed { unit: Some(Unit::ONE), ..of })
            }
            Act::Abs | Act::Sqrt => {
                self.steps.push(Step::Each { act, len });
                let halves = if act == Act::Sqrt { 1 } else { 2 };
                Ok(Typed { unit: of.unit.map(|unit| unit.power(halves)), ..of })
            }
            _ => {
                self.steps.push(Step::Reduce { act, len });
                Ok(Typed { shape: Shape::Scalar, ..of })
            }
        }
    }
}

fn typed(signal: Signal) -> Typed {
    let info = signal.info();
    Typed { shape: info.shape, unit: Some(info.unit) }
}

fn axis(name: &str) -> Option<usize> {
    ["x", "y", "z"].iter().position(|axis| *axis == name)
}

/// The unit of a product: unknown as soon as a plain number may carry one.
fn product(left: Typed, right: Typed, sign: i16) -> Option<Unit> {
    Some(left.unit?.times(right.unit?, sign))
}

/// The common unit of what is added, subtracted or compared.
fn same_unit(word: &str, left: Typed, right: Typed) -> Result<Option<Unit>, Reason> {
    match (left.unit, right.unit) {
        (Some(a), Some(b)) if a != b => Err(format!("has `{word}` between {a} and {b}")),
        (a, b) => Ok(a.or(b)),
    }
}
