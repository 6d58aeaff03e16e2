//! Replay: a flat list of (candidate robot, stretch of a run) goes through the lanes of the batch engine;
//! what the robot's sensors would have said comes out at the very stamps of the log.
//!
//! Each lane has its own parameters, commands and start. Command delays act on the command stream in
//! continuous time, so that they are exact to the fraction of a step. Lanes never influence each other,
//! chunks of lanes go to threads by number: same jobs, same bits, whatever the number of threads.

mod commands;
mod cuts;
mod data;
mod fed;
mod lanes;
mod observe;
mod replayer;
mod starts;
mod trace;

pub use crate::term::{Term, Variant};
pub use cuts::SegmentOptions;
pub use data::{Data, Piece, Segment};
pub use replayer::{LANES, Replayer};
pub use starts::Start;
