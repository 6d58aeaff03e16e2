//! Why a rollout frame was refused.

use thiserror::Error;

/// Why a frame was refused. [`DecodeError::reason_id`] is its name in counters.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum DecodeError {
    /// Longer than [`super::DecodeLimits::max_frame_bytes`].
    #[error("frame has {bytes} bytes, the limit is {limit}; send fewer steps or lanes per chunk")]
    FrameTooLarge { bytes: usize, limit: usize },
    /// Not a protobuf message of this shape.
    #[error("frame is not a rollout message: {0}")]
    Malformed(#[from] prost::DecodeError),
    /// Written by a program with another version of the frames.
    #[error(
        "frame has protocol {found}, this program speaks {expected}; use the same build on both sides"
    )]
    Protocol { found: u32, expected: u32 },
    /// An envelope with nothing in it, or a chunk without one of its parts.
    #[error("frame lacks `{field}`")]
    Missing { field: &'static str },
    /// An identifier or a line of text is empty, too long or not printable.
    #[error("`{field}` must be {min} to {max} printable characters")]
    Text { field: &'static str, min: usize, max: usize },
    /// A hash that is not 32 bytes long.
    #[error("`{field}` has {found} bytes, a SHA-256 has 32")]
    HashLength { field: &'static str, found: usize },
    /// A dimension is zero or above its limit.
    #[error("`{field}` is {found}, must be 1 to {limit}")]
    Dimension { field: &'static str, found: usize, limit: usize },
    /// A tensor's length does not follow from the dimensions.
    #[error("`{field}` has {found} numbers, the dimensions call for {expected}")]
    Length { field: &'static str, found: usize, expected: usize },
    /// A tensor's bytes are not a whole number of numbers.
    #[error("`{field}` has {bytes} bytes, not a multiple of {width}")]
    Ragged { field: &'static str, bytes: usize, width: usize },
    /// NaN or infinity.
    #[error("`{field}` holds a NaN or an infinity at index {index}")]
    NotFinite { field: &'static str, index: usize },
    /// Finite but absurdly large.
    #[error("`{field}` holds {value:e} at index {index}, the limit is {limit:e}")]
    Magnitude { field: &'static str, index: usize, value: f64, limit: f32 },
    /// A flag other than 0 and 1.
    #[error("`{field}` holds {value} at index {index}, flags are 0 or 1")]
    Flag { field: &'static str, index: usize, value: u8 },
    /// An episode that both failed and ran out of time in the same step.
    #[error("step {step} of lane {lane} is both terminated and truncated")]
    FlagsOverlap { step: usize, lane: usize },
    /// Final observations that are not exactly those of the truncated steps.
    #[error(
        "final observation {index} does not belong to truncated step {expected:?} (step, lane)"
    )]
    FinalObservations {
        /// Which final observation.
        index: usize,
        /// The step and lane whose turn it is; `None` where there is none left.
        expected: Option<(usize, usize)>,
    },
    /// An episode summary that cannot be.
    #[error("episode {index}: {problem}")]
    Episode { index: usize, problem: &'static str },
    /// Past actions that no observation can have.
    #[error("action_history: {problem}")]
    ActionHistory { problem: &'static str },
    /// Statistics that cannot be those of this chunk.
    #[error("moments: {problem}")]
    Moments { problem: &'static str },
}

impl DecodeError {
    /// Name of the reason in counters and logs.
    pub fn reason_id(&self) -> &'static str {
        match self {
            Self::FrameTooLarge { .. } => "frame_too_large",
            Self::Malformed(_) => "malformed",
            Self::Protocol { .. } => "protocol",
            Self::Missing { .. } => "missing",
            Self::Text { .. } => "text",
            Self::HashLength { .. } => "hash_length",
            Self::Dimension { .. } => "dimension",
            Self::Length { .. } => "length",
            Self::Ragged { .. } => "ragged",
            Self::NotFinite { .. } => "not_finite",
            Self::Magnitude { .. } => "magnitude",
            Self::Flag { .. } => "flag",
            Self::FlagsOverlap { .. } => "flags_overlap",
            Self::FinalObservations { .. } => "final_observations",
            Self::Episode { .. } => "episode",
            Self::Moments { .. } => "moments",
            Self::ActionHistory { .. } => "action_history",
        }
    }
}
