//! The loop of an actor against a learner in the same process: real environments, a real policy file, real
//! frames.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use caudata_actor::{
    ActorError, ActorMetrics, ActorReport, ActorSettings, ActorSnapshot, SnapshotPort, actor_key,
    build_env, gaussian, moments::moments_of, read_ledger, run,
};
use caudata_config::{Config, Source};
use caudata_model::RobotModel;
use caudata_policy::{Activation, Dense, MlpSpec, PolicyMetadata, build_onnx};
use caudata_proto::{ActorBye, ActorHello, DecodeLimits, Envelope, RolloutChunk, decode};
use caudata_task::PolicyContract;
use caudata_telemetry::{ExitCode, Metrics, StopFlag};
use caudata_transport::{Control, InprocConfig, InprocHub, LearnerLink, PolicyUpdate};
use sha2::{Digest, Sha256};

const PATIENCE: Duration = Duration::from_secs(120);
const STEPS: usize = 5;
const LANES: usize = 3;

fn config(extra: &[&str]) -> Config {
    let mut source = Source::default()
        .set(format!("actors.lanes={LANES}"))
        .set(format!("actors.chunk_steps={STEPS}"))
        .set("actors.max_lead=0")
        .set("actors.flush_timeout_s=5")
        // Short episodes, so that ends are seen within a few chunks.
        .set("task.episode_steps=4");
    for assignment in extra {
        source = source.set(*assignment);
    }
    let mut config = Config::load(&source).unwrap();
    config.robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    config
}

fn model(config: &Config) -> Arc<RobotModel> {
    Arc::new(RobotModel::load(&config.robot).unwrap())
}

/// A small network whose weights depend on `version`, as a policy update.
fn policy(contract: &PolicyContract, version: u64) -> PolicyUpdate {
    let (inputs, outputs) = (contract.obs_dim(), contract.act_dim());
    let wave = |n: usize, phase: f32| -> Vec<f32> {
        (0..n).map(|i| 0.1 * (i as f32 * 0.7 + phase + version as f32).sin()).collect()
    };
    let spec = MlpSpec {
        obs_mean: vec![0.0; inputs],
        obs_std: vec![1.0; inputs],
        obs_clip: Some(10.0),
        activation: Activation::Elu,
        layers: vec![
            Dense { input: inputs, out: 8, weight: wave(8 * inputs, 0.0), bias: wave(8, 1.0) },
            Dense {
                input: 8,
                out: outputs,
                weight: wave(8 * outputs, 2.0),
                bias: wave(outputs, 3.0),
            },
        ],
    };
    let metadata = PolicyMetadata {
        contract: contract.clone(),
        version,
        run_id: "test".into(),
        training_commit: String::new(),
        config_hash: String::new(),
        env_steps: version * 10,
        seed: 1,
        log_std: vec![-0.5; outputs],
        created_unix_s: None,
        evaluation: None,
    };
    let bytes: Arc<[u8]> = build_onnx(&spec, &metadata).unwrap().into();
    PolicyUpdate { version, sha256: Sha256::digest(&bytes).into(), bytes, control: Control::Run }
}

fn stop_update(version: u64) -> PolicyUpdate {
    PolicyUpdate { version, sha256: [0; 32], bytes: Arc::new([]), control: Control::Stop }
}

/// An actor on a thread of its own, and the learner's end.
struct Bench {
    contract: PolicyContract,
    learner: Box<dyn LearnerLink>,
    port: SnapshotPort,
    actor: std::thread::JoinHandle<Result<ActorReport, ActorError>>,
}

impl Bench {
    fn start(
        config: &Config,
        change: impl FnOnce(&mut ActorSettings),
        resume: Option<ActorSnapshot>,
    ) -> Self {
        let mut inproc = InprocConfig::default();
        inproc.limits.window_frames = 1;
        let hub = InprocHub::new(&inproc).unwrap();
        let (learner, link) = (hub.learner().unwrap(), hub.actor().unwrap());
        let mut settings = ActorSettings::from_config(config, "test", 0, 0);
        change(&mut settings);
        let key = resume.as_ref().map_or(actor_key(0, 0), |saved| saved.actor_key);
        let env = build_env(config, model(config), key).unwrap();
        let contract = env.contract().clone();
        let port = SnapshotPort::new();
        let actor_port = port.clone();
        let actor = std::thread::spawn(move || {
            let metrics = ActorMetrics::register(&Metrics::new());
            let stop = StopFlag::new();
            run(&settings, env, link, &stop, &metrics, Some(&actor_port), resume.as_ref())
        });
        Self { contract, learner, port, actor }
    }

    fn publish(&mut self, version: u64) {
        let update = policy(&self.contract, version);
        self.learner.publish_policy(update).unwrap();
    }

    fn receive(&mut self) -> Envelope {
        let frame = self.learner.recv(PATIENCE).unwrap().expect("a frame");
        let limits = DecodeLimits::default();
        if let Some(value) = frame.value {
            // In one process chunks come as they are.
            let chunk = value.content.downcast::<RolloutChunk>().unwrap();
            chunk.check(&limits).unwrap();
            assert_eq!(value.bytes, chunk.memory_bytes());
            return Envelope::Chunk(chunk);
        }
        decode(&frame.bytes, &limits).unwrap()
    }

    fn hello(&mut self) -> ActorHello {
        match self.receive() {
            Envelope::Hello(hello) => hello,
            other => panic!("{other:?}"),
        }
    }

    fn chunk(&mut self) -> RolloutChunk {
        match self.receive() {
            Envelope::Chunk(chunk) => *chunk,
            other => panic!("{other:?}"),
        }
    }

    fn bye(&mut self) -> ActorBye {
        match self.receive() {
            Envelope::Bye(bye) => bye,
            other => panic!("{other:?}"),
        }
    }

    /// Says stop, drops what still comes, and returns the goodbye and the report.
    fn stop(mut self, version: u64) -> (ActorBye, ActorReport) {
        self.learner.publish_policy(stop_update(version)).unwrap();
        let bye = loop {
            if let Envelope::Bye(bye) = self.receive() {
                break bye;
            }
        };
        (bye, self.actor.join().unwrap().unwrap())
    }
}

/// Chunks for versions 0, 1, 2 in sync mode.
fn three_chunks(extra: &[&str]) -> Vec<RolloutChunk> {
    let mut bench = Bench::start(&config(extra), |_| {}, None);
    bench.hello();
    let chunks = (0..3)
        .map(|version| {
            bench.publish(version);
            bench.chunk()
        })
        .collect();
    bench.stop(3);
    chunks
}

#[test]
fn in_sync_mode_same_seed_gives_the_same_chunks_bit_for_bit() {
    let first = three_chunks(&[]);
    assert_eq!(first, three_chunks(&["actors.threads=2"]), "on two threads");
    assert_ne!(first, three_chunks(&["run.seed=2"]), "with another seed");
    let versions: Vec<_> = first.iter().map(|c| (c.sequence, c.policy_version)).collect();
    assert_eq!(versions, [(0, 0), (1, 1), (2, 2)]);
}

#[test]
fn a_chunk_says_what_happened() {
    let chunks = three_chunks(&[]);
    let chunk = &chunks[0];
    let (row, act) = (LANES * chunk.obs_dim, chunk.act_dim);
    assert_eq!(chunk.observations.len(), (STEPS + 1) * row);
    // The bootstrap row of a chunk is the first row of the next one.
    assert_eq!(chunk.observations[STEPS * row..], chunks[1].observations[..row]);
    assert_eq!(chunk.moments, moments_of(&chunk.observations[..STEPS * row], chunk.obs_dim));
    for cell in 0..STEPS * LANES {
        let range = cell * act..(cell + 1) * act;
        let (action, mean) = (&chunk.actions[range.clone()], &chunk.action_means[range]);
        assert_eq!(chunk.log_probs[cell], gaussian::log_prob(action, mean, &chunk.log_std));
        assert!(action.iter().zip(mean).all(|(a, m)| a != m), "exploration noise");
    }
    // Read back, a chunk names its past actions only where they were left out: these follow from the actions,
    // over the ends of episodes too.
    assert!(chunks.iter().all(|c| c.action_history.is_some()));
    // Episodes last 4 steps: within 15 steps of 3 lanes some end by the time limit.
    let truncated = chunks.iter().flat_map(|c| &c.truncated).filter(|&&t| t).count();
    let finals: usize = chunks.iter().map(|c| c.final_observations.len()).sum();
    let episodes: usize = chunks.iter().map(|c| c.episodes.len()).sum();
    let terminated = chunks.iter().flat_map(|c| &c.terminated).filter(|&&t| t).count();
    assert!(truncated > 0);
    assert_eq!((finals, episodes), (truncated, truncated + terminated));
}

#[test]
fn the_goodbye_the_ledger_and_the_report_agree() {
    let dir = tempfile::tempdir().unwrap();
    let ledger = dir.path().join("ledger");
    let path = ledger.clone();
    let config = config(&[]);
    let mut bench = Bench::start(&config, |s| s.ledger = Some(path), None);
    let hello = bench.hello();
    let mark = config.world().seal(bench.contract.hash());
    assert_eq!((hello.lanes, hello.contract_hash), (LANES, mark));
    bench.publish(7);
    assert_eq!(bench.chunk().policy_version, 7);
    let (bye, report) = bench.stop(8);
    assert_eq!((bye.sent, report.sent, read_ledger(&ledger).unwrap()), (1, 1, 1));
    assert_eq!(report.steps, (STEPS * LANES) as u64);
    assert_eq!(bye.reason, "the learner said stop");
}

#[test]
fn with_a_lead_the_actor_goes_on_with_the_old_policy_and_loses_nothing_to_back_pressure() {
    let ahead = ["actors.max_lead=2", "learner.staleness.max_lag=4"];
    let mut bench = Bench::start(&config(&ahead), |_| {}, None);
    bench.hello();
    bench.publish(0);
    // The window is one frame, so the actor has to wait for the learner with the second and third.
    let sequences: Vec<_> = (0..3).map(|_| bench.chunk().sequence).collect();
    assert_eq!(sequences, [0, 1, 2]);
    let nothing = bench.learner.recv(Duration::from_millis(50)).unwrap();
    assert!(nothing.is_none(), "the lead is two quotas, not more");
    let (bye, _) = bench.stop(1);
    assert_eq!(bye.sent, 3);
}

#[test]
fn a_saved_actor_goes_on_with_the_same_bits() {
    let whole = three_chunks(&[]);
    let mut bench = Bench::start(&config(&[]), |_| {}, None);
    bench.hello();
    bench.publish(0);
    bench.chunk();
    let saved = bench.port.take(PATIENCE).unwrap();
    bench.stop(1);
    let saved = ActorSnapshot::from_bytes(&saved.to_bytes()).unwrap();

    let mut resumed = Bench::start(&config(&[]), |s| s.incarnation = 5, Some(saved));
    resumed.hello();
    for version in 1..3 {
        resumed.publish(version);
        let mut chunk = resumed.chunk();
        let expected = &whole[version as usize];
        (chunk.incarnation, chunk.sequence) = (expected.incarnation, expected.sequence);
        assert_eq!(chunk, *expected, "version {version}");
    }
    resumed.stop(3);
}

#[test]
fn a_policy_for_another_joint_order_is_refused_with_exit_code_77() {
    let mut bench = Bench::start(&config(&[]), |_| {}, None);
    bench.hello();
    let mut other = bench.contract.clone();
    other.joint_names.swap(0, 1);
    bench.learner.publish_policy(policy(&other, 0)).unwrap();
    let bye = bench.bye();
    assert!(bye.sent == 0 && bye.reason.contains("joint"), "{bye:?}");
    let error = bench.actor.join().unwrap().unwrap_err();
    assert_eq!(error.exit_code(), ExitCode::PolicyRefused, "{error}");
}

#[test]
fn bytes_that_are_not_those_announced_are_refused() {
    let mut bench = Bench::start(&config(&[]), |_| {}, None);
    bench.hello();
    let mut update = policy(&bench.contract, 0);
    update.sha256[0] ^= 1;
    bench.learner.publish_policy(update).unwrap();
    bench.bye();
    let error = bench.actor.join().unwrap().unwrap_err();
    assert!(matches!(error, ActorError::PolicyHash { version: 0 }), "{error}");
}

#[test]
fn an_actor_without_a_policy_gives_up_in_time() {
    let short = |s: &mut ActorSettings| s.policy_timeout = Duration::from_millis(50);
    let bench = Bench::start(&config(&[]), short, None);
    let error = bench.actor.join().unwrap().unwrap_err();
    assert_eq!(error.exit_code(), ExitCode::TempFail, "{error}");
}
