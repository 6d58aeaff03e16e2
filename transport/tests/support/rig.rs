//! One run over one transport: its learner's end and as many actors' ends as a case wants.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::SystemTime;

use caudata_signing::pki::{Authority, Request, Role};
use caudata_transport::{
    ActorLink, Iceoryx2Config, InprocConfig, InprocHub, LearnerLink, Limits, TlsFiles,
    TransportConfig, ZenohConfig, actor_link, learner_link,
};

/// The transports under test.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Inproc,
    Iceoryx2,
    Zenoh,
    /// zenoh over QUIC, certificates on both sides.
    Quic,
}

/// Small frames and quick heartbeats.
pub fn limits() -> Limits {
    Limits {
        max_frame_bytes: 64 << 10,
        max_policy_bytes: 64 << 10,
        window_frames: 4,
        max_actors: 8,
        max_frames_per_s: 0,
        heartbeat_ms: 30,
        peer_timeout_ms: 1_000,
    }
}

/// A run with its learner's end.
pub struct Rig {
    pub run_id: String,
    pub learner: Box<dyn LearnerLink>,
    /// What actors are given.
    pub config: TransportConfig,
    hub: Option<InprocHub>,
    /// Only for the tidiness check when dropped; `None` leaves that to the case.
    residue: Option<Residue>,
}

impl Rig {
    pub fn new(kind: Kind, limits: Limits) -> Self {
        let run_id = fresh_run_id();
        if kind == Kind::Inproc {
            let config = InprocConfig { limits };
            let hub = InprocHub::new(&config).unwrap();
            return Self {
                run_id,
                learner: hub.learner().unwrap(),
                config: TransportConfig::Inproc(config),
                hub: Some(hub),
                residue: None,
            };
        }
        let config = remote(kind, limits);
        let learner = learner_link(&config, &run_id).unwrap();
        Self {
            config: for_actors(learner.actor_config(), &config),
            residue: Residue::of(&config),
            run_id,
            learner,
            hub: None,
        }
    }

    pub fn actor(&self, id: u32) -> Box<dyn ActorLink> {
        match &self.hub {
            Some(hub) => hub.actor().unwrap(),
            None => actor_link(&self.config, &self.run_id, id).unwrap(),
        }
    }

    /// Ends the run in order and checks that it left nothing in shared memory. Actors must be gone by now.
    pub fn finish(self) {
        let residue = self.residue;
        drop(self.learner);
        if let Some(residue) = residue {
            residue.assert_none();
        }
    }
}

/// A configuration for links between processes, as a learner is given it.
pub fn remote(kind: Kind, limits: Limits) -> TransportConfig {
    match kind {
        Kind::Inproc => panic!("not between processes"),
        Kind::Iceoryx2 => {
            TransportConfig::Iceoryx2(Iceoryx2Config { limits, root: Some(fresh_root()) })
        }
        Kind::Zenoh => TransportConfig::Zenoh(ZenohConfig { limits, ..ZenohConfig::default() }),
        Kind::Quic => TransportConfig::Zenoh(ZenohConfig {
            limits,
            listen: vec!["quic/localhost:0".to_owned()],
            connect: Vec::new(),
            tls: Some(lab().0.clone()),
        }),
    }
}

/// What a learner with `config` says to its actors, with an actor's certificates where there are any.
pub fn for_actors(told: TransportConfig, config: &TransportConfig) -> TransportConfig {
    match (told, config) {
        (TransportConfig::Zenoh(told), TransportConfig::Zenoh(config)) => {
            TransportConfig::Zenoh(ZenohConfig {
                tls: config.tls.as_ref().map(|_| lab().1.clone()),
                ..told
            })
        }
        (told, _) => told,
    }
}

/// The certificates of this test process's lab: a learner's and an actor's.
fn lab() -> &'static (TlsFiles, TlsFiles) {
    static LAB: OnceLock<(TlsFiles, TlsFiles)> = OnceLock::new();
    LAB.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
        // Nobody is there to remove it at the end: the next test process does.
        for old in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let name = old.file_name().into_string().unwrap();
            let gone = |pid: &str| !Path::new("/proc").join(pid).exists();
            if name.strip_prefix("lab-").is_some_and(gone) {
                let _ = std::fs::remove_dir_all(old.path());
            }
        }
        let now = SystemTime::now();
        let folder = folder.join(format!("lab-{}", std::process::id()));
        let authority = Authority::create(&folder, "lab", now).unwrap();
        let issue = |role, name: &str| {
            let request = Request {
                role,
                name: name.to_owned(),
                hosts: vec!["localhost".to_owned()],
                days: 1,
            };
            TlsFiles::in_folder(&authority.issue(&request, now, false).unwrap())
        };
        (issue(Role::Learner, "learner"), issue(Role::Actor, "actor"))
    })
}

pub fn fresh_run_id() -> String {
    format!("test-{}-{}", std::process::id(), fresh())
}

/// A directory in shared memory that no other case uses, short because sockets lie under it.
fn fresh_root() -> PathBuf {
    PathBuf::from(format!("/dev/shm/ct{}-{}", std::process::id(), fresh()))
}

fn fresh() -> u32 {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

/// What an iceoryx2 run may not leave behind.
pub struct Residue {
    root: PathBuf,
    /// How the names of its segments begin.
    prefixes: Vec<String>,
}

impl Residue {
    /// Looks a running learner's files up; `None` for transports without any.
    pub fn of(config: &TransportConfig) -> Option<Self> {
        let TransportConfig::Iceoryx2(config) = config else {
            return None;
        };
        let root = config.root.clone().unwrap();
        let mut residue = Self { root, prefixes: Vec::new() };
        residue.note();
        Some(residue)
    }

    /// Remembers the segments of the learner that is in charge now.
    pub fn note(&mut self) {
        for run in std::fs::read_dir(&self.root).unwrap() {
            let note = std::fs::read_to_string(run.unwrap().path().join("current")).unwrap();
            let note: serde_json::Value = serde_json::from_str(&note).unwrap();
            self.prefixes.push(format!("cd{}_", note["tag"].as_str().unwrap()));
        }
        // The check below is worth nothing unless there is something now.
        assert!(!self.segments().is_empty());
    }

    pub fn assert_none(&self) {
        assert_eq!(self.segments(), Vec::<String>::new());
        assert!(!self.root.exists(), "{} is left", self.root.display());
    }

    fn segments(&self) -> Vec<String> {
        let entries = std::fs::read_dir(Path::new("/dev/shm")).unwrap();
        entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .filter(|name| self.prefixes.iter().any(|prefix| name.starts_with(prefix)))
            .collect()
    }
}
