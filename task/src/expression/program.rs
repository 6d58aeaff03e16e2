//! The compiled form: steps over a stack of values.

use super::signal::{Shape, Signal};
use super::unit::Unit;

/// Most values on the stack: a few vectors of joints.
pub(super) const STACK_MAX: usize = 512;

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
    pub(super) act: Act,
}

/// What a function does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Act {
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
pub(super) enum Step {
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
pub(super) enum Pair {
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
    pub(super) steps: Vec<Step>,
    /// How many values it gives.
    pub(super) len: usize,
    pub(super) shape: Shape,
    pub(super) unit: Option<Unit>,
    pub(super) simulated: Option<Signal>,
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
