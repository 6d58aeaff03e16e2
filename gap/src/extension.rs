//! What a diagnosis adds to a robot file: `[extension]`, with effects by id, evidence, and the ranges that
//! training should draw from.
//!
//! The extended robot file is the nominal one, word for word, with this table at its end. [`terms`] turns it
//! back into the very candidate that was judged, so that the reported score can be had again from the file,
//! to the bit.

use std::collections::BTreeMap;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::LaneParams;
use serde::{Deserialize, Serialize};

use crate::effects::{self, Place};
use crate::error::GapError;
use crate::plant::Plant;
use crate::term::{Term, Variant};

pub use caudata_model::{Extension, ExtensionEffect, ExtensionParameter};

/// What a file with an extension looks like to this reader: the rest is the robot's.
#[derive(Deserialize)]
struct File {
    extension: Option<Extension>,
}

/// Name of the MJCF that a robot file's text names; it lies in the same folder.
///
/// # Errors
/// [`GapError::Extension`] where it names none.
pub fn mjcf_name(robot_toml: &str) -> Result<String, GapError> {
    #[derive(Deserialize)]
    struct Named {
        mjcf: String,
    }
    let named: Named = toml::from_str(robot_toml)
        .map_err(|e| GapError::Extension(e.message().replace('\n', " ")))?;
    Ok(named.mjcf)
}

/// The extension of a robot file's text; `None` where it has none.
///
/// # Errors
/// [`GapError::Extension`] with line and reason.
pub fn read(robot_toml: &str) -> Result<Option<Extension>, GapError> {
    let file: File = toml::from_str(robot_toml).map_err(|e| {
        let line = e
            .span()
            .map_or(1, |s| 1 + robot_toml[..s.start.min(robot_toml.len())].matches('\n').count());
        GapError::Extension(format!("line {line}: {}", e.message().replace('\n', " ")))
    })?;
    Ok(file.extension)
}

/// The candidate that an extension stands for on `model`.
///
/// # Errors
/// [`GapError::Extension`] naming an effect, place or parameter that does not exist.
pub fn terms(extension: &Extension, model: &RobotModel) -> Result<Variant, GapError> {
    extension
        .effect
        .iter()
        .map(|e| {
            let bad = |what: String| GapError::Extension(format!("effect `{}`: {what}", e.id));
            let effect =
                effects::find(&e.id).ok_or_else(|| bad("is not in the catalogue".into()))?;
            let place = Place::named(model, effect.domain, &e.location)
                .ok_or_else(|| bad(format!("the robot has no {}", e.location.join(", "))))?;
            for name in e.parameters.keys() {
                if !effect.parameters.iter().any(|p| p.name == name) {
                    let own: Vec<String> = (effect.parameters.iter())
                        .map(|p| format!("`{}`", p.name))
                        .collect();
                    return Err(bad(format!(
                        "has no parameter `{name}` but {}; a file of an earlier version has to be diagnosed again",
                        own.join(", ")
                    )));
                }
            }
            let neutral = effect.neutral(model, &place);
            let values = (effect.parameters.iter().zip(neutral))
                .map(|(p, neutral)| e.parameters.get(p.name).map_or(neutral, |v| v.value))
                .collect();
            Ok(Term {
                effect,
                place,
                values,
            })
        })
        .collect()
}

/// The lane parameters in which `variant` differs from `model`'s robot, by path.
pub fn lane(model: &Arc<RobotModel>, variant: &[Term]) -> BTreeMap<String, f64> {
    let mut plant = Plant::nominal(model);
    plant.session = 0.5;
    for term in variant {
        (term.effect.apply)(&mut plant, &term.place, &term.values);
    }
    let mut nominal = BTreeMap::new();
    LaneParams::bare(model).visit(model, &mut |path, x| {
        nominal.insert(path.to_owned(), *x);
    });
    let mut out = BTreeMap::new();
    plant.lane.visit(model, &mut |path, x| {
        if nominal.get(path) != Some(x) {
            out.insert(path.to_owned(), f64::from(*x));
        }
    });
    out
}

/// The nominal robot file with `extension` at its end. An extension that it has already is replaced.
///
/// # Errors
/// [`GapError::Extension`] where it cannot be written.
pub fn append(extension: &Extension, robot_toml: &str) -> Result<String, GapError> {
    #[derive(Serialize)]
    struct Table<'a> {
        extension: &'a Extension,
    }
    let table =
        toml::to_string(&Table { extension }).map_err(|e| GapError::Extension(e.to_string()))?;
    let own = robot_toml.find(MARK).unwrap_or(robot_toml.len());
    Ok(format!("{}\n\n{MARK}\n{table}", robot_toml[..own].trim_end()))
}

/// Begins the part that a diagnosis wrote.
const MARK: &str = "# ---- written by a diagnosis: what the nominal robot lacks ----";
