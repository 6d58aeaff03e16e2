//! From domain types to bytes and back.

use prost::Message;

use super::check::{self, dimension, length, product};
use super::error::DecodeError;
use super::history;
use super::messages::{
    ActionHistory, ActorBye, ActorHello, DecodeLimits, Envelope, EpisodeSummary, FinalObservation,
    Moments, ROLLOUT_PROTOCOL, RolloutChunk,
};
use super::tensors::{self, Tensors};
use super::trace::TraceContext;
use crate::wire::rollout as pb;

/// Writes a frame. Writes what it is given: [`RolloutChunk::check`] tells beforehand whether the
/// far side will take it.
pub fn encode(envelope: &Envelope) -> Vec<u8> {
    let body = match envelope {
        Envelope::Chunk(chunk) => {
            let sent = history::leave_out(chunk);
            let left_out = chunk.action_history.filter(|_| sent.is_some());
            let head = head_to_wire(chunk, left_out).encode_to_vec();
            let observations = sent.as_deref().unwrap_or(&chunk.observations);
            return tensors::join(&head, chunk, observations);
        }
        Envelope::Hello(hello) => pb::envelope::Body::Hello(hello_to_wire(hello)),
        Envelope::Bye(bye) => pb::envelope::Body::Bye(bye_to_wire(bye)),
    };
    pb::Envelope { protocol: ROLLOUT_PROTOCOL, body: Some(body) }.encode_to_vec()
}

/// Reads a frame and checks it completely.
///
/// # Errors
/// The first thing that is not right; [`DecodeError::reason_id`] names it for counters.
pub fn decode(frame: &[u8], limits: &DecodeLimits) -> Result<Envelope, DecodeError> {
    if frame.len() > limits.max_frame_bytes {
        return Err(DecodeError::FrameTooLarge {
            bytes: frame.len(),
            limit: limits.max_frame_bytes,
        });
    }
    let (rest, tensors) = tensors::split(frame)?;
    let message = pb::Envelope::decode(rest.as_slice())?;
    drop(rest);
    if message.protocol != ROLLOUT_PROTOCOL {
        return Err(DecodeError::Protocol { found: message.protocol, expected: ROLLOUT_PROTOCOL });
    }
    match message.body.ok_or(DecodeError::Missing { field: "body" })? {
        pb::envelope::Body::Hello(hello) => hello_from_wire(hello, limits).map(Envelope::Hello),
        pb::envelope::Body::Chunk(chunk) => {
            let chunk = chunk_from_wire(chunk, &tensors, limits)?;
            chunk.check_values(limits)?;
            Ok(Envelope::Chunk(Box::new(chunk)))
        }
        pb::envelope::Body::Bye(bye) => bye_from_wire(bye).map(Envelope::Bye),
    }
}

fn hello_to_wire(hello: &ActorHello) -> pb::ActorHello {
    pb::ActorHello {
        run_id: hello.run_id.clone(),
        actor_id: hello.actor_id,
        incarnation: hello.incarnation,
        lanes: to_u32(hello.lanes),
        contract_hash: hello.contract_hash.to_vec(),
        build: hello.build.clone(),
    }
}

fn hello_from_wire(
    hello: pb::ActorHello,
    limits: &DecodeLimits,
) -> Result<ActorHello, DecodeError> {
    check::run_id(&hello.run_id)?;
    check::line("build", &hello.build)?;
    dimension("lanes", hello.lanes as usize, limits.max_lanes)?;
    Ok(ActorHello {
        run_id: hello.run_id,
        actor_id: hello.actor_id,
        incarnation: hello.incarnation,
        lanes: hello.lanes as usize,
        contract_hash: hash("contract_hash", &hello.contract_hash)?,
        build: hello.build,
    })
}

fn bye_to_wire(bye: &ActorBye) -> pb::ActorBye {
    pb::ActorBye {
        run_id: bye.run_id.clone(),
        actor_id: bye.actor_id,
        incarnation: bye.incarnation,
        sent: bye.sent,
        reason: bye.reason.clone(),
    }
}

fn bye_from_wire(bye: pb::ActorBye) -> Result<ActorBye, DecodeError> {
    check::run_id(&bye.run_id)?;
    check::line("reason", &bye.reason)?;
    Ok(ActorBye {
        run_id: bye.run_id,
        actor_id: bye.actor_id,
        incarnation: bye.incarnation,
        sent: bye.sent,
        reason: bye.reason,
    })
}

/// All of a chunk but its tensors.
fn head_to_wire(chunk: &RolloutChunk, left_out: Option<ActionHistory>) -> pb::RolloutChunk {
    pb::RolloutChunk {
        run_id: chunk.run_id.clone(),
        actor_id: chunk.actor_id,
        incarnation: chunk.incarnation,
        sequence: chunk.sequence,
        policy_version: chunk.policy_version,
        policy_sha256: chunk.policy_sha256.to_vec(),
        contract_hash: chunk.contract_hash.to_vec(),
        steps: to_u32(chunk.steps),
        lanes: to_u32(chunk.lanes),
        obs_dim: to_u32(chunk.obs_dim),
        act_dim: to_u32(chunk.act_dim),
        final_observations: Some(finals_to_wire(&chunk.final_observations)),
        episodes: Some(episodes_to_wire(&chunk.episodes)),
        moments: Some(pb::Moments {
            count: chunk.moments.count,
            mean: from_f64(&chunk.moments.mean),
            m2: from_f64(&chunk.moments.m2),
        }),
        trace: chunk.trace.map_or_else(Vec::new, TraceContext::to_wire),
        action_history: left_out.map(|history| pb::ActionHistory {
            first: to_u32(history.first),
            steps: to_u32(history.steps),
            clip: history.clip,
        }),
        ..pb::RolloutChunk::default()
    }
}

/// A chunk whose dimensions and lengths are right, with its past actions in their places.
fn chunk_from_wire(
    chunk: pb::RolloutChunk,
    tensors: &Tensors<'_>,
    limits: &DecodeLimits,
) -> Result<RolloutChunk, DecodeError> {
    let finals = chunk.final_observations.unwrap_or_default();
    let episodes = chunk.episodes.unwrap_or_default();
    let moments = chunk.moments.ok_or(DecodeError::Missing { field: "moments" })?;
    let [steps, lanes, obs_dim, act_dim] =
        [chunk.steps, chunk.lanes, chunk.obs_dim, chunk.act_dim].map(|n| n as usize);
    check::dimensions([steps, lanes, obs_dim, act_dim], limits)?;
    let action_history = chunk.action_history.map(|history| ActionHistory {
        first: history.first as usize,
        steps: history.steps as usize,
        clip: history.clip,
    });
    let mut read = RolloutChunk {
        run_id: chunk.run_id,
        actor_id: chunk.actor_id,
        incarnation: chunk.incarnation,
        sequence: chunk.sequence,
        policy_version: chunk.policy_version,
        policy_sha256: hash("policy_sha256", &chunk.policy_sha256)?,
        contract_hash: hash("contract_hash", &chunk.contract_hash)?,
        steps,
        lanes,
        obs_dim,
        act_dim,
        observations: to_f32("observations", tensors[0])?,
        actions: to_f32("actions", tensors[1])?,
        action_means: to_f32("action_means", tensors[2])?,
        log_std: to_f32("log_std", tensors[3])?,
        log_probs: to_f32("log_probs", tensors[4])?,
        rewards: to_f32("rewards", tensors[5])?,
        terminated: to_flags("terminated", tensors[6])?,
        truncated: to_flags("truncated", tensors[7])?,
        final_observations: finals_from_wire(&finals, obs_dim)?,
        episodes: episodes_from_wire(&episodes, limits)?,
        moments: Moments {
            count: moments.count,
            mean: to_f64("moments.mean", &moments.mean)?,
            m2: to_f64("moments.m2", &moments.m2)?,
        },
        action_history,
        trace: TraceContext::from_wire(&chunk.trace)?,
    };
    // Before it grows: a frame cannot ask for more than twice the observations that it has.
    match action_history {
        None => read.check_lengths(read.observations_len())?,
        Some(history) => {
            read.check_lengths(history.sent_len(&read)?)?;
            read.observations = history::put_back(&history, &read);
        }
    }
    Ok(read)
}

fn finals_to_wire(finals: &[FinalObservation]) -> pb::FinalObservations {
    pb::FinalObservations {
        steps: from_u32(finals.iter().map(|f| to_u32(f.step))),
        lanes: from_u32(finals.iter().map(|f| to_u32(f.lane))),
        observations: finals.iter().flat_map(|f| from_f32(&f.observation)).collect(),
    }
}

fn finals_from_wire(
    finals: &pb::FinalObservations,
    obs_dim: usize,
) -> Result<Vec<FinalObservation>, DecodeError> {
    let steps = to_u32s("final_observations.steps", &finals.steps)?;
    let lanes = to_u32s("final_observations.lanes", &finals.lanes)?;
    let values = to_f32("final_observations.observations", &finals.observations)?;
    length("final_observations.lanes", lanes.len(), steps.len())?;
    let expected = product(&[steps.len(), obs_dim]);
    length("final_observations.observations", values.len(), expected)?;
    Ok(steps
        .iter()
        .zip(&lanes)
        .zip(values.chunks_exact(obs_dim))
        .map(|((&step, &lane), observation)| FinalObservation {
            step: step as usize,
            lane: lane as usize,
            observation: observation.to_vec(),
        })
        .collect())
}

fn episodes_to_wire(episodes: &[EpisodeSummary]) -> pb::Episodes {
    pb::Episodes {
        lanes: from_u32(episodes.iter().map(|e| e.lane)),
        steps: from_u32(episodes.iter().map(|e| e.steps)),
        returns: episodes.iter().flat_map(|e| e.return_sum.to_le_bytes()).collect(),
        terms: to_u32(episodes.first().map_or(0, |e| e.terms.len())),
        term_sums: episodes.iter().flat_map(|e| from_f32(&e.terms)).collect(),
        terminated: episodes.iter().map(|e| u8::from(e.terminated)).collect(),
        reasons: episodes.iter().map(|e| e.reason).collect(),
        mean_speeds: episodes.iter().flat_map(|e| e.mean_speed_mps.to_le_bytes()).collect(),
    }
}

fn episodes_from_wire(
    episodes: &pb::Episodes,
    limits: &DecodeLimits,
) -> Result<Vec<EpisodeSummary>, DecodeError> {
    let lanes = to_u32s("episodes.lanes", &episodes.lanes)?;
    let steps = to_u32s("episodes.steps", &episodes.steps)?;
    let returns = to_f32("episodes.returns", &episodes.returns)?;
    let sums = to_f32("episodes.term_sums", &episodes.term_sums)?;
    let terminated = to_flags("episodes.terminated", &episodes.terminated)?;
    let speeds = to_f32("episodes.mean_speeds", &episodes.mean_speeds)?;
    let (count, terms) = (lanes.len(), episodes.terms as usize);
    if terms > limits.max_terms {
        return Err(DecodeError::Dimension {
            field: "episodes.terms",
            found: terms,
            limit: limits.max_terms,
        });
    }
    length("episodes.steps", steps.len(), count)?;
    length("episodes.returns", returns.len(), count)?;
    length("episodes.term_sums", sums.len(), product(&[count, terms]))?;
    length("episodes.terminated", terminated.len(), count)?;
    length("episodes.reasons", episodes.reasons.len(), count)?;
    length("episodes.mean_speeds", speeds.len(), count)?;
    Ok((0..count)
        .map(|i| EpisodeSummary {
            lane: lanes[i],
            steps: steps[i],
            return_sum: returns[i],
            terms: sums[i * terms..(i + 1) * terms].to_vec(),
            terminated: terminated[i],
            reason: episodes.reasons[i],
            mean_speed_mps: speeds[i],
        })
        .collect())
}

/// A count for the wire. One that does not fit becomes `u32::MAX`, which every reader refuses.
fn to_u32(value: usize) -> u32 {
    u32::try_from(value).unwrap_or(u32::MAX)
}

fn hash(field: &'static str, bytes: &[u8]) -> Result<[u8; 32], DecodeError> {
    bytes.try_into().map_err(|_| DecodeError::HashLength { field, found: bytes.len() })
}

fn from_f32(values: &[f32]) -> Vec<u8> {
    let mut bytes = vec![0; values.len() * 4];
    for (out, value) in bytes.chunks_exact_mut(4).zip(values) {
        out.copy_from_slice(&value.to_le_bytes());
    }
    bytes
}

fn from_f64(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|x| x.to_le_bytes()).collect()
}

fn from_u32(values: impl Iterator<Item = u32>) -> Vec<u8> {
    values.flat_map(u32::to_le_bytes).collect()
}

fn to_f32(field: &'static str, bytes: &[u8]) -> Result<Vec<f32>, DecodeError> {
    words(field, bytes, f32::from_le_bytes)
}

fn to_f64(field: &'static str, bytes: &[u8]) -> Result<Vec<f64>, DecodeError> {
    words(field, bytes, f64::from_le_bytes)
}

fn to_u32s(field: &'static str, bytes: &[u8]) -> Result<Vec<u32>, DecodeError> {
    words(field, bytes, u32::from_le_bytes)
}

/// Little-endian numbers of `W` bytes.
fn words<const W: usize, T>(
    field: &'static str,
    bytes: &[u8],
    read: impl Fn([u8; W]) -> T,
) -> Result<Vec<T>, DecodeError> {
    let (chunks, rest) = bytes.as_chunks::<W>();
    if !rest.is_empty() {
        return Err(DecodeError::Ragged { field, bytes: bytes.len(), width: W });
    }
    Ok(chunks.iter().map(|&chunk| read(chunk)).collect())
}

fn to_flags(field: &'static str, bytes: &[u8]) -> Result<Vec<bool>, DecodeError> {
    if let Some(index) = bytes.iter().position(|&b| b > 1) {
        return Err(DecodeError::Flag { field, index, value: bytes[index] });
    }
    Ok(bytes.iter().map(|&b| b == 1).collect())
}
