//! What actors tell the learner, as checked values.

use caudata_declare::settings;

use super::trace::TraceContext;

/// Version of the meaning of the rollout frames; a frame of any other is refused.
pub const ROLLOUT_PROTOCOL: u32 = 2;

/// One frame of the rollout transport.
#[derive(Debug, Clone, PartialEq)]
pub enum Envelope {
    /// An actor process introduces itself.
    Hello(ActorHello),
    /// T steps of N environments.
    Chunk(Box<RolloutChunk>),
    /// An actor process stops in good order.
    Bye(ActorBye),
}

/// First frame of an actor process, and again after each reconnect.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActorHello {
    /// The training run; 1 to 128 printable ASCII characters without spaces.
    pub run_id: String,
    /// Number of the actor within the run.
    pub actor_id: u32,
    /// Grows with every start of the same actor id.
    pub incarnation: u64,
    /// N, environments that the actor steps.
    pub lanes: usize,
    /// SHA-256 of the policy contract.
    pub contract_hash: [u8; 32],
    /// Version and commit of the actor's program; at most 256 characters, for the log.
    pub build: String,
}

/// Last frame of an actor process that stops in good order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActorBye {
    /// The training run.
    pub run_id: String,
    /// Number of the actor within the run.
    pub actor_id: u32,
    /// Which start of the actor.
    pub incarnation: u64,
    /// Chunks that this incarnation sent.
    pub sent: u64,
    /// Why it stops; one line of at most 256 characters, for the log.
    pub reason: String,
}

/// T steps of N environments under one policy.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RolloutChunk {
    /// The training run.
    pub run_id: String,
    /// Number of the actor within the run.
    pub actor_id: u32,
    /// Which start of the actor.
    pub incarnation: u64,
    /// Counts up by one for each chunk of an incarnation, from 0.
    pub sequence: u64,
    /// Version of the policy that chose the actions.
    pub policy_version: u64,
    /// SHA-256 of that policy's file.
    pub policy_sha256: [u8; 32],
    /// SHA-256 of the policy contract.
    pub contract_hash: [u8; 32],
    /// T.
    pub steps: usize,
    /// N.
    pub lanes: usize,
    /// D.
    pub obs_dim: usize,
    /// A.
    pub act_dim: usize,
    /// `[T+1, N, D]`, raw (not normalised); the last row is the bootstrap observation.
    pub observations: Vec<f32>,
    /// `[T, N, A]`, as sampled.
    pub actions: Vec<f32>,
    /// `[T, N, A]`, mean of the behaviour policy.
    pub action_means: Vec<f32>,
    /// `[A]`, natural logarithm of the behaviour policy's standard deviation.
    pub log_std: Vec<f32>,
    /// `[T, N]`, log-probability of the action under the behaviour policy.
    pub log_probs: Vec<f32>,
    /// `[T, N]`.
    pub rewards: Vec<f32>,
    /// `[T, N]`, the episode ended by failure: no value after it.
    pub terminated: Vec<bool>,
    /// `[T, N]`, the episode ended by its time limit: bootstrap from the final observation.
    /// Never set together with `terminated`.
    pub truncated: Vec<bool>,
    /// One for each set entry of `truncated`, ordered by step, then lane.
    pub final_observations: Vec<FinalObservation>,
    /// Episodes that ended within the chunk, in the order in which they ended.
    pub episodes: Vec<EpisodeSummary>,
    /// Statistics of the first T rows of `observations`.
    pub moments: Moments,
    /// Where observations repeat past actions, if they do. Those are then not sent; nothing that is learnt
    /// depends on it.
    pub action_history: Option<ActionHistory>,
    /// Where the chunk belongs in a trace, if it is traced. Nothing that is learnt depends on it.
    pub trace: Option<TraceContext>,
}

/// Columns of an observation that repeat the actions of the steps before: `steps` times A values from `first`
/// on, newest action first, each within ± `clip`; zeros after an episode's end. At most half of an
/// observation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionHistory {
    /// First column.
    pub first: usize,
    /// S, past actions.
    pub steps: usize,
    /// Largest magnitude of a past action; the chunk's `actions` are as sampled.
    pub clip: f32,
}

/// The last observation of an episode that its time limit cut off.
#[derive(Debug, Clone, PartialEq)]
pub struct FinalObservation {
    /// Step within the chunk, 0 to T-1.
    pub step: usize,
    /// Lane, 0 to N-1.
    pub lane: usize,
    /// `[D]`, raw.
    pub observation: Vec<f32>,
}

/// What the learner logs about one finished episode.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeSummary {
    /// Lane, 0 to N-1.
    pub lane: u32,
    /// Length in control steps, at least 1.
    pub steps: u32,
    /// Sum of rewards.
    pub return_sum: f32,
    /// Sum of each weighted reward term, in the order of the task's table; the same length in
    /// every episode of a chunk.
    pub terms: Vec<f32>,
    /// Ended by failure, not by the time limit.
    pub terminated: bool,
    /// The task's number of the reason; 0 where the time limit ended it.
    pub reason: u8,
    /// Mean speed of the whole body over the ground, m/s.
    pub mean_speed_mps: f32,
}

/// Count, mean and sum of squared deviations of observations, per component.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Moments {
    /// Observations counted: T times N.
    pub count: u64,
    /// `[D]`.
    pub mean: Vec<f64>,
    /// `[D]`, sum of squared deviations from the mean.
    pub m2: Vec<f64>,
}

settings! {
    /// Bounds on what [`decode`](super::decode) accepts.
    #[derive(Debug, Clone, PartialEq)]
    pub struct DecodeLimits {
        /// Bytes of one frame. Reading a frame takes at most about five times this.
        pub max_frame_bytes: usize = 64 << 20,
        /// T.
        pub max_steps: usize = 4096,
        /// N.
        pub max_lanes: usize = 65_536,
        /// D.
        pub max_obs_dim: usize = 4096,
        /// A.
        pub max_act_dim: usize = 256,
        /// Reward terms of an episode.
        pub max_terms: usize = 64,
        /// Largest magnitude of any number in a tensor. A finite 1e30 poisons the learner as surely
        /// as an infinity does; nothing in these tensors comes near a million.
        pub max_magnitude: f32 = 1e6,
    }
}
