//! `[transport]`, `[policy_server]` and `[telemetry]`.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;

use caudata_declare::{named, settings};
use clap::ValueEnum;
use serde::{Deserialize, Serialize};

settings! {
    /// `[transport]`: how rollouts reach the learner and policies reach the actors.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct TransportSection {
        /// Which transport.
        pub kind: TransportKind = TransportKind::Inproc,
        /// Largest rollout frame, bytes. 1 to 268,435,456. A chunk is about
        /// `4 × chunk_steps × lanes × (observations + 2 × actions + 4)` bytes and must fit.
        pub max_frame_bytes: u64 = 8 << 20,
        /// Largest policy, bytes. 1 to 268,435,456.
        pub max_policy_bytes: u64 = 8 << 20,
        /// Frames of one actor that may wait unread at the learner. 1 to 1,024. Few: actors stall while the
        /// learner learns; many: memory, and older data.
        pub window_frames: u32 = 4,
        /// Actors connected at once. 1 to 1,024. One more is refused.
        pub max_actors: u32 = 64,
        /// Rollout frames that the learner takes from one actor per second, in the long run. 0: as many as it
        /// can read; else 1 to 100,000. A cap against an actor that floods; lower than what an honest one
        /// makes, it waits and the run is slower. Not in-process.
        pub max_frames_per_s: u32 = 0,
        /// How often the sides tell each other that they live, ms. 10 to 60,000.
        pub heartbeat_ms: u64 = 250,
        /// Silence after which the other side counts as gone, ms. At least three heartbeats, to 3,600,000.
        pub peer_timeout_ms: u64 = 3_000,
        /// iceoryx2: folder for its bookkeeping files; empty takes one in the system's temporary folder. Keep
        /// it short.
        pub iceoryx2_root: PathBuf,
        /// zenoh: where the learner listens. `tcp/HOST:PORT` is plain and accepted on loopback only;
        /// `quic/HOST:PORT` needs certificates (`cluster.tls_dir`).
        pub zenoh_listen: Vec<String> = vec!["tcp/127.0.0.1:0".into()],
        /// zenoh: what to connect to (a router, or the learner).
        pub zenoh_connect: Vec<String>,
    }
}

named! {
    /// Which transport.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
    #[serde(rename_all = "lowercase")]
    pub enum TransportKind {
        /// Actors are threads of the learner: fastest on one machine with few cores
        #[default]
        Inproc = "inproc",
        /// Actors are processes, over shared memory
        Iceoryx2 = "iceoryx2",
        /// Actors are processes, over TCP
        Zenoh = "zenoh",
    }
}

settings! {
    /// `[policy_server]`.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct PolicyServerConfig {
        /// Address of the gRPC service. Port 0 takes any free one.
        pub addr: SocketAddr = any_local_port(),
        /// Folder of the store, under the run folder unless absolute.
        pub dir: PathBuf = "registry".into(),
        /// Versions kept, newest first. 1 to 100,000.
        pub keep_versions: u32 = 64,
        /// Stream under which the policies of this run are published. Letters, digits, `-`, `_` and `.`, at
        /// most 64 of them; empty takes the run's id, so that runs never compete for a version number.
        pub stream: String,
    }
}

impl PolicyServerConfig {
    /// The stream under which the policies of run `run_id` are published.
    pub fn stream_of<'a>(&'a self, run_id: &'a str) -> &'a str {
        if self.stream.is_empty() { run_id } else { &self.stream }
    }
}

settings! {
    /// `[telemetry]`.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct TelemetryConfig {
        /// Whether processes serve `/metrics` and `/healthz`.
        pub metrics: bool = true,
        /// Where the learner serves them; the other processes take any free port of the same address. Port 0
        /// takes any.
        pub metrics_addr: SocketAddr = any_local_port(),
        /// How the logs of child processes look in `logs/`.
        pub log_format: LogStyle = LogStyle::Auto,
        /// What they log, for instance `info` or `warn,caudata_learner=debug`.
        pub log: String = "info".into(),
        /// Where traces go: an OpenTelemetry collector's OTLP/gRPC port, `http://HOST:PORT` on this host
        /// (usually 4317), or `https://HOST:PORT` with the certificates of `cluster.tls_dir`. Empty: nothing
        /// is traced. A collector that is away costs spans, not time.
        pub otlp_endpoint: String,
        /// Every so many policy versions one is traced. 1 to 1,000,000. A traced version makes a handful of
        /// spans per chunk.
        pub trace_every: u32 = 1,
    }
}

named! {
    /// How log lines look.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "lowercase")]
    pub enum LogStyle {
        /// Pretty on a terminal, JSON otherwise.
        #[default]
        Auto = "auto",
        /// For people.
        Pretty = "pretty",
        /// One JSON object per line.
        Json = "json",
    }
}

fn any_local_port() -> SocketAddr {
    (Ipv4Addr::LOCALHOST, 0).into()
}
