//! The neutral log format for measured and simulated runs.
//!
//! A log is a folder with `log.csv` and `log.toml`. The CSV's header names carry the signal ([`Signal`]); SI
//! units; an empty cell was not sampled then; time `t` (s) is the first column and strictly increasing.
//! `log.toml` ([`LogMeta`]) says which robot, how it was held, where, how fast it was sampled, and every
//! setting that was known.
//!
//! [`LogWriter`] appends whole rows and survives being killed: what was flushed is a valid log, and a torn
//! last line is dropped by the reader with a note. [`RunLog`] reads and checks everything; what it returns is
//! valid. [`Table`] and [`TableWriter`] are the CSV alone, for command files and simulated runs.
//!
//! Instead of `log.csv` a folder may hold one MCAP file of the ROS 2 profile ([`ros`]). [`parquet`] is a table of
//! numbers in the form of that name.
//!
//! Invariant: no clock is read here; time is what the caller says.

mod error;
mod log;
mod meta;
pub mod parquet;
mod python;
pub mod ros;
mod signal;
mod table;
mod writer;

pub use error::LogError;
pub use log::{CSV_NAME, META_NAME, ROWS, RunLog, meta_file, names_a_robot, read_rows, rows_file};
pub use meta::{BaseHold, ForcePoint, JointConditions, LogMeta, Payload, Setting};
pub use signal::{Axis, QuatPart, Signal, SignalError};
pub use table::Table;
pub use writer::{LogWriter, TableWriter};
