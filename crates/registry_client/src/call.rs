//! What every call has: a deadline, and an answer that is checked and held against the question.

use std::time::Duration;

use caudata_proto::registry::question::Facts;
use caudata_proto::registry::{RegistryError, StreamName};
use tonic::{Response, Status};

use crate::error::{ClientError, refusal};
use crate::limits::CALL_TIMEOUT;

pub(crate) async fn within<T>(
    what: &'static str,
    limit: Duration,
    address: &str,
    call: impl Future<Output = Result<T, Status>>,
) -> Result<T, ClientError> {
    match tokio::time::timeout(limit, call).await {
        Err(_) => Err(ClientError::TimedOut { what }),
        Ok(Err(status)) => Err(refusal(address, &status)),
        Ok(Ok(answer)) => Ok(answer),
    }
}

/// The checked answer to a call that is not a stream.
pub(crate) async fn answer<W, T: TryFrom<W, Error = RegistryError>>(
    what: &'static str,
    address: &str,
    call: impl Future<Output = Result<Response<W>, Status>>,
) -> Result<T, ClientError> {
    let answer = within(what, CALL_TIMEOUT, address, call).await?;
    Ok(answer.into_inner().try_into()?)
}

/// Refuses a list of which an entry is not of the stream that was asked for.
pub(crate) fn all_of<'a>(
    stream: Option<&StreamName>,
    said: impl IntoIterator<Item = impl Into<Facts<'a>>>,
) -> Result<(), ClientError> {
    let asked = Facts::of_stream(stream);
    let mut said = said.into_iter();
    Ok(said.try_for_each(|entry| asked.answered_by(entry))?)
}
