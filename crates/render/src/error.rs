//! What can be wrong with a picture.

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum RenderError {
    /// A size or setting is out of range.
    #[error("{what} is {value}: {reason}")]
    Setting { what: &'static str, value: String, reason: &'static str },
    /// The pose does not fit the robot.
    #[error(transparent)]
    Model(#[from] caudata_model::ModelError),
    /// The encoder refused.
    #[error("cannot encode the picture: {0}")]
    Encode(String),
}

impl RenderError {
    pub(crate) fn setting(what: &'static str, value: impl ToString, reason: &'static str) -> Self {
        let value = value.to_string();
        Self::Setting { what, value, reason }
    }
}
