//! The learner's end of a measured link.

use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Instant, SystemTime};

use caudata_actor::transport_config;
use caudata_config::TransportSection;
use caudata_signing::pki::{Authority, Request, Role};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use caudata_transport::{
    Control, InprocHub, LearnerLink, PolicyUpdate, TlsFiles, TransportConfig, ZenohConfig,
    learner_link,
};
use sha2::{Digest, Sha256};

use super::peer::Peer;
use super::plan::{Kind, LEAVE_MAX, WAIT};
use crate::measure::own_cpu_s;

/// The learner's end of a link, and what the other ends are given.
pub struct Stage {
    pub learner: Box<dyn LearnerLink>,
    /// For actors, certificates included.
    pub actor: TransportConfig,
    pub run_id: String,
    pub hub: Option<InprocHub>,
    /// Holds the certificates.
    _folder: Option<tempfile::TempDir>,
}

impl Stage {
    pub fn new(kind: Kind, mut section: TransportSection) -> Result<Self, Failure> {
        use caudata_config::TransportKind;
        let run_id = format!("bench-{}-{}", kind.name(), std::process::id());
        section.kind = match kind {
            Kind::Inproc => TransportKind::Inproc,
            Kind::Iceoryx2 => TransportKind::Iceoryx2,
            Kind::Zenoh | Kind::Quic => TransportKind::Zenoh,
        };
        let mut config = transport_config(&section);
        if let TransportConfig::Inproc(inproc) = &config {
            let hub = InprocHub::new(inproc).or_exit(ExitCode::BadConfig)?;
            return Ok(Self {
                learner: hub.learner().or_exit(ExitCode::Internal)?,
                actor: config,
                run_id,
                hub: Some(hub),
                _folder: None,
            });
        }
        let mut own_and_folder = None;
        if let (Kind::Quic, TransportConfig::Zenoh(zenoh)) = (kind, &mut config) {
            let folder = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
            let (learner, actor) = certificates(folder.path())?;
            zenoh.listen = vec!["quic/localhost:0".to_owned()];
            zenoh.tls = Some(learner);
            own_and_folder = Some((actor, folder));
        }
        let learner = learner_link(&config, &run_id).or_exit(ExitCode::OsResource)?;
        let (tls, folder) = own_and_folder.unzip();
        let actor = match learner.actor_config() {
            TransportConfig::Zenoh(zenoh) => TransportConfig::Zenoh(ZenohConfig { tls, ..zenoh }),
            other => other,
        };
        Ok(Self { learner, actor, run_id, hub: None, _folder: folder })
    }

    pub fn publish(
        &mut self,
        version: u64,
        bytes: Arc<[u8]>,
        control: Control,
    ) -> Result<(), Failure> {
        let update =
            PolicyUpdate { version, sha256: Sha256::digest(&bytes).into(), bytes, control };
        self.learner.publish_policy(update).or_exit(ExitCode::Internal)
    }

    /// Reads on until the other ends have left, so that none is stuck behind a full window.
    pub fn let_go(&mut self) -> Result<(), Failure> {
        let began = Instant::now();
        while self.learner.stats().peers > 0 && began.elapsed() < LEAVE_MAX {
            self.learner.recv(WAIT).or_exit(ExitCode::Internal)?;
        }
        Ok(())
    }
}

/// The other ends of a measured link: processes, and threads where the link is within this one.
#[derive(Default)]
pub struct Ends {
    pub peers: Vec<Peer>,
    threads: Vec<JoinHandle<Result<(), Failure>>>,
}

impl Ends {
    /// One more, as a thread.
    pub fn thread(&mut self, work: impl FnOnce() -> Result<(), Failure> + Send + 'static) {
        self.threads.push(std::thread::spawn(work));
    }

    /// CPU time of both ends so far, s.
    pub fn cpu_s(&self) -> Result<f64, Failure> {
        Ok(own_cpu_s()? + self.peers.iter().map(Peer::cpu_s).sum::<f64>())
    }

    /// Waits until all have ended.
    pub fn finish(self) -> Result<(), Failure> {
        for peer in self.peers {
            peer.finish()?;
        }
        for thread in self.threads {
            let ended = thread.join();
            ended.map_err(|_| Failure::message(ExitCode::Internal, "an actor panicked"))??;
        }
        Ok(())
    }
}

/// A lab's certificates for a learner and its actors on this host, in `folder`.
///
/// # Errors
/// When they cannot be made.
fn certificates(folder: &Path) -> Result<(TlsFiles, TlsFiles), Failure> {
    let made = |error: caudata_signing::pki::PkiError| {
        Failure::message(ExitCode::CannotCreate, error.to_string())
    };
    let now = SystemTime::now();
    let authority = Authority::create(folder, "bench", now).map_err(made)?;
    let issue = |role: Role, name: &str| {
        let request =
            Request { role, name: name.to_owned(), hosts: vec!["localhost".to_owned()], days: 1 };
        let folder = authority.issue(&request, now, false).map_err(made)?;
        Ok::<_, Failure>(TlsFiles::in_folder(&folder))
    };
    Ok((issue(Role::Learner, "learner")?, issue(Role::Actor, "actor")?))
}
