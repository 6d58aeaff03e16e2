//! Past actions inside observations: left out of frames, and put back.
//!
//! A policy that sees its last S actions has them in every observation, and the frame has them once more as
//! actions: half of an observation of 97 values. What is left out follows bit for bit from what is sent, or
//! nothing is left out.

use super::check::product;
use super::error::DecodeError;
use super::messages::{ActionHistory, RolloutChunk};

impl ActionHistory {
    /// Values of an observation that are past actions.
    fn len(&self, act_dim: usize) -> usize {
        self.steps.saturating_mul(act_dim)
    }

    /// What is wrong with it for these dimensions.
    pub(super) fn problem(&self, obs_dim: usize, act_dim: usize) -> Option<&'static str> {
        let len = self.len(act_dim);
        if len == 0 {
            return Some("no past actions");
        }
        // So that a frame cannot ask for more than twice what it has.
        if len > obs_dim / 2 {
            return Some("more than half of an observation");
        }
        if self.first > obs_dim - len {
            return Some("beyond the end of the observation");
        }
        let positive = self.clip.is_finite() && self.clip > 0.0;
        (!positive).then_some("the limit of actions is not a positive number")
    }

    /// Numbers of observations that [`leave_out`] sends of a chunk of these dimensions.
    ///
    /// # Errors
    /// Where the history does not fit the dimensions.
    pub(super) fn sent_len(&self, chunk: &RolloutChunk) -> Result<usize, DecodeError> {
        if let Some(problem) = self.problem(chunk.obs_dim, chunk.act_dim) {
            return Err(DecodeError::ActionHistory { problem });
        }
        let narrow = chunk.obs_dim - self.len(chunk.act_dim);
        let others = product(&[chunk.steps, chunk.lanes, narrow]);
        Ok(others.saturating_add(product(&[chunk.lanes, chunk.obs_dim])))
    }

    /// Past actions after one more step: `before` moved back by one, `action` in front; zeros where an
    /// episode ended. `[S·A]`
    fn after(&self, before: &[f32], action: &[f32], ended: bool, out: &mut [f32]) {
        if ended {
            out.fill(0.0);
            return;
        }
        let (newest, older) = out.split_at_mut(action.len());
        for (out, action) in newest.iter_mut().zip(action) {
            *out = action.max(-self.clip).min(self.clip);
        }
        older.copy_from_slice(&before[..older.len()]);
    }
}

/// The observations of `chunk` without past actions: the first row of each lane whole (D values), all others
/// without them (D − S·A). `None` where the chunk names no history, or where any of it does not follow from
/// the actions.
pub(super) fn leave_out(chunk: &RolloutChunk) -> Option<Vec<f32>> {
    let history = chunk.action_history?;
    let (lanes, obs_dim, act_dim) = (chunk.lanes, chunk.obs_dim, chunk.act_dim);
    let cells = product(&[chunk.steps, lanes]);
    let right = history.problem(obs_dim, act_dim).is_none()
        && lanes > 0
        && chunk.observations.len() == product(&[cells.saturating_add(lanes), obs_dim])
        && chunk.actions.len() == product(&[cells, act_dim])
        && chunk.terminated.len() == cells
        && chunk.truncated.len() == cells;
    if !right {
        return None;
    }
    let place = history.first..history.first + history.len(act_dim);
    let row = |i: usize| &chunk.observations[i * obs_dim..][..obs_dim];
    let mut expected = vec![0.0; place.len()];
    let mut sent = Vec::with_capacity(chunk.observations.len() - cells * place.len());
    sent.extend_from_slice(&chunk.observations[..lanes * obs_dim]);
    for cell in 0..cells {
        let action = &chunk.actions[cell * act_dim..][..act_dim];
        let ended = chunk.terminated[cell] || chunk.truncated[cell];
        history.after(&row(cell)[place.clone()], action, ended, &mut expected);
        let next = row(cell + lanes);
        let same = next[place.clone()]
            .iter()
            .zip(&expected)
            .fold(true, |same, (a, b)| same & (a.to_bits() == b.to_bits()));
        if !same {
            return None;
        }
        sent.extend_from_slice(&next[..place.start]);
        sent.extend_from_slice(&next[place.end..]);
    }
    Some(sent)
}

/// The observations of `chunk`, which has what [`leave_out`] sent of them, [`ActionHistory::sent_len`]
/// numbers, and all else that its dimensions call for. `[T+1, N, D]`
pub(super) fn put_back(history: &ActionHistory, chunk: &RolloutChunk) -> Vec<f32> {
    let (obs_dim, act_dim) = (chunk.obs_dim, chunk.act_dim);
    let place = history.first..history.first + history.len(act_dim);
    let (first, others) = chunk.observations.split_at(chunk.lanes * obs_dim);
    let mut out = Vec::with_capacity(chunk.observations_len());
    out.extend_from_slice(first);
    let mut past = vec![0.0; place.len()];
    for (cell, row) in others.chunks_exact(obs_dim - place.len()).enumerate() {
        let action = &chunk.actions[cell * act_dim..][..act_dim];
        let ended = chunk.terminated[cell] || chunk.truncated[cell];
        let before = &out[cell * obs_dim..][place.clone()];
        history.after(before, action, ended, &mut past);
        let (left, right) = row.split_at(place.start);
        out.extend_from_slice(left);
        out.extend_from_slice(&past);
        out.extend_from_slice(right);
    }
    out
}
