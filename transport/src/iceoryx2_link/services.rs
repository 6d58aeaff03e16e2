//! The services of one learner process, and the room they take in shared memory.

use std::fmt::Debug;
use std::fs::File;
use std::path::Path;
use std::time::Duration;

use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::{
    BackpressureStrategy, Config, FileName, LogLevel, Node, NodeBuilder, SemanticString,
    ServiceName, SignalHandlingMode, ZeroCopySend, ipc_threadsafe, set_log_level_from_env_or,
};
use iceoryx2::service::builder::publish_subscribe::Builder;
use iceoryx2::service::port_factory::publisher::PortFactoryPublisher;
use iceoryx2::service::port_factory::{event, publish_subscribe};
use nix::errno::Errno;
use nix::fcntl::posix_fallocate;
use nix::sys::statvfs::statvfs;

use super::run_dir::{RunPaths, SHM_DIR, io_error, prefix, segments};
use crate::reliable::{PolicyHead, Status, UpHead};
use crate::{Limits, TransportError};

/// Longest wait for a wake-up event before looking anyway.
pub(super) const WAKE: Duration = Duration::from_millis(50);

pub(super) type Ipc = ipc_threadsafe::Service;
/// The head of a message travels beside the frame, as iceoryx2's user header.
pub(super) type DataHead = [u8; UpHead::LEN];
/// Head of a policy; in rows, because only arrays of up to 32 have the default that iceoryx2 wants.
pub(super) type PolicyHeadBytes = [[u8; 16]; PolicyHead::LEN / 16];

/// Ports beyond one per actor: those of killed actors not yet cleaned up.
const SPARE_PORTS: usize = 8;
/// Messages that may lie in a connection besides the window's frames: a probe and a farewell.
const SPARE_MESSAGES: usize = 2;
/// Policies in shared memory at once: the newest, the next, and those that actors are copying right now.
/// Should stopped actors hold all others, publishing waits for one of them.
const POLICY_SAMPLES: usize = 4;
/// Status tables in shared memory at once.
const STATUS_SAMPLES: usize = 8;
/// What iceoryx2 puts before each payload, and what its management segments take, rounded up generously,
/// bytes.
const SAMPLE_OVERHEAD: usize = 256;
const MANAGEMENT_BYTES: u64 = 4 << 20;

/// All services of one learner process, and the node that holds them.
pub(super) struct Services {
    pub(super) data: publish_subscribe::PortFactory<Ipc, [u8], DataHead>,
    pub(super) status: publish_subscribe::PortFactory<Ipc, [u8], ()>,
    pub(super) policy: publish_subscribe::PortFactory<Ipc, [u8], PolicyHeadBytes>,
    pub(super) up: event::PortFactory<Ipc>,
    pub(super) down: event::PortFactory<Ipc>,
    /// Last: everything else belongs to it.
    pub(super) node: Node<Ipc>,
}

impl Services {
    /// The learner's way: makes them.
    pub(super) fn create(
        paths: &RunPaths,
        tag: &str,
        limits: &Limits,
    ) -> Result<Self, TransportError> {
        let node = node(paths, tag)?;
        let ports = limits.max_actors + SPARE_PORTS;
        let data = messages::<DataHead>(&node, "data")?
            .enable_safe_overflow(false)
            .history_size(0)
            .subscriber_max_buffer_size(limits.window_frames + SPARE_MESSAGES)
            .subscriber_max_borrowed_samples(1)
            .max_publishers(ports)
            .max_subscribers(1)
            .max_nodes(ports)
            .create()
            .map_err(backend)?;
        let status = newest::<()>(&node, "status", ports)?;
        let policy = newest::<PolicyHeadBytes>(&node, "policy", ports)?;
        let events = |name: &ServiceName, listeners: usize, notifiers: usize| {
            node.service_builder(name)
                .event()
                .max_listeners(listeners)
                .max_notifiers(notifiers)
                .max_nodes(ports)
                .event_id_max_value(0)
                .create()
                .map_err(backend)
        };
        // The learner wakes its own thread by the same event as the actors.
        let up = events(&name("up")?, 1, ports + 1)?;
        let down = events(&name("down")?, ports, 1)?;
        Ok(Self { data, status, policy, up, down, node })
    }

    /// The actor's way: joins them. Fails while they are not complete.
    pub(super) fn open(paths: &RunPaths, tag: &str) -> Result<Self, TransportError> {
        let node = node(paths, tag)?;
        let data = messages(&node, "data")?.open().map_err(backend)?;
        let status = messages(&node, "status")?.open().map_err(backend)?;
        let policy = messages(&node, "policy")?.open().map_err(backend)?;
        let up = node.service_builder(&name("up")?).event();
        let down = node.service_builder(&name("down")?).event();
        Ok(Self {
            data,
            status,
            policy,
            up: up.open().map_err(backend)?,
            down: down.open().map_err(backend)?,
            node,
        })
    }

    /// The publisher of an actor's frames; room for the whole window is set aside.
    pub(super) fn data_publisher(
        &self,
        tag: &str,
        limits: &Limits,
    ) -> Result<Publisher<Ipc, [u8], DataHead>, TransportError> {
        publisher(&self.data, tag, limits.max_frame_bytes, |own| {
            own.backpressure_strategy(BackpressureStrategy::DiscardData)
        })
    }

    /// The publisher of the table of answers.
    pub(super) fn status_publisher(
        &self,
        tag: &str,
        limits: &Limits,
    ) -> Result<Publisher<Ipc, [u8], ()>, TransportError> {
        publisher(&self.status, tag, Status::LEN * limits.max_actors, |own| {
            own.override_sample_preallocation(|_| STATUS_SAMPLES)
        })
    }

    /// The publisher of policies.
    pub(super) fn policy_publisher(
        &self,
        tag: &str,
        limits: &Limits,
    ) -> Result<Publisher<Ipc, [u8], PolicyHeadBytes>, TransportError> {
        publisher(&self.policy, tag, limits.max_policy_bytes, |own| {
            own.override_sample_preallocation(|_| POLICY_SAMPLES)
        })
    }
}

/// A publisher of bytes with headers `H` that is being made.
type Making<'a, H> = PortFactoryPublisher<'a, Ipc, [u8], H>;

/// The publisher of messages of up to `bytes`, set as `own` says; their room is set aside.
fn publisher<H: Debug + Default + ZeroCopySend>(
    service: &publish_subscribe::PortFactory<Ipc, [u8], H>,
    tag: &str,
    bytes: usize,
    own: fn(Making<'_, H>) -> Making<'_, H>,
) -> Result<Publisher<Ipc, [u8], H>, TransportError> {
    let all = service.publisher_builder().initial_max_slice_len(bytes).max_loaned_samples(1);
    let publisher = own(all).create().map_err(backend)?;
    reserve(tag, publisher.id().value())?;
    Ok(publisher)
}

/// A service of messages, each with a head beside it.
fn messages<H: Debug + ZeroCopySend>(
    node: &Node<Ipc>,
    called: &str,
) -> Result<Builder<[u8], H, Ipc>, TransportError> {
    let service = node.service_builder(&name(called)?);
    Ok(service.publish_subscribe::<[u8]>().user_header::<H>())
}

/// A service of the learner's of which only the newest message counts.
fn newest<H: Debug + ZeroCopySend>(
    node: &Node<Ipc>,
    called: &str,
    ports: usize,
) -> Result<publish_subscribe::PortFactory<Ipc, [u8], H>, TransportError> {
    messages::<H>(node, called)?
        .enable_safe_overflow(true)
        .history_size(1)
        .subscriber_max_buffer_size(1)
        .subscriber_max_borrowed_samples(1)
        .max_publishers(1)
        .max_subscribers(ports)
        .max_nodes(ports)
        .create()
        .map_err(backend)
}

/// Refuses to start where the learner's segments do not fit.
pub(super) fn check_room_for_learner(limits: &Limits) -> Result<(), TransportError> {
    let policies = POLICY_SAMPLES * (limits.max_policy_bytes + SAMPLE_OVERHEAD);
    let statuses = STATUS_SAMPLES * (Status::LEN * limits.max_actors + SAMPLE_OVERHEAD);
    check_room((policies + statuses) as u64 + MANAGEMENT_BYTES)
}

/// Refuses to start where an actor's segment does not fit.
pub(super) fn check_room_for_actor(limits: &Limits) -> Result<(), TransportError> {
    // The window and its spares, one that the learner is copying, one being written.
    let samples = limits.window_frames + SPARE_MESSAGES + 2;
    let bytes = samples * (limits.max_frame_bytes + SAMPLE_OVERHEAD);
    check_room(bytes as u64 + MANAGEMENT_BYTES)
}

fn check_room(needed: u64) -> Result<(), TransportError> {
    let path = Path::new(SHM_DIR);
    let system = statvfs(path).map_err(|e| io_error(path, &e.into()))?;
    let available = system.blocks_available() * system.fragment_size();
    if available < needed {
        return Err(no_space(needed));
    }
    Ok(())
}

/// Has the system set the pages of a publisher's segment aside now: a full file system is an error here, not
/// a bus error at the first write.
fn reserve(tag: &str, publisher: u128) -> Result<(), TransportError> {
    let ending = format!("_{publisher}.data");
    for path in segments(tag)? {
        if !path.to_string_lossy().ends_with(&ending) {
            continue;
        }
        let file = File::options().write(true).open(&path);
        let file = file.map_err(|e| io_error(&path, &e))?;
        let length = file.metadata().map_err(|e| io_error(&path, &e))?.len();
        let offset = i64::try_from(length).unwrap_or(i64::MAX);
        return match posix_fallocate(&file, 0, offset) {
            Ok(()) => Ok(()),
            Err(Errno::ENOSPC) => Err(no_space(length)),
            Err(e) => Err(io_error(&path, &e.into())),
        };
    }
    Err(TransportError::Backend(format!(
        "no shared-memory segment of publisher {publisher} in {SHM_DIR}"
    )))
}

fn no_space(needed: u64) -> TransportError {
    let path = Path::new(SHM_DIR);
    let available =
        statvfs(path).map_or(0, |system| system.blocks_available() * system.fragment_size());
    TransportError::NoSpace { path: path.to_owned(), needed, available }
}

fn node(paths: &RunPaths, tag: &str) -> Result<Node<Ipc>, TransportError> {
    // iceoryx2 logs to standard error by itself; what we act on is in our own errors.
    set_log_level_from_env_or(LogLevel::Fatal);
    let directory = paths.tag_dir(tag);
    let invalid = |what: &dyn Debug| {
        TransportError::Config(format!("iceoryx2.root {}: {what:?}", directory.display()))
    };
    let bytes = directory.as_os_str().as_encoded_bytes();
    let root = iceoryx2::prelude::Path::new(bytes).map_err(|e| invalid(&e))?;
    let mut config = Config::default();
    config.global.set_root_path(&root);
    config.global.prefix = FileName::new(prefix(tag).as_bytes()).map_err(|e| invalid(&e))?;
    // Only the learner cleans up after the dead, in its own time.
    config.global.service.cleanup_dead_nodes_on_open = false;
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Ipc>()
        .map_err(backend)
}

fn name(name: &str) -> Result<ServiceName, TransportError> {
    ServiceName::new(name).map_err(backend)
}

pub(super) fn backend(error: impl Debug) -> TransportError {
    TransportError::Backend(format!("iceoryx2: {error:?}"))
}
