//! Collecting one chunk: `T` steps of all lanes under one policy.

use std::time::Instant;

use caudata_env::{EpisodeStats, StepOutput, VecEnv};
use caudata_proto::{EpisodeSummary, FinalObservation, RolloutChunk};

use crate::moments::moments_of;
use crate::policy::LoadedPolicy;
use crate::trace::ChunkTrace;
use crate::{ActorError, ActorMetrics, ActorSettings, gaussian};

/// Collects a chunk, with its times where it is traced; or `None` when asked to stop in the middle of it (its steps are then lost, and
/// were never sent).
pub(crate) fn collect(
    settings: &ActorSettings,
    env: &mut VecEnv,
    policy: &mut LoadedPolicy,
    sequence: u64,
    metrics: &ActorMetrics,
    should_stop: &dyn Fn() -> bool,
) -> Result<Option<(RolloutChunk, Option<ChunkTrace>)>, ActorError> {
    let (lanes, act_dim) = (env.lanes(), env.act_dim());
    let mut trace = ChunkTrace::begin(&settings.traces, policy);
    let mut chunk = empty_chunk(settings, env, policy, sequence);
    let mut means = vec![0.0; lanes * act_dim];
    let mut actions = vec![0.0; lanes * act_dim];
    for step in 0..settings.chunk_steps {
        if should_stop() {
            return Ok(None);
        }
        chunk.observations.extend_from_slice(env.observations());
        let started = Instant::now();
        policy.run(env.observations(), lanes, &mut means)?;
        let took = started.elapsed();
        metrics.inference.observe(took.as_secs_f64());
        if let Some(trace) = &mut trace {
            trace.inferred(took);
        }
        for lane in 0..lanes {
            let row = lane * act_dim..(lane + 1) * act_dim;
            let (mean, action) = (&means[row.clone()], &mut actions[row]);
            gaussian::sample(mean, &policy.std, env.action_stream(lane), action);
            chunk
                .log_probs
                .push(policy.density.log_prob(action, mean));
        }
        chunk.actions.extend_from_slice(&actions);
        chunk.action_means.extend_from_slice(&means);
        let started = Instant::now();
        let output = env.step(&actions)?;
        let took = started.elapsed();
        metrics.env_seconds.inc_by(took.as_secs_f64());
        metrics.steps.inc_by(lanes as u64);
        metrics.episodes.inc_by(output.episodes.len() as u64);
        record(&mut chunk, step, output);
        if let Some(trace) = &mut trace {
            trace.stepped(took);
        }
    }
    let counted = chunk.observations.len();
    chunk.observations.extend_from_slice(env.observations());
    chunk.moments = moments_of(&chunk.observations[..counted], chunk.obs_dim);
    if let Some(trace) = &mut trace {
        trace.ended();
        chunk.trace = Some(trace.collected);
    }
    Ok(Some((chunk, trace)))
}

/// What a step gave.
fn record(chunk: &mut RolloutChunk, step: usize, output: &StepOutput) {
    chunk.rewards.extend_from_slice(&output.rewards);
    chunk.terminated.extend_from_slice(&output.terminated);
    chunk.truncated.extend_from_slice(&output.truncated);
    // The learner bootstraps from a final observation only where the time limit ended the episode.
    let mut finals: Vec<_> = output
        .final_observations
        .iter()
        .filter(|(lane, _)| output.truncated[*lane])
        .map(|(lane, observation)| FinalObservation {
            step,
            lane: *lane,
            observation: observation.clone(),
        })
        .collect();
    finals.sort_by_key(|end| end.lane);
    chunk.final_observations.append(&mut finals);
    chunk.episodes.extend(output.episodes.iter().map(summary));
}

fn summary(episode: &EpisodeStats) -> EpisodeSummary {
    EpisodeSummary {
        lane: episode.lane,
        steps: episode.steps,
        return_sum: episode.return_sum,
        terms: episode.terms.clone(),
        terminated: episode.terminated,
        reason: episode.reason.map_or(0, |reason| reason as u8),
        mean_speed_mps: episode.mean_speed_mps,
    }
}

fn empty_chunk(
    settings: &ActorSettings,
    env: &VecEnv,
    policy: &LoadedPolicy,
    sequence: u64,
) -> RolloutChunk {
    let (steps, lanes) = (settings.chunk_steps, env.lanes());
    let (obs_dim, act_dim) = (env.obs_dim(), env.act_dim());
    let cells = steps * lanes;
    RolloutChunk {
        run_id: settings.run_id.clone(),
        actor_id: settings.actor_id,
        incarnation: settings.incarnation,
        sequence,
        policy_version: policy.version,
        policy_sha256: policy.sha256,
        contract_hash: env.contract().hash(),
        steps,
        lanes,
        obs_dim,
        act_dim,
        observations: Vec::with_capacity((steps + 1) * lanes * obs_dim),
        actions: Vec::with_capacity(cells * act_dim),
        action_means: Vec::with_capacity(cells * act_dim),
        log_std: policy.log_std.clone(),
        log_probs: Vec::with_capacity(cells),
        rewards: Vec::with_capacity(cells),
        terminated: Vec::with_capacity(cells),
        truncated: Vec::with_capacity(cells),
        final_observations: Vec::new(),
        episodes: Vec::new(),
        moments: moments_of(&[], obs_dim),
        trace: None,
    }
}
