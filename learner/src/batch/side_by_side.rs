//! Lockstep: the chunks that actors collected at the same time become one chunk with all lanes, so that a
//! batch does not show how many actors stepped them.

use std::collections::BTreeMap;

use caudata_proto::{FinalObservation, RolloutChunk};

use crate::normaliser::Moments;

/// The first chunks of all actors side by side, then the second ones, and so on; `chunks` are in the order of
/// each actor's work.
///
/// Lanes follow one another by actor. The statistics of the observations are counted anew over all lanes:
/// sums over parts, added up, would differ in the last bits from actor count to actor count.
pub fn side_by_side(chunks: Vec<RolloutChunk>) -> Vec<RolloutChunk> {
    let mut rounds: Vec<BTreeMap<u32, RolloutChunk>> = Vec::new();
    let mut seen: BTreeMap<u32, usize> = BTreeMap::new();
    for chunk in chunks {
        let round = seen.entry(chunk.actor_id).or_default();
        if rounds.len() <= *round {
            rounds.push(BTreeMap::new());
        }
        if let Some(round) = rounds.get_mut(*round) {
            round.insert(chunk.actor_id, chunk);
        }
        *round += 1;
    }
    rounds.into_iter().filter_map(|round| joined(round.into_values().collect())).collect()
}

/// One chunk with the lanes of all. `None` for none at all.
fn joined(parts: Vec<RolloutChunk>) -> Option<RolloutChunk> {
    let first = parts.first()?;
    let (steps, obs_dim, act_dim) = (first.steps, first.obs_dim, first.act_dim);
    let lanes: usize = parts.iter().map(|part| part.lanes).sum();
    let mut whole = RolloutChunk {
        lanes,
        observations: Vec::with_capacity((steps + 1) * lanes * obs_dim),
        actions: Vec::with_capacity(steps * lanes * act_dim),
        action_means: Vec::with_capacity(steps * lanes * act_dim),
        log_probs: Vec::with_capacity(steps * lanes),
        rewards: Vec::with_capacity(steps * lanes),
        terminated: Vec::with_capacity(steps * lanes),
        truncated: Vec::with_capacity(steps * lanes),
        final_observations: Vec::new(),
        episodes: Vec::new(),
        ..first.clone()
    };
    for step in 0..=steps {
        for part in &parts {
            let row = |width: usize| step * part.lanes * width..(step + 1) * part.lanes * width;
            whole.observations.extend_from_slice(&part.observations[row(obs_dim)]);
            if step == steps {
                continue;
            }
            whole.actions.extend_from_slice(&part.actions[row(act_dim)]);
            whole.action_means.extend_from_slice(&part.action_means[row(act_dim)]);
            whole.log_probs.extend_from_slice(&part.log_probs[row(1)]);
            whole.rewards.extend_from_slice(&part.rewards[row(1)]);
            whole.terminated.extend_from_slice(&part.terminated[row(1)]);
            whole.truncated.extend_from_slice(&part.truncated[row(1)]);
        }
    }
    let mut before = 0;
    for part in parts {
        let shifted = |end: FinalObservation| FinalObservation { lane: end.lane + before, ..end };
        let finals = part.final_observations.into_iter().map(shifted);
        whole.final_observations.extend(finals);
        let offset = u32::try_from(before).unwrap_or(u32::MAX);
        let episodes = part.episodes.into_iter().map(|mut episode| {
            episode.lane = episode.lane.saturating_add(offset);
            episode
        });
        whole.episodes.extend(episodes);
        before += part.lanes;
    }
    whole.final_observations.sort_by_key(|end| (end.step, end.lane));
    let moments = Moments::of(&whole.observations[..steps * lanes * obs_dim], obs_dim);
    whole.moments =
        caudata_proto::Moments { count: moments.count, mean: moments.mean, m2: moments.m2 };
    Some(whole)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::batch::Batch;

    const STEPS: usize = 2;

    /// What actor `actor` with `lanes` lanes from `first` on sends: every value tells step and lane. D = 1, A
    /// = 1.
    fn chunk(actor: u32, sequence: u64, first: usize, lanes: usize) -> RolloutChunk {
        let value = |step: usize, lane: usize| {
            (1000 * sequence as usize + 10 * (first + lane) + step) as f32
        };
        let rows = |steps: usize| -> Vec<f32> {
            (0..steps).flat_map(|step| (0..lanes).map(move |lane| value(step, lane))).collect()
        };
        // The last lane of all is cut off in its first step.
        let cut = |step: usize, lane: usize| step == 0 && first + lane == 3;
        let truncated: Vec<bool> =
            (0..STEPS).flat_map(|step| (0..lanes).map(move |lane| cut(step, lane))).collect();
        let finals = truncated.iter().position(|&t| t).map(|at| FinalObservation {
            step: at / lanes,
            lane: at % lanes,
            observation: vec![-1.0],
        });
        RolloutChunk {
            run_id: "run".into(),
            actor_id: actor,
            incarnation: 0,
            sequence,
            policy_version: 0,
            policy_sha256: [0; 32],
            contract_hash: [0; 32],
            steps: STEPS,
            lanes,
            obs_dim: 1,
            act_dim: 1,
            observations: rows(STEPS + 1),
            actions: rows(STEPS),
            action_means: rows(STEPS),
            log_std: vec![0.0],
            log_probs: rows(STEPS),
            rewards: rows(STEPS),
            terminated: vec![false; STEPS * lanes],
            truncated,
            final_observations: finals.into_iter().collect(),
            episodes: Vec::new(),
            moments: caudata_proto::Moments { count: 0, mean: vec![0.0], m2: vec![0.0] },
            action_history: None,
            trace: None,
        }
    }

    /// Two rounds of four lanes, stepped by `actors`, in the order in which a collector hands them out.
    fn batch(actors: usize) -> Batch {
        let lanes = 4 / actors;
        let mut chunks = Vec::new();
        for actor in 0..actors {
            for sequence in 0..2 {
                chunks.push(chunk(actor as u32, sequence, actor * lanes, lanes));
            }
        }
        Batch::new(side_by_side(chunks))
    }

    #[test]
    fn a_batch_does_not_show_how_many_actors_stepped_it() {
        let one = batch(1);
        assert_eq!(one.rows, 2 * STEPS * 4);
        // First step of all lanes, then the second one.
        assert_eq!(one.rewards[..8], [0., 10., 20., 30., 1., 11., 21., 31.]);
        assert_eq!(one.segments[0].finals, 1);
        assert_eq!(one, batch(2));
        assert_eq!(one, batch(4));
    }
}
