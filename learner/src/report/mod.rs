//! What people look at while and after training: TensorBoard files and pictures of the curves.

mod curves;
mod history;
mod returns;
mod tensorboard;

pub use curves::{TERM_PREFIX, draw_curves};
pub use history::{History, Point};
pub use returns::{ReturnSums, share_of_whole};
pub use tensorboard::EventFile;
