//! Logs as arrays.

use std::path::PathBuf;

use caudata_runlog::RunLog;
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::refused;

/// Circumstances, time, columns, notes.
type Columns<'py> = (String, Bound<'py, PyArray1<f64>>, Bound<'py, PyDict>, Vec<String>);

/// A log folder: its circumstances as JSON, time (s), columns by signal (NaN where not sampled), notes of the
/// reader.
#[pyfunction]
pub fn read_log<'py>(py: Python<'py>, folder: PathBuf) -> PyResult<Columns<'py>> {
    let log = py.detach(|| RunLog::read(&folder)).map_err(refused)?;
    let columns = PyDict::new(py);
    for signal in log.table.signals() {
        let cells = log.table.column(signal).unwrap_or_default();
        let values = cells.iter().map(|cell| cell.unwrap_or(f64::NAN));
        columns.set_item(signal.to_string(), PyArray1::from_iter(py, values))?;
    }
    let meta = serde_json::to_string(&log.meta).map_err(refused)?;
    let time_s = PyArray1::from_slice(py, log.table.time_s());
    Ok((meta, time_s, columns, log.table.notes().to_vec()))
}
