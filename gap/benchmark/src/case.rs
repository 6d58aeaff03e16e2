//! One case of the benchmark: the folder that the diagnosis sees, and the answer that it does not.

use serde::{Deserialize, Serialize};

/// Which block of the protocol a case belongs to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Block {
    /// Nuisances only.
    #[default]
    Null,
    /// One effect.
    Single,
    /// Two effects.
    Pair,
    /// Something unusual that is no physics of the robot.
    Decoy,
    /// A law that is not in the catalogue.
    Outside,
    /// One effect, data that excite too little.
    Starved,
    /// The salamander on the ground, by another engine.
    Ground,
    /// The same in water.
    Water,
    /// The robot changes between fit and hold-out.
    HoldoutChange,
}

/// One true effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrueEffect {
    /// Id of the catalogue, or the name of a law outside it.
    pub effect: String,
    /// Layer.
    pub layer: String,
    /// Joint; empty: the robot.
    pub joint: String,
    /// Size in the generator's own measure.
    pub size: f64,
    /// Size in detectability units: whitened norm of the effect over that of the null discrepancy, on the fit
    /// runs.
    pub d: f64,
    /// Ids that fit these data exactly as well.
    pub equivalent: Vec<String>,
    /// Ids that do beside another one that must be named as well.
    #[serde(default)]
    pub equivalent_beside: Vec<(String, String)>,
    /// True parameters.
    pub parameters: Vec<TrueValue>,
}

/// One true parameter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrueValue {
    /// Words that its name may have.
    pub names: Vec<String>,
    /// Unit.
    pub unit: String,
    /// True value.
    pub value: f64,
    /// Without the effect.
    pub nominal: f64,
}

/// The answer of a case.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// Folder name.
    pub case: String,
    /// Block.
    pub block: Block,
    /// Rig.
    pub rig: String,
    /// Seed of its nuisances.
    pub seed: u64,
    /// Target size asked for, d; 0 where there is none.
    pub target_d: f64,
    /// Size of all true effects together, d: two that make up for each other are less than either; 0 where it
    /// was not measured.
    #[serde(default)]
    pub together_d: f64,
    /// True effects, none for nulls and decoys.
    pub effects: Vec<TrueEffect>,
    /// Ids that the diagnosis has to do without (leave one out).
    #[serde(default)]
    pub without: Vec<String>,
    /// What a decoy is: `kp_declared`, `sign`, …
    pub decoy: String,
    /// Whether the right answer of a decoy is `data_fault` (otherwise that nothing physical is named).
    pub fault: bool,
    /// Kinds of fault that are right.
    pub fault_kinds: Vec<String>,
}

/// All answers of a set.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Answers {
    /// In order of the folders' names.
    pub answers: Vec<Answer>,
}
