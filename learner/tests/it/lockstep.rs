//! Lockstep: the weights do not show how many actors collected, nor over which transport.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::common::{Listener, config, run};
use caudata_actor::{ActorMetrics, ActorSettings, actor_key, build_env, decode_transport};
use caudata_config::Config;
use caudata_learner::train::Resume;
use caudata_model::RobotModel;
use caudata_telemetry::progress::{Event, Finished};
use caudata_telemetry::{Metrics, StopFlag};
use caudata_transport::{TransportConfig, actor_link};

/// Bytes by name.
type Tensors = BTreeMap<String, Vec<u8>>;

/// Lanes of all actors together.
const LANES: u32 = 16;
const ITERATIONS: u64 = 8;
/// Longest wait for a learner that starts.
const PATIENCE: Duration = Duration::from_secs(60);

fn lockstep(actors: u32, kind: &str, lead: u32) -> Config {
    let overrides = [
        format!("transport.kind={kind}"),
        format!("actors.count={actors}"),
        format!("actors.lanes={}", LANES / actors),
        format!("actors.max_lead={lead}"),
        "actors.lockstep=true".to_owned(),
        // What only the value function sees travels with the rest.
        "task.critic.sees=[\"velocity\", \"foot_force\", \"friction\"]".to_owned(),
        // Several episodes end by the time limit within the run, in other lanes at other times.
        "task.episode_steps=10".to_owned(),
        // Nobody shall be given up on a busy machine: the batch would be a smaller one.
        "learner.batch_timeout_s=60".to_owned(),
    ];
    let overrides: Vec<&str> = overrides.iter().map(String::as_str).collect();
    config(ITERATIONS, &overrides)
}

/// The actors of a run between processes, here as threads with links of their own.
fn actors(config: &Config, listener: &Listener) -> Vec<JoinHandle<()>> {
    let deadline = Instant::now() + PATIENCE;
    let transport: TransportConfig = loop {
        if let Some(Event::Started(started)) = listener.events().into_iter().next() {
            break decode_transport(&started.transport).unwrap();
        }
        assert!(Instant::now() < deadline, "the learner does not start");
        std::thread::sleep(Duration::from_millis(10));
    };
    (0..config.actors.count)
        .map(|id| {
            let (config, transport) = (config.clone(), transport.clone());
            std::thread::spawn(move || {
                let settings = ActorSettings::from_config(&config, "test", id, 0);
                let model = Arc::new(RobotModel::load(&config.robot).unwrap());
                let env = build_env(&config, model, actor_key(id, 0)).unwrap();
                let link = actor_link(&transport, "test", id).unwrap();
                let metrics = ActorMetrics::register(&Metrics::new());
                let stop = StopFlag::new();
                caudata_actor::run(&settings, env, link, &stop, &metrics, None, None).unwrap();
            })
        })
        .collect()
}

/// The last checkpoint's tensors (weights, optimiser, normaliser), and how the run ended.
fn train(config: Config) -> (Tensors, Finished, Vec<u64>) {
    let dir = tempfile::tempdir().unwrap();
    let listener = Listener::default();
    let inproc = config.transport.kind == caudata_config::TransportKind::Inproc;
    let learner = {
        let (folder, config, listener) = (dir.path().to_owned(), config.clone(), listener.clone());
        std::thread::spawn(move || run(&folder, config, Resume::No, &listener, None).unwrap())
    };
    let threads = match inproc {
        true => Vec::new(),
        false => actors(&config, &listener),
    };
    let finished = learner.join().unwrap();
    for thread in threads {
        thread.join().unwrap();
    }
    let lags = listener
        .events()
        .into_iter()
        .filter_map(|event| match event {
            Event::Iteration(iteration) => {
                // Every chunk of a batch is equally old.
                assert_eq!(iteration.lag_mean, iteration.lag_max as f64);
                Some(iteration.lag_max)
            }
            _ => None,
        })
        .collect();
    (state(dir.path()), finished, lags)
}

/// The tensors of the last checkpoint by name. Without the sums of returns: episodes are added up in the
/// order in which they come, which tells how many actors there are in the last digits of what is printed.
fn state(folder: &Path) -> Tensors {
    let name = format!("checkpoints/iter_{ITERATIONS:06}/state.safetensors");
    let bytes = std::fs::read(folder.join(name)).unwrap();
    let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let tensors = tensors.tensors().into_iter();
    tensors
        .filter(|(name, _)| name != "returns")
        .map(|(name, tensor)| (name, tensor.data().to_vec()))
        .collect()
}

/// The names of tensors that differ.
fn differing(a: &Tensors, b: &Tensors) -> Vec<String> {
    assert!(a.len() > 10 && a.keys().eq(b.keys()));
    let differ = |name: &&String| a[*name] != b[*name];
    a.keys().filter(differ).cloned().collect()
}

#[test]
fn any_number_of_actors_gives_the_same_weights_in_process_and_over_the_network() {
    let (one, finished, lags) = train(lockstep(1, "inproc", 1));
    assert_eq!(finished.accounting.accepted, ITERATIONS);
    // Exactly one version behind, once there is one to be behind.
    assert_eq!(lags, [0, 1, 1, 1, 1, 1, 1, 1]);
    for (actors, kind) in
        [(2, "inproc"), (8, "inproc"), (1, "zenoh"), (2, "zenoh"), (8, "zenoh"), (2, "iceoryx2")]
    {
        let (state, finished, lags_here) = train(lockstep(actors, kind, 1));
        assert_eq!(differing(&state, &one), [""; 0], "{actors} actors over {kind}");
        assert_eq!(lags_here, lags, "{actors} actors over {kind}");
        let accepted = ITERATIONS * u64::from(actors);
        assert_eq!(finished.accounting.accepted, accepted);
    }
}

#[test]
fn the_lag_is_what_is_asked_for() {
    let mut seen = Vec::new();
    for (lead, expected) in
        [(0, [0; 8]), (2, [0, 1, 2, 2, 2, 2, 2, 2]), (4, [0, 1, 2, 3, 4, 4, 4, 4])]
    {
        let (state, _, lags) = train(lockstep(2, "inproc", lead));
        assert_eq!(lags, expected);
        let (other, _, _) = train(lockstep(4, "inproc", lead));
        assert_eq!(differing(&state, &other), [""; 0], "lead {lead}");
        seen.push(state);
    }
    // And it matters: otherwise the test above would compare nothing.
    assert!(differing(&seen[0], &seen[1]).len() > 10);
    assert!(differing(&seen[1], &seen[2]).len() > 10);
}
