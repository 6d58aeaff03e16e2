//! What a link needs to know: which transport, its limits, its addresses.

use std::path::{Path, PathBuf};
use std::time::Duration;

use caudata_declare::settings;
use serde::{Deserialize, Serialize};

use crate::TransportError;

/// Which transport carries the run, with its settings. Plain data: it can travel to an actor process
/// on a command line or in an environment variable as TOML or JSON.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum TransportConfig {
    /// Actors are threads of the learner's process. Links come from [`InprocHub`](crate::InprocHub).
    Inproc(InprocConfig),
    /// Actors are processes on the learner's host: shared memory.
    Iceoryx2(Iceoryx2Config),
    /// Actors are anywhere that reaches the learner, or a common router, by TCP on one host, by QUIC between
    /// hosts.
    Zenoh(ZenohConfig),
}

settings! {
    /// Bounds that hold on every transport. Both sides must have the same.
    #[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct Limits {
        /// Largest rollout frame, bytes. Default 8 MiB; at most 256 MiB. Too small: `TooLarge` on send.
        /// Too large: iceoryx2 reserves `window_frames + 4` of them per actor in shared memory.
        pub max_frame_bytes: usize = 8 << 20,
        /// Largest policy, bytes. Default 8 MiB; at most 256 MiB. iceoryx2 reserves four of them.
        pub max_policy_bytes: usize = 8 << 20,
        /// Frames of one actor that may wait unread at the learner. Default 4; 1 to 1024. Smaller: actors
        /// stall while the learner learns. Larger: more memory (`max_actors * window_frames * frame`), older
        /// data.
        pub window_frames: usize = 4,
        /// Actors connected at once. Default 64; 1 to 1024. One more is refused and keeps getting
        /// [`SendError::Disconnected`](crate::SendError::Disconnected).
        pub max_actors: usize = 64,
        /// Rollout frames that the learner takes from one actor per second, in the long run; up to
        /// `window_frames` at once. Default 0: as many as it can read. 1 to 100,000 otherwise. Lower than
        /// what an actor makes: it waits (back-pressure), nothing is lost. In-process actors are not limited.
        pub max_frames_per_s: u32 = 0,
        /// How often the sides tell each other that they live, ms. Default 250; 10 to 60,000.
        pub heartbeat_ms: u64 = 250,
        /// Silence after which the other side counts as gone, ms. Default 3,000; at least three heartbeats.
        pub peer_timeout_ms: u64 = 3_000,
    }
}

impl Limits {
    /// Largest size that any frame or policy limit may be set to, bytes.
    pub const MAX_BYTES: usize = 256 << 20;
    /// Largest `window_frames` and `max_actors`.
    pub const MAX_COUNT: usize = 1024;

    /// Refuses limits that cannot work, naming the field and its range.
    pub fn check(&self) -> Result<(), TransportError> {
        let range = |name: &str, value: u64, low: u64, high: u64| {
            if (low..=high).contains(&value) {
                return Ok(());
            }
            Err(TransportError::Config(format!(
                "limits.{name} = {value} is outside {low}..={high}"
            )))
        };
        let bytes = Self::MAX_BYTES as u64;
        let count = Self::MAX_COUNT as u64;
        range("max_frame_bytes", self.max_frame_bytes as u64, 1, bytes)?;
        range("max_policy_bytes", self.max_policy_bytes as u64, 1, bytes)?;
        range("window_frames", self.window_frames as u64, 1, count)?;
        range("max_actors", self.max_actors as u64, 1, count)?;
        range("max_frames_per_s", self.max_frames_per_s.into(), 0, 100_000)?;
        range("heartbeat_ms", self.heartbeat_ms, 10, 60_000)?;
        let shortest = self.heartbeat_ms.saturating_mul(3);
        range("peer_timeout_ms", self.peer_timeout_ms, shortest, 3_600_000)
    }

    pub(crate) fn heartbeat(&self) -> Duration {
        Duration::from_millis(self.heartbeat_ms)
    }

    pub(crate) fn peer_timeout(&self) -> Duration {
        Duration::from_millis(self.peer_timeout_ms)
    }
}

/// Settings of the in-process transport.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InprocConfig {
    /// Bounds.
    pub limits: Limits,
}

/// Settings of the shared-memory transport.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Iceoryx2Config {
    /// Bounds.
    pub limits: Limits,
    /// Directory under which each run gets its own directory for iceoryx2's bookkeeping files (mode 0700,
    /// removed with the run); the same for learner and actors. Default `/dev/shm/caudata-<uid>`.
    /// At most 32 bytes long: socket paths are short.
    pub root: Option<PathBuf>,
}

settings! {
    /// Settings of the network transport.
    #[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct ZenohConfig {
        /// Bounds.
        pub limits: Limits,
        /// Where the learner listens, zenoh endpoints. Default `["tcp/127.0.0.1:0"]`: this host only, the
        /// system chooses the port, and [`LearnerLink::actor_config`](crate::LearnerLink::actor_config) says
        /// which. `tcp/` is plain and accepted on loopback only; other addresses are `quic/` (UDP) and need
        /// [`tls`](Self::tls).
        pub listen: Vec<String> = vec!["tcp/127.0.0.1:0".to_owned()],
        /// What to connect to: for actors the learner's address or routers; for a learner behind a router
        /// the routers (then `listen` may be empty). Default empty.
        pub connect: Vec<String>,
        /// Own certificate and key, and the authority that the other side's must come from. Needed for
        /// `quic/` endpoints. What the other side may do follows from its certificate's common name: an actor
        /// may send rollouts and ask for policies, a learner and a router may do everything, nobody else
        /// anything.
        pub tls: Option<TlsFiles>,
    }
}

/// Certificates of one side, PEM files.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsFiles {
    /// Certificate of the authority that signs everybody's.
    pub ca: PathBuf,
    /// Own certificate.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

impl TlsFiles {
    /// `ca.crt`, `tls.crt` and `tls.key` in `folder`, as `caudata pki` and Kubernetes' secrets name them.
    pub fn in_folder(folder: &Path) -> Self {
        Self {
            ca: folder.join("ca.crt"),
            certificate: folder.join("tls.crt"),
            key: folder.join("tls.key"),
        }
    }

    /// The first of the files that cannot be read, with what the system says.
    pub(crate) fn unreadable(&self) -> Option<String> {
        [&self.ca, &self.certificate, &self.key].into_iter().find_map(|path| {
            let error = std::fs::File::open(path).err()?;
            Some(format!("{}: {error}", path.display()))
        })
    }
}

impl TransportConfig {
    /// The bounds of whichever transport this is.
    pub fn limits(&self) -> &Limits {
        match self {
            Self::Inproc(config) => &config.limits,
            Self::Iceoryx2(config) => &config.limits,
            Self::Zenoh(config) => &config.limits,
        }
    }
}
