//! What may be wrong: places in the configuration or the robot file, how suspect each is, and what puts it right.

use crate::behaviour::{Behaviour, Sign};

/// A place that may be wrong.
#[derive(Clone, Debug, PartialEq)]
pub struct Suspect {
    /// The kind of mistake.
    pub id: &'static str,
    /// Where: keys of the configuration, a term's name in it, or `robot.<joint>`.
    pub keys: Vec<String>,
    /// What is wrong then, in a sentence.
    pub says: String,
    /// What puts it right.
    pub edit: Edit,
    /// 1 and more: worth a training of its own; less: put right only together with others.
    pub suspicion: f64,
}

/// What puts a suspect right.
#[derive(Clone, Debug, PartialEq)]
pub enum Edit {
    /// Assignments to keys of the configuration.
    Set(Vec<String>),
    /// Without this one of the task file's own reward terms or conditions; `weight`: with that weight instead.
    Term {
        /// `task.reward.term` or `task.termination.when`.
        table: &'static str,
        /// Its name.
        name: String,
        /// The weight of a reward term that stays.
        weight: Option<f32>,
    },
    /// A term of the observation as it should be; `None`: without noise of its own.
    Observe {
        /// Its name.
        name: String,
        /// What it should be.
        value: Seen,
    },
    /// This joint of the MJCF turns about this axis.
    Axis {
        /// Its name.
        joint: String,
        /// In the frame of the link that it carries.
        axis: [f64; 3],
    },
    /// The nominal position of this joint, rad.
    Nominal {
        /// Its name.
        joint: String,
        /// rad.
        rad: f64,
    },
    /// Several at once.
    All(Vec<Edit>),
}

/// How a term of the observation is put right.
#[derive(Clone, Debug, PartialEq)]
pub enum Seen {
    /// The built-in term of its name.
    BuiltIn,
    /// Without noise of its own.
    Quiet,
}

/// Factor on the suspicion of what leads to what the robot does, and of what leads to something else.
const FITS: (f64, f64) = (1.25, 0.8);

impl Suspect {
    /// As suspect as `suspicion`, more where it leads to what the robot does.
    pub(crate) fn seen_in(mut self, leads: &[Sign], behaviour: &Behaviour) -> Self {
        let fits = leads.iter().any(|sign| behaviour.signs.contains(sign));
        self.suspicion *= if fits { FITS.0 } else { FITS.1 };
        self
    }
}
