//! The benchmark of diagnosis: logs with an effect hidden in them by other numerics than the diagnosing
//! simulator's, answers sealed away from it, and scores.
//!
//! [`truth`] is an independent simulator; [`hidden`] what it can hide; [`generate`] makes a case (a folder of
//! logs and a nominal robot file) and its answer ([`mod@case`]), which [`seal`] keeps from the process that
//! diagnoses.

pub mod baselines;
pub mod battery;
pub mod calibrate;
pub mod case;
pub mod decoy;
pub mod examinee;
pub mod file;
pub mod generate;
pub mod hidden;
pub mod hides;
pub mod lab;
pub mod on_request;
pub mod paper;
pub mod replay;
pub mod run;
pub mod salamander;
pub mod score;
pub mod scripts;
pub mod seal;
pub mod sets;
pub mod simulated;
pub mod sizing;
pub mod truth;
