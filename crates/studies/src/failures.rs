//! What steps end with that cannot go on.

use caudata_evaluation::EvaluationError;
use caudata_telemetry::{ExitCode, Failure, StopFlag};

/// What an evaluation that cannot go on ends with.
pub fn refused(error: EvaluationError, stop: &StopFlag) -> Failure {
    match error {
        EvaluationError::Build(error) => error.into_failure(),
        EvaluationError::Refused(error) => Failure::new(ExitCode::PolicyRefused, error).hint(
            "give the config.toml of the run that made it (--config), or its robot file (--robot) and preset",
        ),
        EvaluationError::Inference(error) => Failure::new(ExitCode::BadInput, error),
        EvaluationError::Env(error) => Failure::new(ExitCode::Internal, error),
        EvaluationError::Stopped => stopped(stop),
    }
}

/// What a command ends with that was asked to stop.
pub fn stopped(stop: &StopFlag) -> Failure {
    let by = stop.reason().map(|reason| format!(" by {reason}"));
    let message = format!("stopped{}", by.unwrap_or_default());
    Failure::message(ExitCode::TempFail, message)
}
