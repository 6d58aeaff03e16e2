//! Saving an actor between two chunks, so that a resumed run goes on with the same bits.

use std::sync::Arc;
use std::time::Duration;

use parking_lot::{Condvar, Mutex};

/// Everything of an actor that outlives a chunk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActorSnapshot {
    /// Actor.
    pub actor_id: u32,
    /// The actor number in the keys of its random streams; the resumed environments are made with it.
    pub actor_key: u64,
    /// Newest policy version seen.
    pub policy_version: Option<u64>,
    /// Chunks that may still be collected before the next version.
    pub credits: u32,
    /// The environments, from `VecEnv::snapshot`.
    pub env: Vec<u8>,
}

impl ActorSnapshot {
    const MAGIC: &'static [u8; 8] = b"caudact1";

    /// As bytes for a checkpoint; all numbers little endian.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.env.len() + 48);
        out.extend(Self::MAGIC);
        out.extend(self.actor_id.to_le_bytes());
        out.extend(self.credits.to_le_bytes());
        out.extend(self.actor_key.to_le_bytes());
        out.push(u8::from(self.policy_version.is_some()));
        out.extend(self.policy_version.unwrap_or_default().to_le_bytes());
        out.extend((self.env.len() as u64).to_le_bytes());
        out.extend(&self.env);
        out
    }

    /// The opposite of [`to_bytes`](Self::to_bytes); `None` when the bytes are not exactly a snapshot.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let mut rest = bytes.strip_prefix(Self::MAGIC)?;
        let actor_id = u32::from_le_bytes(take(&mut rest)?);
        let credits = u32::from_le_bytes(take(&mut rest)?);
        let actor_key = u64::from_le_bytes(take(&mut rest)?);
        let [known] = take(&mut rest)?;
        let version = u64::from_le_bytes(take(&mut rest)?);
        let length = u64::from_le_bytes(take(&mut rest)?);
        if known > 1 || u64::try_from(rest.len()) != Ok(length) {
            return None;
        }
        let policy_version = (known == 1).then_some(version);
        Some(Self { actor_id, actor_key, policy_version, credits, env: rest.to_vec() })
    }
}

fn take<const N: usize>(rest: &mut &[u8]) -> Option<[u8; N]> {
    let (head, tail) = rest.split_first_chunk()?;
    *rest = tail;
    Some(*head)
}

/// Where a learner in the same process asks an actor for its state. Cloning shares it.
///
/// The actor answers between two chunks. With `max_lead = 0` and a full batch in the learner's hands, every
/// actor is between two chunks, and the answers of all actors belong together.
#[derive(Clone, Debug, Default)]
pub struct SnapshotPort {
    shared: Arc<(Mutex<Request>, Condvar)>,
}

#[derive(Debug, Default)]
enum Request {
    #[default]
    None,
    Asked,
    Answered(Result<ActorSnapshot, String>),
    /// The actor has ended.
    Closed,
}

impl SnapshotPort {
    /// A port that nobody has asked at.
    pub fn new() -> Self {
        Self::default()
    }

    /// Asks the actor and waits for its answer, at most `timeout`.
    ///
    /// # Errors
    /// One line: the actor has ended, did not answer in time, or could not save itself.
    pub fn take(&self, timeout: Duration) -> Result<ActorSnapshot, String> {
        let mut request = self.shared.0.lock();
        if !matches!(*request, Request::Closed) {
            *request = Request::Asked;
        }
        let asked = |request: &mut Request| matches!(request, Request::None | Request::Asked);
        self.shared.1.wait_while_for(&mut request, asked, timeout);
        if matches!(*request, Request::Closed) {
            return Err("the actor has ended".into());
        }
        match std::mem::take(&mut *request) {
            Request::Answered(answer) => answer,
            _ => Err(format!("the actor did not answer within {timeout:?}")),
        }
    }

    /// The actor's side: answers when asked.
    pub(crate) fn answer(&self, save: impl FnOnce() -> Result<ActorSnapshot, String>) {
        // Saving takes milliseconds and only the asker waits for the lock.
        let mut request = self.shared.0.lock();
        if matches!(*request, Request::Asked) {
            *request = Request::Answered(save());
            self.shared.1.notify_all();
        }
    }

    /// The actor's side: it ends.
    pub(crate) fn close(&self) {
        *self.shared.0.lock() = Request::Closed;
        self.shared.1.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example() -> ActorSnapshot {
        let env = vec![9, 8, 7];
        ActorSnapshot {
            actor_id: 2,
            actor_key: 5 << 32 | 2,
            policy_version: Some(11),
            credits: 1,
            env,
        }
    }

    #[test]
    fn bytes_come_back_equal_and_damage_is_noticed() {
        let snapshot = example();
        let bytes = snapshot.to_bytes();
        assert_eq!(ActorSnapshot::from_bytes(&bytes), Some(snapshot));
        for cut in 0..bytes.len() {
            assert_eq!(ActorSnapshot::from_bytes(&bytes[..cut]), None, "cut at {cut}");
        }
        let mut longer = bytes.clone();
        longer.push(0);
        assert_eq!(ActorSnapshot::from_bytes(&longer), None);
    }

    #[test]
    fn an_answer_reaches_the_asker_and_an_ended_actor_is_told() {
        let port = SnapshotPort::new();
        let asker = port.clone();
        let thread = std::thread::spawn(move || asker.take(Duration::from_secs(60)));
        while matches!(*port.shared.0.lock(), Request::None) {
            std::thread::yield_now();
        }
        port.answer(|| Ok(example()));
        assert_eq!(thread.join().unwrap(), Ok(example()));
        assert!(port.take(Duration::from_millis(1)).unwrap_err().contains("did not answer"));
        port.close();
        assert!(port.take(Duration::from_secs(60)).unwrap_err().contains("ended"));
    }
}
