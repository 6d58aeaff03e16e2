//! Answers in pieces towards one client, who may read them slowly, late or never.
//!
//! A few pieces wait for the client; then the server waits, but not for ever. Whoever takes none of them in
//! time is cut off: what waited is given up at once, although the client's connection may stay, and what it
//! finds when it reads on says why.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::mpsc;
use tokio_stream::Stream;
use tonic::{Code, Status};

/// Pieces that wait for one client at most; beyond them the server waits.
const WAITING_MAX: usize = 8;

/// What the two ends share.
struct Shared<T> {
    /// None once the client went or was cut off.
    waiting: Option<mpsc::Receiver<T>>,
    /// What comes after the last piece; none where all went well.
    end: Option<Status>,
    /// Who waits for a piece.
    reader: Option<Waker>,
}

type Ends<T> = Arc<Mutex<Shared<T>>>;

/// The server's end.
pub struct Replies<T> {
    pieces: mpsc::Sender<T>,
    ends: Ends<T>,
    idle: Duration,
    late: Code,
}

/// The client's end, as the answer to its call.
pub struct ReplyStream<T>(Ends<T>);

/// Both ends. The client must take one of the pieces that wait for it within `idle`; one that does not finds
/// `late` when it reads on.
pub fn replies<T>(idle: Duration, late: Code) -> (Replies<T>, ReplyStream<T>) {
    let (pieces, waiting) = mpsc::channel(WAITING_MAX);
    let ends = Arc::new(Mutex::new(Shared { waiting: Some(waiting), end: None, reader: None }));
    let stream = ReplyStream(Arc::clone(&ends));
    let replies = Replies { pieces, ends, idle, late };
    (replies, stream)
}

impl<T> Replies<T> {
    /// Hands `piece` on. False where nobody takes it: the client went, or read nothing for too long and is
    /// cut off.
    pub async fn send(&self, piece: T) -> bool {
        match tokio::time::timeout(self.idle, self.pieces.send(piece)).await {
            Ok(sent) => sent.is_ok(),
            Err(_) => {
                self.cut_off();
                false
            }
        }
    }

    /// Waits until the client is gone.
    pub async fn gone(&self) {
        self.pieces.closed().await;
    }

    /// Ends the answer with `status`, which the client finds behind what waits for it; waits as
    /// [`Replies::finish`] does.
    pub async fn end(self, status: Status) {
        self.ends.lock().end = Some(status);
        self.finish().await;
    }

    /// Ends an answer that is whole. Waits until the client took all of it: an answer that fits into what may
    /// wait would otherwise be kept for a client that reads nothing for as long as its connection stays.
    /// False where it went, or took no piece for too long and is cut off.
    pub async fn finish(self) -> bool {
        loop {
            let free = self.pieces.capacity();
            if free >= self.pieces.max_capacity() {
                return !self.pieces.is_closed();
            }
            // There is room for one more than now once the client took a piece.
            match tokio::time::timeout(self.idle, self.pieces.reserve_many(free + 1)).await {
                Ok(Ok(_)) => {}
                Ok(Err(_)) => return false,
                Err(_) => {
                    self.cut_off();
                    return false;
                }
            }
        }
    }

    fn cut_off(&self) {
        let idle_s = self.idle.as_secs_f32();
        tracing::warn!(idle_s, "a client reads nothing of its answer and is cut off");
        let (waiting, reader) = {
            let mut shared = self.ends.lock();
            let line = format!("nothing of the answer was read for {idle_s} s; ask again");
            shared.end = Some(Status::new(self.late, line));
            (shared.waiting.take(), shared.reader.take())
        };
        drop(waiting);
        // It may have read the last piece a moment ago, and waits for the next one.
        if let Some(reader) = reader {
            reader.wake();
        }
    }
}

impl<T> Stream for ReplyStream<T> {
    type Item = Result<T, Status>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let mut shared = self.0.lock();
        let piece = match &mut shared.waiting {
            Some(waiting) => waiting.poll_recv(context),
            None => Poll::Ready(None),
        };
        match piece {
            Poll::Ready(Some(piece)) => Poll::Ready(Some(Ok(piece))),
            Poll::Ready(None) => Poll::Ready(shared.end.take().map(Err)),
            Poll::Pending => {
                shared.reader = Some(context.waker().clone());
                Poll::Pending
            }
        }
    }
}

impl<T> Drop for ReplyStream<T> {
    fn drop(&mut self) {
        let waiting = self.0.lock().waiting.take();
        drop(waiting);
    }
}

#[cfg(test)]
mod tests {
    use tokio_stream::StreamExt;

    use super::*;

    /// How long anything is waited for before the test gives up.
    const PATIENCE: Duration = Duration::from_secs(120);
    const NEVER: Duration = Duration::from_secs(3600);
    const SOON: Duration = Duration::from_millis(20);
    const LATE: Code = Code::ResourceExhausted;

    async fn patient<T>(what: impl Future<Output = T>) -> T {
        tokio::time::timeout(PATIENCE, what).await.expect("it comes")
    }

    #[tokio::test]
    async fn what_waits_comes_first_and_then_the_end() {
        let (replies, mut stream) = replies(NEVER, LATE);
        for n in 0..WAITING_MAX {
            assert!(replies.send(n).await);
        }
        // Although there is no room.
        tokio::spawn(replies.end(Status::unavailable("over")));
        for n in 0..WAITING_MAX {
            assert_eq!(stream.next().await.unwrap().unwrap(), n);
        }
        assert_eq!(stream.next().await.unwrap().unwrap_err().code(), Code::Unavailable);
        assert!(stream.next().await.is_none());
    }

    #[tokio::test]
    async fn an_answer_that_went_well_has_no_last_word() {
        let (replies, mut stream) = replies(NEVER, LATE);
        for n in 0..3 {
            assert!(replies.send(n).await);
        }
        let end = tokio::spawn(replies.finish());
        for n in 0..3 {
            assert_eq!(patient(stream.next()).await.unwrap().unwrap(), n);
        }
        assert!(patient(stream.next()).await.is_none());
        assert!(patient(end).await.unwrap(), "all of it was taken");
    }

    #[tokio::test]
    async fn a_whole_answer_is_given_up_too_where_nobody_reads_it() {
        let piece = Arc::new(());
        for ends in [false, true] {
            let (replies, mut stream) = replies(SOON, LATE);
            for _ in 0..3 {
                assert!(replies.send(Arc::clone(&piece)).await);
            }
            assert_eq!(Arc::strong_count(&piece), 1 + 3);
            match ends {
                true => patient(replies.end(Status::unavailable("over"))).await,
                false => assert!(!patient(replies.finish()).await),
            }
            assert_eq!(Arc::strong_count(&piece), 1, "nothing is kept for it");
            let told = patient(stream.next()).await.unwrap().unwrap_err();
            assert_eq!(told.code(), LATE);
            assert!(patient(stream.next()).await.is_none());
        }
        // Nor is a client waited for that went.
        let (replies, stream) = replies(NEVER, LATE);
        assert!(replies.send(piece).await);
        drop(stream);
        assert!(!patient(replies.finish()).await);
    }

    #[tokio::test]
    async fn who_never_reads_is_cut_off_and_what_waited_is_given_up() {
        let (replies, mut stream) = replies(SOON, LATE);
        let piece = Arc::new(());
        for _ in 0..WAITING_MAX {
            assert!(replies.send(Arc::clone(&piece)).await);
        }
        assert_eq!(Arc::strong_count(&piece), 1 + WAITING_MAX);
        assert!(!patient(replies.send(Arc::clone(&piece))).await);
        assert_eq!(Arc::strong_count(&piece), 1, "nothing is kept for it");
        // Nor does it get a place again.
        assert!(!patient(replies.send(Arc::clone(&piece))).await);
        patient(replies.gone()).await;
        let told = patient(stream.next()).await.unwrap().unwrap_err();
        assert_eq!(told.code(), LATE);
        assert!(patient(stream.next()).await.is_none());
    }

    #[tokio::test]
    async fn one_that_waits_for_the_next_piece_is_told_that_it_is_cut_off() {
        let (replies, mut stream) = replies::<u8>(NEVER, LATE);
        let reader = tokio::spawn(async move { stream.next().await });
        // It is there and waits.
        while replies.ends.lock().reader.is_none() {
            tokio::task::yield_now().await;
        }
        replies.cut_off();
        let told = patient(reader).await.unwrap().unwrap().unwrap_err();
        assert_eq!(told.code(), LATE);
    }

    #[tokio::test]
    async fn a_client_that_went_is_noticed() {
        let (replies, stream) = replies(NEVER, LATE);
        for n in 0..WAITING_MAX {
            assert!(replies.send(n).await);
        }
        drop(stream);
        patient(replies.gone()).await;
        assert!(!patient(replies.send(9)).await);
    }
}
