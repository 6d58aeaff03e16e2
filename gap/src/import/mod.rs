//! Recordings of other projects, turned into log folders.
//!
//! A form of recording is one module that reads it into sheets of named columns over time ([`sheet`]): CSV files,
//! bags of ROS 2, datasets of LeRobot, arrays of NumPy. A map says which column is which signal ([`map`]), and can
//! be guessed ([`draft`]). What a form leaves to the servo (a gain as a register value, [`bam`]) is worked out with
//! the robot file, so that a rig is an ordinary robot. From there on nothing knows where a log came from.

pub mod bag;
pub mod bam;
mod clock;
pub mod csv;
pub mod draft;
pub mod lerobot;
pub mod map;
pub mod npz;
mod open;
mod order;
mod run;
pub mod sheet;
mod trajectory;
mod units;
mod words;

pub use open::{Format, open, read};
pub use run::{ImportError, Imported, MAX_FILE_BYTES};
