//! Random streams: the only source of random numbers in caudata.
//!
//! A [`Stream`] is the ChaCha8 key stream of a [`Key`] (who draws) and a [`Purpose`] (what for).
//! ChaCha is counter based, so a stream needs no warm-up, two streams share nothing, and a stream
//! is saved by its key, its purpose and how many 32-bit words it has given out.
//!
//! Same key, same purpose, same order of calls: same bits, on any number of threads and after any
//! save and restore.
//!
//! *Invariant:* nothing here reads a clock, the operating system's entropy or a global state.

mod stream;

pub use stream::Stream;

use serde::{Deserialize, Serialize};

/// What a stream is for. Each purpose of the same key is an independent stream, so that, for
/// example, switching sensor noise off does not change the commands that an episode sees.
///
/// The number is ChaCha's stream id: never reuse or renumber one, saved runs depend on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[repr(u64)]
pub enum Purpose {
    /// Initial weights of networks.
    Init = 1,
    /// The shape of the ground.
    Terrain = 2,
    /// The state that an episode starts from.
    Reset = 3,
    /// Physical parameters of one episode (masses, friction, gains …).
    Randomisation = 4,
    /// Commanded velocities.
    Command = 5,
    /// Pushes: when, how hard, which way.
    Push = 6,
    /// Noise and bias of sensors.
    Sensor = 7,
    /// Exploration noise on actions.
    Action = 8,
    /// Order of samples in minibatches.
    Minibatch = 9,
    /// Open-loop excitation signals for system identification.
    Excitation = 10,
    /// Which command frames a robot's bus loses.
    CommandLoss = 11,
}

/// Who draws: 32 bytes, which are the ChaCha key.
///
/// The four numbers go into the key as they are (little endian), not through a hash: two keys that
/// differ in any bit are different keys, and a cipher's outputs under different keys are unrelated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Key {
    /// Seed of the run.
    pub seed: u64,
    /// Actor number within the run.
    pub actor: u64,
    /// Environment (lane) number within the actor.
    pub env: u64,
    /// Episode number within the environment.
    pub episode: u64,
}

impl Key {
    /// A key for things drawn once per run, outside any actor or episode.
    pub fn for_run(seed: u64) -> Self {
        Self { seed, ..Self::default() }
    }

    /// The key as 32 bytes: seed, actor, env, episode, each little endian.
    pub fn to_bytes(self) -> [u8; 32] {
        let mut bytes = [0; 32];
        let words = [self.seed, self.actor, self.env, self.episode];
        for (chunk, word) in bytes.chunks_exact_mut(8).zip(words) {
            chunk.copy_from_slice(&word.to_le_bytes());
        }
        bytes
    }
}
