//! What an update asks of the networks, wherever they are computed.

use std::fmt::Debug;
use std::sync::Arc;

use super::minibatch::{Before, Minibatch, Samples, Step, Total};
use crate::LearnerError;
use crate::adam::Adam;
use crate::batch::Batch;
use crate::normaliser::Scaling;

/// Networks, their gradient and the optimiser, where they are computed. An update takes its state there, works on it,
/// and fetches it when all has gone well.
pub trait Networks: Debug + Send {
    /// Goes on from `parameters` `[P]` and the optimiser's state.
    fn take_up(&mut self, parameters: &[f32], adam: &Adam);

    /// Takes up a batch, seen through `scaling`, and says what the networks make of it: `means` of the actions
    /// only if asked for.
    ///
    /// # Errors
    /// When a thread has died, or the device does not answer.
    fn begin(
        &mut self,
        batch: &Arc<Batch>,
        scaling: &Scaling,
        means: bool,
    ) -> Result<Before, LearnerError>;

    /// Computes the gradient of a minibatch of the batch, and keeps it for [`Networks::step`].
    ///
    /// # Errors
    /// As [`Networks::begin`].
    fn gradient(
        &mut self,
        samples: &Arc<Samples>,
        minibatch: &Minibatch,
    ) -> Result<Total, LearnerError>;

    /// A step along the last gradient.
    fn step(&mut self, step: &Step);

    /// The last gradient, `[P]`.
    #[cfg(test)]
    fn last_gradient(&self) -> Result<Vec<f32>, LearnerError>;

    /// Parameters `[P]` and the optimiser as the steps have made them.
    ///
    /// # Errors
    /// As [`Networks::begin`].
    fn state(&self) -> Result<(Vec<f32>, Adam), LearnerError>;
}
