//! What makes a chunk right, apart from how it is written.

use super::error::DecodeError;
use super::messages::{DecodeLimits, EpisodeSummary, Moments, RolloutChunk};

/// Longest run id, in bytes.
pub(super) const MAX_RUN_ID: usize = 128;
/// Longest line for the log, in bytes.
pub(super) const MAX_LINE: usize = 256;

impl RolloutChunk {
    /// Checks everything that [`super::decode`] checks of a chunk's values.
    ///
    /// # Errors
    /// The first thing that is not right.
    pub fn check(&self, limits: &DecodeLimits) -> Result<(), DecodeError> {
        dimensions([self.steps, self.lanes, self.obs_dim, self.act_dim], limits)?;
        self.check_lengths(self.observations_len())?;
        self.check_values(limits)
    }

    /// Memory of the tensors, bytes: near what they take on the wire.
    pub fn memory_bytes(&self) -> usize {
        let floats =
            [&self.observations, &self.actions, &self.action_means, &self.log_probs, &self.rewards];
        let flags = self.terminated.len() + self.truncated.len();
        4 * floats.iter().map(|tensor| tensor.len()).sum::<usize>() + flags
    }

    /// Numbers in the observations of a chunk of these dimensions, (T+1)·N·D.
    pub(super) fn observations_len(&self) -> usize {
        product(&[self.steps.saturating_add(1), self.lanes, self.obs_dim])
    }

    /// Every tensor is as long as the dimensions call for; `observations` numbers of observations, which may
    /// be less than all where some were left out.
    pub(super) fn check_lengths(&self, observations: usize) -> Result<(), DecodeError> {
        let cells = product(&[self.steps, self.lanes]);
        let actions = product(&[cells, self.act_dim]);
        let lengths = [
            ("observations", self.observations.len(), observations),
            ("actions", self.actions.len(), actions),
            ("action_means", self.action_means.len(), actions),
            ("log_std", self.log_std.len(), self.act_dim),
            ("log_probs", self.log_probs.len(), cells),
            ("rewards", self.rewards.len(), cells),
            ("terminated", self.terminated.len(), cells),
            ("truncated", self.truncated.len(), cells),
        ];
        lengths.into_iter().try_for_each(|(field, found, expected)| length(field, found, expected))
    }

    /// What is in a chunk whose dimensions and lengths are right.
    pub(super) fn check_values(&self, limits: &DecodeLimits) -> Result<(), DecodeError> {
        run_id(&self.run_id)?;
        let max = limits.max_magnitude;
        let tensors: [(_, &[f32]); 6] = [
            ("observations", &self.observations),
            ("actions", &self.actions),
            ("action_means", &self.action_means),
            ("log_std", &self.log_std),
            ("log_probs", &self.log_probs),
            ("rewards", &self.rewards),
        ];
        for (field, values) in tensors {
            magnitudes(field, values, max)?;
        }
        let cells = product(&[self.steps, self.lanes]);
        self.check_ends(max)?;
        check_episodes(&self.episodes, self.lanes, cells, limits)?;
        check_moments(&self.moments, self.obs_dim, cells, max)
    }

    /// Flags never overlap, and each truncated step has its final observation, in order.
    fn check_ends(&self, max: f32) -> Result<(), DecodeError> {
        if let Some(cell) =
            (0..self.terminated.len()).find(|&c| self.terminated[c] && self.truncated[c])
        {
            return Err(DecodeError::FlagsOverlap {
                step: cell / self.lanes,
                lane: cell % self.lanes,
            });
        }
        let mut finals = self.final_observations.iter().enumerate();
        for cell in (0..self.truncated.len()).filter(|&c| self.truncated[c]) {
            let expected = (cell / self.lanes, cell % self.lanes);
            match finals.next() {
                Some((_, f)) if (f.step, f.lane) == expected => {
                    length("final_observations", f.observation.len(), self.obs_dim)?;
                    magnitudes("final_observations", &f.observation, max)?;
                }
                other => {
                    return Err(DecodeError::FinalObservations {
                        index: other.map_or(self.final_observations.len(), |(i, _)| i),
                        expected: Some(expected),
                    });
                }
            }
        }
        match finals.next() {
            None => Ok(()),
            Some((index, _)) => Err(DecodeError::FinalObservations { index, expected: None }),
        }
    }
}

fn check_episodes(
    episodes: &[EpisodeSummary],
    lanes: usize,
    cells: usize,
    limits: &DecodeLimits,
) -> Result<(), DecodeError> {
    let fail = |index, problem| Err(DecodeError::Episode { index, problem });
    if episodes.len() > cells {
        return fail(cells, "more episodes than steps of all lanes");
    }
    let terms = episodes.first().map_or(0, |e| e.terms.len());
    if terms > limits.max_terms {
        return fail(0, "too many reward terms");
    }
    for (index, episode) in episodes.iter().enumerate() {
        if episode.lane as usize >= lanes {
            return fail(index, "lane out of range");
        }
        if episode.steps == 0 {
            return fail(index, "no steps");
        }
        if episode.terms.len() != terms {
            return fail(index, "another number of reward terms than the first");
        }
        if !(episode.return_sum.is_finite() && episode.mean_speed_mps.is_finite()) {
            return fail(index, "return or mean speed is not finite");
        }
        if !episode.terms.iter().all(|x| x.is_finite()) {
            return fail(index, "a reward term is not finite");
        }
    }
    Ok(())
}

fn check_moments(m: &Moments, obs_dim: usize, cells: usize, max: f32) -> Result<(), DecodeError> {
    length("moments.mean", m.mean.len(), obs_dim)?;
    length("moments.m2", m.m2.len(), obs_dim)?;
    let fail = |problem| Err(DecodeError::Moments { problem });
    if m.count != cells as u64 {
        return fail("the count is not steps times lanes");
    }
    if !m.mean.iter().all(|x| x.abs() <= f64::from(max)) {
        return fail("a mean is not finite or out of bounds");
    }
    // With |x| <= max, a squared deviation is at most (2 max)^2.
    let m2_max = cells as f64 * 4.0 * f64::from(max) * f64::from(max);
    if !m.m2.iter().all(|x| (0.0..=m2_max).contains(x)) {
        return fail("a sum of squares is negative, not finite or out of bounds");
    }
    Ok(())
}

/// A run id: 1 to [`MAX_RUN_ID`] printable ASCII characters, no space.
pub(super) fn run_id(text: &str) -> Result<(), DecodeError> {
    let good = (1..=MAX_RUN_ID).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_graphic());
    if good {
        return Ok(());
    }
    Err(DecodeError::Text { field: "run_id", min: 1, max: MAX_RUN_ID })
}

/// A line for the log: at most [`MAX_LINE`] bytes, no control characters (they could forge lines).
pub(super) fn line(field: &'static str, text: &str) -> Result<(), DecodeError> {
    if text.len() <= MAX_LINE && !text.chars().any(char::is_control) {
        return Ok(());
    }
    Err(DecodeError::Text { field, min: 0, max: MAX_LINE })
}

/// T, N, D and A of a chunk. Before anything is made as large as they say.
pub(super) fn dimensions(
    [steps, lanes, obs_dim, act_dim]: [usize; 4],
    limits: &DecodeLimits,
) -> Result<(), DecodeError> {
    dimension("steps", steps, limits.max_steps)?;
    dimension("lanes", lanes, limits.max_lanes)?;
    dimension("obs_dim", obs_dim, limits.max_obs_dim)?;
    dimension("act_dim", act_dim, limits.max_act_dim)
}

pub(super) fn dimension(
    field: &'static str,
    found: usize,
    limit: usize,
) -> Result<(), DecodeError> {
    if (1..=limit).contains(&found) {
        return Ok(());
    }
    Err(DecodeError::Dimension { field, found, limit })
}

pub(super) fn length(
    field: &'static str,
    found: usize,
    expected: usize,
) -> Result<(), DecodeError> {
    if found == expected {
        return Ok(());
    }
    Err(DecodeError::Length { field, found, expected })
}

/// Product that never wraps: a wrapped one could match a short tensor.
pub(super) fn product(factors: &[usize]) -> usize {
    factors.iter().fold(1, |a, &b| a.saturating_mul(b))
}

/// Every number is finite and at most `limit` in magnitude.
fn magnitudes(field: &'static str, values: &[f32], limit: f32) -> Result<(), DecodeError> {
    // Branch-free over the whole tensor; NaN fails the comparison. The index is found afterwards.
    if values.iter().fold(true, |good, x| good & (x.abs() <= limit)) {
        return Ok(());
    }
    let index = values
        .iter()
        .position(|x| !x.is_finite())
        .or_else(|| values.iter().position(|x| x.abs() > limit))
        .unwrap_or(0);
    let value = values[index];
    if value.is_finite() {
        Err(DecodeError::Magnitude { field, index, value: value.into(), limit })
    } else {
        Err(DecodeError::NotFinite { field, index })
    }
}
