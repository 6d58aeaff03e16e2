//! What only shared memory has: files that stay behind, room that runs out, layouts that must agree.

use std::time::Duration;

use caudata_transport::{
    Limits, SendError, TransportConfig, TransportError, actor_link, clean_up, learner_link,
};

use crate::support::frames::{ATTEMPT, wait_until};
use crate::support::process::start_learner;
use crate::support::rig::{Kind, Residue, fresh_run_id, limits, remote};

/// Signal 9 leaves files in shared memory; a supervisor, or the next learner of the run, removes them.
#[test]
fn what_a_killed_learner_leaves_can_be_removed() {
    let config = remote(Kind::Iceoryx2, limits());
    let run_id = fresh_run_id();
    let (learner, _) = start_learner(&run_id, &config);
    let residue = Residue::of(&config).unwrap();
    let alive = clean_up(&config, &run_id);
    assert!(matches!(alive, Err(TransportError::AlreadyRunning { .. })), "{alive:?}");
    learner.kill();
    clean_up(&config, &run_id).unwrap();
    residue.assert_none();
}

#[test]
fn refuses_a_second_learner_of_the_run() {
    let config = remote(Kind::Iceoryx2, limits());
    let first = learner_link(&config, "twice").unwrap();
    let second = learner_link(&config, "twice").err().unwrap();
    assert!(matches!(second, TransportError::AlreadyRunning { .. }), "{second}");
    let other_run = learner_link(&config, "once").unwrap();
    drop((first, other_run));
}

/// No room is an error at the start that names the file system, not a bus error at the first write.
#[test]
fn refuses_to_start_without_room() {
    let shm = nix::sys::statvfs::statvfs("/dev/shm").unwrap();
    let room = shm.blocks_available() * shm.fragment_size();
    let huge =
        Limits { max_frame_bytes: Limits::MAX_BYTES, window_frames: Limits::MAX_COUNT, ..limits() };
    if room > (huge.max_frame_bytes * huge.window_frames) as u64 {
        return;
    }
    let config = remote(Kind::Iceoryx2, huge);
    match actor_link(&config, "huge", 0).err().unwrap() {
        TransportError::NoSpace { path, needed, available } => {
            assert_eq!(path.to_str(), Some("/dev/shm"));
            assert!(needed > available);
        }
        other => panic!("{other}"),
    }
}

/// Limits decide the layout of shared memory: an actor with others says so instead of misreading.
#[test]
fn reports_limits_that_differ() {
    let config = remote(Kind::Iceoryx2, limits());
    let learner = learner_link(&config, "limits").unwrap();
    let TransportConfig::Iceoryx2(mut other) = config else {
        panic!("another transport");
    };
    other.limits.window_frames += 1;
    let mut actor = actor_link(&TransportConfig::Iceoryx2(other), "limits", 0).unwrap();
    let mut result = Ok(());
    wait_until("the report", || {
        result = actor.send(b"x", Duration::ZERO);
        matches!(result, Err(SendError::Backend(_)))
    });
    assert!(result.unwrap_err().to_string().contains("differ from the learner's"));
    assert!(matches!(actor.next_policy(ATTEMPT), Err(TransportError::Backend(_))));
    drop((actor, learner));
}
