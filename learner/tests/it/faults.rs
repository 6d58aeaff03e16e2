//! A hostile actor beside an honest one, over a real transport.

use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::common::{Listener, config, run};
use caudata_actor::{
    ActorMetrics, ActorSettings, actor_key, build_env, decode_transport, moments::moments_of,
};
use caudata_config::Config;
use caudata_learner::train::Resume;
use caudata_model::RobotModel;
use caudata_proto::{Envelope, RolloutChunk, encode};
use caudata_task::PolicyContract;
use caudata_telemetry::progress::{Event, Finished};
use caudata_telemetry::{Metrics, StopFlag};
use caudata_transport::{TransportConfig, actor_link};

const PATIENCE: Duration = Duration::from_secs(60);

fn model(config: &Config) -> Arc<RobotModel> {
    Arc::new(RobotModel::load(&config.robot).unwrap())
}

/// Waits until the learner says where it listens.
fn endpoint(listener: &Listener) -> TransportConfig {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(Event::Started(started)) = listener.events().into_iter().next() {
            return decode_transport(&started.transport).unwrap();
        }
        assert!(Instant::now() < deadline, "the learner does not start");
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn honest(config: Config, transport: TransportConfig) -> JoinHandle<u64> {
    std::thread::spawn(move || {
        let settings = ActorSettings::from_config(&config, "test", 0, 0);
        let env = build_env(&config, model(&config), actor_key(0, 0)).unwrap();
        let link = actor_link(&transport, "test", 0).unwrap();
        let metrics = ActorMetrics::register(&Metrics::new());
        let stop = StopFlag::new();
        caudata_actor::run(&settings, env, link, &stop, &metrics, None, None).unwrap().sent
    })
}

/// Sends chunks that are wrong in five ways, then leaves without a word. Answers how many it sent.
fn hostile(config: Config, transport: TransportConfig) -> JoinHandle<u64> {
    std::thread::spawn(move || {
        let mut link = actor_link(&transport, "test", 1).unwrap();
        let deadline = Instant::now() + PATIENCE;
        let policy = loop {
            if let Some(policy) = link.next_policy(Duration::from_millis(50)).unwrap() {
                break policy;
            }
            assert!(Instant::now() < deadline, "no policy");
        };
        let contract = PolicyContract::new(&model(&config), &config.task).unwrap();
        let changes: [fn(&mut RolloutChunk); 5] = [
            |c| c.observations[5] = f32::NAN,
            |c| c.rewards[0] = f32::INFINITY,
            |c| c.actions[1] = 1e30,
            |c| c.contract_hash = [1; 32],
            |_| {}, // sound, but from an actor that is not listened to any more
        ];
        for (sequence, change) in changes.into_iter().enumerate() {
            let mut chunk = sound(&config, &contract, policy.version, policy.sha256);
            chunk.sequence = sequence as u64;
            change(&mut chunk);
            link.send(&encode(&Envelope::Chunk(Box::new(chunk))), PATIENCE).unwrap();
        }
        link.flush(PATIENCE).unwrap();
        changes.len() as u64
    })
}

/// A chunk that would be accepted.
fn sound(
    config: &Config,
    contract: &PolicyContract,
    policy_version: u64,
    policy_sha256: [u8; 32],
) -> RolloutChunk {
    let (steps, lanes) = (config.actors.chunk_steps as usize, config.actors.lanes as usize);
    let (obs_dim, act_dim, cells) = (contract.obs_dim(), contract.act_dim(), steps * lanes);
    let observations = vec![0.5; (steps + 1) * lanes * obs_dim];
    RolloutChunk {
        run_id: "test".into(),
        actor_id: 1,
        incarnation: 0,
        sequence: 0,
        policy_version,
        policy_sha256,
        contract_hash: config.world().seal(contract.hash()),
        steps,
        lanes,
        obs_dim,
        act_dim,
        actions: vec![0.0; cells * act_dim],
        action_means: vec![0.0; cells * act_dim],
        log_std: vec![0.0; act_dim],
        log_probs: vec![0.0; cells],
        rewards: vec![0.0; cells],
        terminated: vec![false; cells],
        truncated: vec![false; cells],
        final_observations: Vec::new(),
        episodes: Vec::new(),
        moments: moments_of(&observations[..cells * obs_dim], obs_dim),
        action_history: None,
        trace: None,
        observations,
    }
}

/// Six iterations with an honest actor, and a hostile one if `with_hostile`.
fn train(folder: &Path, with_hostile: bool) -> Finished {
    let overrides = ["transport.kind=zenoh", "learner.batch_timeout_s=2"];
    let config = config(6, &overrides);
    let listener = Listener::default();
    let learner = {
        let (folder, config, listener) = (folder.to_owned(), config.clone(), listener.clone());
        std::thread::spawn(move || run(&folder, config, Resume::No, &listener, None).unwrap())
    };
    let transport = endpoint(&listener);
    let bad = with_hostile.then(|| hostile(config.clone(), transport.clone()));
    let good = honest(config, transport);
    let finished = learner.join().unwrap();
    assert_eq!(good.join().unwrap(), finished.actors[0].received);
    if let Some(bad) = bad {
        assert_eq!(bad.join().unwrap(), finished.actors[1].received);
    }
    finished
}

#[test]
fn a_hostile_actor_changes_no_bit_and_every_chunk_is_accounted_for() {
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let dirty = train(dirs[0].path(), true);
    let clean = train(dirs[1].path(), false);

    let actor = &dirty.actors[1];
    assert_eq!((actor.received, actor.accepted, actor.rejected), (5, 0, 5));
    let reasons = &dirty.accounting.reasons;
    let named: Vec<(&str, u64)> = reasons.iter().map(|(name, n)| (name.as_str(), *n)).collect();
    // Three strikes; then the wrong contract and the sound one are not looked at any more.
    assert_eq!(named, [("magnitude", 1), ("not_finite", 2), ("quarantined", 2)]);
    assert_eq!((dirty.actors[0].accepted, clean.actors[0].accepted), (6, 6));
    assert_eq!(dirty.actors[0].sent, Some(6));
    let report = std::fs::read_to_string(dirs[0].path().join("accounting.json")).unwrap();
    assert!(report.contains("\"holds\": true"), "{report}");

    let state = |folder: &Path| {
        std::fs::read(folder.join("checkpoints/iter_000006/state.safetensors")).unwrap()
    };
    assert_eq!(state(dirs[0].path()), state(dirs[1].path()));
    assert_eq!(dirty.policy_sha256, clean.policy_sha256);
}
