//! Collecting one chunk: `T` steps of all lanes under one policy.

use caudata_env::{EpisodeStats, StepOutput, VecEnv};
use caudata_proto::{ActionHistory, EpisodeSummary, FinalObservation, RolloutChunk};
use caudata_task::ACTION_HISTORY;
use caudata_task::layout::Part as Observed;
use caudata_telemetry::spans::{Laps, Part};

use crate::moments::moments_of;
use crate::policy::LoadedPolicy;
use crate::trace::ChunkTrace;
use crate::{ActorError, ActorMetrics, ActorSettings, gaussian};

/// Collects a chunk, with its times where it is traced; or `None` when asked to stop in the middle of it (its
/// steps are then lost, and were never sent). `spare` is a chunk that was sent: its memory is used again, since
/// fresh memory would be given back to the system and asked for again each time.
pub(crate) fn collect(
    settings: &ActorSettings,
    env: &mut VecEnv,
    policy: &mut LoadedPolicy,
    sequence: u64,
    spare: &mut RolloutChunk,
    metrics: &ActorMetrics,
    should_stop: &dyn Fn() -> bool,
) -> Result<Option<(RolloutChunk, Option<ChunkTrace>)>, ActorError> {
    let (lanes, act_dim) = (env.lanes(), env.act_dim());
    let mut trace = ChunkTrace::begin(&settings.traces, policy);
    let mut chunk = empty_chunk(settings, env, policy, sequence, spare);
    let mut means = vec![0.0; lanes * act_dim];
    let mut actions = vec![0.0; lanes * act_dim];
    let mut laps = Laps::new();
    for step in 0..settings.chunk_steps {
        if should_stop() {
            return Ok(None);
        }
        push_rows(&mut chunk, env);
        laps.lap(Part::Recording);
        policy.run(env.observations(), lanes, &mut means)?;
        let took = laps.lap(Part::Inference);
        metrics.inference.observe(took.as_secs_f64());
        if let Some(trace) = &mut trace {
            trace.inferred(took);
        }
        for lane in 0..lanes {
            let row = lane * act_dim..(lane + 1) * act_dim;
            let (mean, action) = (&means[row.clone()], &mut actions[row]);
            gaussian::sample(mean, &policy.std, env.action_stream(lane), action);
            chunk.log_probs.push(policy.density.log_prob(action, mean));
        }
        chunk.actions.extend_from_slice(&actions);
        chunk.action_means.extend_from_slice(&means);
        laps.lap(Part::Recording);
        let before = env.physics_time;
        env.step(&actions)?;
        let physics = env.physics_time - before;
        let took = laps.lap_with(Part::Task, (Part::Physics, physics));
        let output = env.output();
        metrics.env_seconds.inc_by(took.as_secs_f64());
        metrics.steps.inc_by(lanes as u64);
        metrics.episodes.inc_by(output.episodes.len() as u64);
        record(&mut chunk, step, output, env.critic().dim());
        if let Some(trace) = &mut trace {
            trace.stepped(took);
        }
    }
    let counted = chunk.observations.len();
    push_rows(&mut chunk, env);
    chunk.moments = moments_of(&chunk.observations[..counted], chunk.obs_dim);
    laps.lap(Part::Recording);
    if let Some(trace) = &mut trace {
        trace.ended();
        chunk.trace = Some(trace.collected);
    }
    Ok(Some((chunk, trace)))
}

/// What policy and value function see of each lane now.
fn push_rows(chunk: &mut RolloutChunk, env: &VecEnv) {
    let more = env.critic().dim();
    let rows = env.observations().chunks_exact(env.obs_dim());
    for (lane, seen) in rows.enumerate() {
        let privileged = &env.privileged()[lane * more..][..more];
        chunk.observations.extend_from_slice(seen);
        chunk.observations.extend_from_slice(privileged);
    }
}

/// What a step gave; the value function sees `more` values besides an observation.
fn record(chunk: &mut RolloutChunk, step: usize, output: &StepOutput, more: usize) {
    chunk.rewards.extend_from_slice(&output.rewards);
    chunk.terminated.extend_from_slice(&output.terminated);
    chunk.truncated.extend_from_slice(&output.truncated);
    // The learner bootstraps from a final observation only where the time limit ended the episode.
    let mut finals: Vec<_> = output
        .final_observations
        .iter()
        .enumerate()
        .filter(|(_, (lane, _))| output.truncated[*lane])
        .map(|(end, (lane, seen))| FinalObservation {
            step,
            lane: *lane,
            observation: [seen, &output.final_privileged[end * more..][..more]].concat(),
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
    spare: &mut RolloutChunk,
) -> RolloutChunk {
    let (steps, lanes) = (settings.chunk_steps, env.lanes());
    let (obs_dim, act_dim) = (env.obs_dim() + env.critic().dim(), env.act_dim());
    let cells = steps * lanes;
    RolloutChunk {
        run_id: settings.run_id.clone(),
        actor_id: settings.actor_id,
        incarnation: settings.incarnation,
        sequence,
        policy_version: policy.version,
        policy_sha256: policy.sha256,
        contract_hash: settings.world.seal(env.contract().hash()),
        steps,
        lanes,
        obs_dim,
        act_dim,
        observations: emptied(&mut spare.observations, (steps + 1) * lanes * obs_dim),
        actions: emptied(&mut spare.actions, cells * act_dim),
        action_means: emptied(&mut spare.action_means, cells * act_dim),
        log_std: policy.log_std.clone(),
        log_probs: emptied(&mut spare.log_probs, cells),
        rewards: emptied(&mut spare.rewards, cells),
        terminated: emptied(&mut spare.terminated, cells),
        truncated: emptied(&mut spare.truncated, cells),
        moments: moments_of(&[], obs_dim),
        action_history: Some(ActionHistory {
            first: env.contract().observation.range(Observed::Actions).start,
            steps: ACTION_HISTORY,
            clip: env.task().action.clip,
        }),
        ..RolloutChunk::default()
    }
}

/// The memory of `values`, with room for `count` of them.
fn emptied<T>(values: &mut Vec<T>, count: usize) -> Vec<T> {
    let mut values = std::mem::take(values);
    values.clear();
    values.reserve(count);
    values
}
