//! `[extension]` of a robot file: what a diagnosis found that the nominal robot lacks.
//!
//! The effects are for people and for diagnosis; `lane` is what they come to in the simulator's parameters,
//! and what training and evaluation use.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// The table `[extension]`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extension {
    /// SHA-256 over the robot file that was extended, and its MJCF, hexadecimal.
    pub base: String,
    /// SHA-256 of the logs that it rests on.
    #[serde(default)]
    pub logs: Vec<String>,
    /// Standard deviation of observation noise by kind of signal, SI: what repeats showed. For training.
    #[serde(default)]
    pub observation_noise: BTreeMap<String, f64>,
    /// The simulator's parameters that differ from the nominal robot's, by path (`kp_nm_per_rad.FL_hip`,
    /// `joints.FL_hip.dead_band_rad`). Engines refuse paths that they do not know.
    #[serde(default)]
    pub lane: BTreeMap<String, f64>,
    /// Effects, in the order in which they act.
    #[serde(default)]
    pub effect: Vec<ExtensionEffect>,
}

/// One effect.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExtensionEffect {
    /// Id of the catalogue.
    pub id: String,
    /// Joints, links, …; empty: the whole robot.
    #[serde(rename = "where")]
    pub location: Vec<String>,
    /// Calibrated probability of the name, 0 to 1.
    pub confidence: f64,
    /// Ids of others that explain it as well.
    #[serde(default)]
    pub alternatives: Vec<String>,
    /// Other places at which it explains it as well.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub elsewhere: Vec<Vec<String>>,
    /// What speaks for it.
    #[serde(default)]
    pub evidence: Vec<String>,
    /// By name.
    pub parameters: BTreeMap<String, ExtensionParameter>,
    /// By name: the range that training should draw from, lowest and highest, SI.
    #[serde(default)]
    pub randomise: BTreeMap<String, [f64; 2]>,
}

/// A fitted parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExtensionParameter {
    /// In `unit`.
    pub value: f64,
    /// SI.
    pub unit: String,
    /// Lower end of the 95 % interval.
    pub ci_low: f64,
    /// Upper end of the 95 % interval.
    pub ci_high: f64,
    /// Whether the value lies on its bound.
    pub at_bound: bool,
}
