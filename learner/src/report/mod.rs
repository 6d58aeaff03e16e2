//! What people look at while and after training: the history of its figures and pictures of them.

mod curves;
mod history;
mod returns;

pub use curves::{TERM_PREFIX, draw_curves};
pub use history::{History, Point};
pub use returns::{ReturnSums, share_of_whole};
