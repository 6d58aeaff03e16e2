//! Fetches: a stored file in pieces, one copy for all who ask at the same time.

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use caudata_proto::wire::registry as wire;
use tokio_stream::Stream;
use tonic::{Code, Status};

use crate::limits::Share;
use crate::replies::replies;

/// Bytes in one piece of a file: what the HTTP/2 layer holds of an answer that nobody reads.
const FETCH_PIECE_BYTES: usize = 16 << 10;

/// An answer in pieces.
pub type ReplyStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Sends `info` and then the file from there on, while the client reads it within `idle`.
pub fn send_file(
    info: wire::FetchInfo,
    file: Arc<[u8]>,
    from: u64,
    idle: Duration,
    share: Share,
) -> ReplyStream<wire::FetchResponse> {
    let file = Bytes::from_owner(file);
    let from = usize::try_from(from).unwrap_or(usize::MAX).min(file.len());
    let mut bytes = file.slice(from..);
    // As for an upload that stalls: it may go on where it stopped.
    let (replies, answer) = replies(idle, Code::DeadlineExceeded);
    tokio::spawn(async move {
        let first = wire::FetchResponse { part: Some(wire::fetch_response::Part::Info(info)) };
        if !replies.send(first).await {
            return;
        }
        while !bytes.is_empty() {
            let piece = bytes.split_to(bytes.len().min(FETCH_PIECE_BYTES));
            let data = wire::FetchResponse { part: Some(wire::fetch_response::Part::Data(piece)) };
            if !replies.send(data).await {
                return;
            }
        }
        drop(bytes);
        replies.finish().await;
        drop(share);
    });
    Box::pin(answer)
}
