//! The compiled form, and the checks on the way to it.

use super::parse::{Infix, Tree};
use super::signal::{Known, SIGNALS, Shape, Signal};
use super::unit::Unit;
use super::{Names, Reason};

/// Most values on the stack: a few vectors of joints.
const STACK_MAX: usize = 512;

/// Where the values of signals come from.
pub trait Source {
    /// The values of a signal: one, three, or one per joint or foot.
    fn values(&self, signal: Signal) -> &[f32];
}

/// A row of the table of functions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FunctionInfo {
    /// Name in expressions.
    pub name: &'static str,
    /// How many arguments it takes.
    pub arguments: usize,
    /// What it gives.
    pub about: &'static str,
    act: Act,
}

/// What a function does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Act {
    Abs,
    Sqrt,
    Exp,
    Sin,
    Cos,
    Tanh,
    Sum,
    Mean,
    Norm,
    Least,
    Most,
    Min,
    Max,
    Clamp,
    Where,
}

macro_rules! functions {
    ($($act:ident = $name:literal, $arguments:literal, $about:literal;)+) => {
        /// Every function.
        pub const FUNCTIONS: &[FunctionInfo] = &[$(FunctionInfo {
            name: $name,
            arguments: $arguments,
            about: $about,
            act: Act::$act,
        }),+];
    };
}

functions! {
    Abs = "abs", 1, "size of each value";
    Sqrt = "sqrt", 1, "square root of each value, 0 below 0";
    Exp = "exp", 1, "e to the power of each value, a pure number";
    Sin = "sin", 1, "sine of each angle, rad";
    Cos = "cos", 1, "cosine of each angle, rad";
    Tanh = "tanh", 1, "hyperbolic tangent of each value, a pure number";
    Sum = "sum", 1, "sum of the values, 0 of none";
    Mean = "mean", 1, "mean of the values, 0 of none";
    Norm = "norm", 1, "square root of the sum of squares";
    Least = "least", 1, "the least of the values, 0 of none";
    Most = "most", 1, "the greatest of the values, 0 of none";
    Min = "min", 2, "the smaller of two, value by value";
    Max = "max", 2, "the larger of two, value by value";
    Clamp = "clamp", 3, "the first, no less than the second and no more than the third";
    Where = "where", 3, "the second where the first is not 0, else the third";
}

/// One step of a program; the operands are the topmost values of the stack.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Step {
    Number(f32),
    Load(Signal),
    Pick(Signal, usize),
    /// Keeps value `at` of the topmost `of`.
    Element {
        at: usize,
        of: usize,
    },
    Each {
        act: Act,
        len: usize,
    },
    Negate {
        len: usize,
    },
    Power {
        power: i32,
        len: usize,
    },
    Reduce {
        act: Act,
        len: usize,
    },
    Binary {
        pair: Pair,
        lens: [usize; 2],
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pair {
    Plus,
    Minus,
    Times,
    Over,
    Less,
    LessOrEqual,
    Min,
    Max,
    /// The left value where the right one is not 0, else 0.
    Masked,
    /// The left value where the right one is 0, else 0.
    Unmasked,
}

/// A compiled expression.
#[derive(Clone, Debug, PartialEq)]
pub struct Program {
    steps: Vec<Step>,
    /// How many values it gives.
    len: usize,
    shape: Shape,
    unit: Option<Unit>,
    simulated: Option<Signal>,
}

impl Program {
    /// How many values it gives.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether it gives none (a value per foot of a robot without feet).
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// What its values belong to.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Their unit; `None`: that of plain numbers, whatever is needed.
    pub fn unit(&self) -> Option<Unit> {
        self.unit
    }

    /// A signal in it that only the simulation knows.
    pub fn simulated(&self) -> Option<Signal> {
        self.simulated
    }

    /// Works it out into `stack`; the result is what is on it then. Allocates nothing once `stack` has grown.
    pub fn run<'s>(&self, source: &impl Source, stack: &'s mut Vec<f32>) -> &'s [f32] {
        stack.clear();
        for step in &self.steps {
            step.run(source, stack);
        }
        stack
    }

    /// The value of a program that gives one.
    pub fn scalar(&self, source: &impl Source, stack: &mut Vec<f32>) -> f32 {
        self.run(source, stack).first().copied().unwrap_or_default()
    }
}

impl Step {
    fn run(self, source: &impl Source, stack: &mut Vec<f32>) {
        let top = |stack: &Vec<f32>, len: usize| stack.len().saturating_sub(len);
        match self {
            Self::Number(value) => stack.push(value),
            Self::Load(signal) => stack.extend_from_slice(source.values(signal)),
            Self::Pick(signal, at) => {
                stack.push(source.values(signal).get(at).copied().unwrap_or_default());
            }
            Self::Element { at, of } => {
                let from = top(stack, of);
                let value = stack[from + at];
                stack.truncate(from);
                stack.push(value);
            }
            Self::Each { act, len } => {
                let from = top(stack, len);
                each(act, &mut stack[from..]);
            }
            Self::Negate { len } => {
                let from = top(stack, len);
                stack[from..].iter_mut().for_each(|v| *v = -*v);
            }
            Self::Power { power, len } => {
                let from = top(stack, len);
                stack[from..].iter_mut().for_each(|v| *v = v.powi(power));
            }
            Self::Reduce { act, len } => {
                let from = top(stack, len);
                let value = reduce(act, &stack[from..]);
                stack.truncate(from);
                stack.push(value);
            }
            Self::Binary { pair, lens } => binary(pair, lens, stack),
        }
    }
}

fn each(act: Act, values: &mut [f32]) {
    let with = |values: &mut [f32], of: fn(f32) -> f32| {
        for value in values {
            *value = of(*value);
        }
    };
    match act {
        Act::Abs => with(values, f32::abs),
        Act::Sqrt => with(values, |v| v.max(0.0).sqrt()),
        Act::Exp => with(values, f32::exp),
        Act::Sin => with(values, f32::sin),
        Act::Cos => with(values, f32::cos),
        Act::Tanh => with(values, f32::tanh),
        _ => {}
    }
}

fn reduce(act: Act, values: &[f32]) -> f32 {
    let sum = || values.iter().sum::<f32>();
    let fold = |of: fn(f32, f32) -> f32| values.iter().copied().reduce(of).unwrap_or_default();
    match act {
        Act::Mean => sum() / values.len().max(1) as f32,
        Act::Norm => values.iter().map(|v| v * v).sum::<f32>().sqrt(),
        Act::Least => fold(f32::min),
        Act::Most => fold(f32::max),
        _ => sum(),
    }
}

/// `lens` are equal, or one of them is 1 and that operand counts for every value of the other.
fn binary(pair: Pair, [left, right]: [usize; 2], stack: &mut Vec<f32>) {
    let of: fn(f32, f32) -> f32 = match pair {
        Pair::Plus => |a, b| a + b,
        Pair::Minus => |a, b| a - b,
        Pair::Times => |a, b| a * b,
        Pair::Over => |a, b| a / b,
        Pair::Less => |a, b| f32::from(a < b),
        Pair::LessOrEqual => |a, b| f32::from(a <= b),
        Pair::Min => f32::min,
        Pair::Max => f32::max,
        Pair::Masked => |a, b| if b != 0.0 { a } else { 0.0 },
        Pair::Unmasked => |a, b| if b == 0.0 { a } else { 0.0 },
    };
    let from = stack.len().saturating_sub(left + right);
    let (a, b) = stack[from..].split_at_mut(left);
    if left == right {
        for (a, b) in a.iter_mut().zip(b) {
            *a = of(*a, *b);
        }
        stack.truncate(from + left);
    } else if right == 1 {
        for value in a {
            *value = of(*value, b[0]);
        }
        stack.truncate(from + left);
    } else {
        for value in b {
            *value = of(a[0], *value);
        }
        stack.remove(from);
    }
}

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
        Self {
            names,
            steps: Vec::new(),
            simulated: None,
        }
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
                Ok(Typed {
                    shape: Shape::Scalar,
                    unit: None,
                })
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
                let step = Step::Power {
                    power: i32::from(*power),
                    len,
                };
                self.steps.push(step);
                Ok(Typed {
                    unit: of.unit.map(|unit| unit.power(2 * power)),
                    ..of
                })
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
            format!(
                "names `{name}`, which is no signal; there are: {}",
                known.join(", ")
            )
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
            return Ok(Typed {
                shape: Shape::Scalar,
                ..of
            });
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
        Ok(Typed {
            shape: Shape::Scalar,
            ..typed(signal)
        })
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
            format!(
                "calls `{name}`, which is no function; there are: {}",
                known.join(", ")
            )
        })?;
        let (needs, given) = (function.arguments, arguments.len());
        if needs != given {
            return Err(format!(
                "calls `{name}` with {given} arguments, it takes {needs}"
            ));
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
                let pair = if function.act == Act::Min {
                    Pair::Min
                } else {
                    Pair::Max
                };
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
                Ok(Typed {
                    unit: Some(Unit::ONE),
                    ..of
                })
            }
            Act::Abs | Act::Sqrt => {
                self.steps.push(Step::Each { act, len });
                let halves = if act == Act::Sqrt { 1 } else { 2 };
                Ok(Typed {
                    unit: of.unit.map(|unit| unit.power(halves)),
                    ..of
                })
            }
            _ => {
                self.steps.push(Step::Reduce { act, len });
                Ok(Typed {
                    shape: Shape::Scalar,
                    ..of
                })
            }
        }
    }
}

fn typed(signal: Signal) -> Typed {
    let info = signal.info();
    Typed {
        shape: info.shape,
        unit: Some(info.unit),
    }
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
