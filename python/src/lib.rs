//! `caudata._caudata`, the compiled half of the Python package: environments and logs as NumPy arrays. The
//! other half, `python/caudata`, gives them the forms that Python's libraries expect.
//!
//! *Invariant:* links neither libtorch nor a network library, and loads no ONNX Runtime; arrays are filled in
//! place, in the memory that Python sees.

mod environments;
mod log;
mod policy;
mod signals;

use std::error::Error;

use caudata_config::PRESETS;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// An error of ours as a `ValueError` of one line.
fn refused(error: impl Error) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Names of the presets.
#[pyfunction]
fn preset_names() -> Vec<&'static str> {
    PRESETS.iter().map(|preset| preset.name).collect()
}

#[pymodule]
mod _caudata {
    #[pymodule_export]
    use super::environments::Environments;
    #[pymodule_export]
    use super::log::read_log;
    #[pymodule_export]
    use super::preset_names;
}
