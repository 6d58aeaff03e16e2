//! From settings to a run that is ready to go.

use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_actor::{ActorSnapshot, LEARNER_LOCK, encode_transport, tracer_of, transport_of};
use caudata_config::{Config, TransportKind};
use caudata_durable::{Owner, OwnerError};
use caudata_proto::DecodeLimits;
use caudata_random::{Key, Purpose, Stream};
use caudata_task::{Critic, PolicyContract};
use caudata_telemetry::progress::{Event, Finished, Started};
use caudata_telemetry::traces::Tracer;
use caudata_telemetry::{DRAIN_DEADLINE, StopFlag, build_info};
use caudata_transport::{InprocHub, TransportConfig, learner_link};
use tch::Device;

use super::fleet::Fleet;
use super::metrics::LearnerMetrics;
use super::report::Reporter;
use super::resume;
use super::run::{Progress, Run};
use super::settings::{Resume, TrainSettings, ledger_folder, torn_ledger};
use super::traces::Traces;
use super::tuning::Tuning;
use super::versions::Versions;
use crate::LearnerError;
use crate::batch::{Accounting, Collector, CollectorSettings};
use crate::checkpoint::{CheckpointState, CheckpointStore, EpisodeWindow};
use crate::export::PolicyIdentity;
use crate::network::ActorCritic;
use crate::normaliser::Moments;
use crate::ppo::{Ppo, PpoSettings};
use crate::publish::Publisher;
use crate::report::History;
use crate::task::Task;
use crate::teacher::Teacher;
use crate::warm_start::warm_start;

/// What this process is in a run: which certificates are its own.
const ROLE: &str = "learner";
/// How long another learner of this folder may take to end: it has [`DRAIN_DEADLINE`] to save.
const OWNER_PATIENCE: Duration = Duration::from_secs(15).saturating_add(DRAIN_DEADLINE);
/// Pause between two looks at it.
const OWNER_PAUSE: Duration = Duration::from_millis(100);

/// Trains until the configured number of iterations is done or `stop` is raised; then saves everything, stops
/// the actors and accounts for every chunk.
///
/// # Errors
/// See [`LearnerError`]. What was learnt until then is saved if it can be.
pub fn train(settings: TrainSettings, stop: &StopFlag) -> Result<Finished, LearnerError> {
    let _owner = own(&settings, stop)?;
    let config = &settings.config;
    let task = Task::new(config)?;
    let (model, contract) = (task.model, task.contract);
    let transport = settings.transport.clone().unwrap_or_else(|| transport_of(config, ROLE));
    let inproc = matches!(transport, TransportConfig::Inproc(_));
    let device = device(config.learner.device)?;
    let net = ActorCritic::new(task.networks, config.run.seed, device);
    let mut start = Start::new(&settings, &contract, net, inproc)?;
    if let Some(path) = config.teacher_path() {
        start.ppo.learn_from(Teacher::load(&path, &contract, &task.critic)?);
    }
    let collector = Collector::new(
        collector_settings(config, &settings.run_id, &contract, &task.critic),
        start.accounting,
    );

    let (publisher, tracer) = outside(&settings)?;
    let accounting = collector.accounting();
    let (link, fleet) = match &transport {
        TransportConfig::Inproc(inproc) => {
            let (hub, saved) = (InprocHub::new(inproc)?, &start.snapshots);
            let link = hub.learner()?;
            let model = Arc::new(model);
            let tasks = start.tuning.retunes();
            let fleet = Fleet::start(&settings, &model, &hub, accounting, saved, &tracer, &tasks)?;
            (link, Some(fleet))
        }
        _ => (learner_link(&transport, &settings.run_id)?, None),
    };
    // The actors of this process end with it, and no version that only they have seen is seen again.
    let versions = match &fleet {
        Some(_) => None,
        None => Some(Versions::open(&settings.run_dir, &settings.run_id)?),
    };
    let metrics = LearnerMetrics::register(&settings.metrics);
    let mut reporter = Reporter::new(&settings.run_dir, settings.events, metrics, settings.pulse);
    reporter.settings(config);
    let incarnations = (0..config.actors.count).map(|id| accounting.next_incarnation(id));
    reporter.event(&Event::Started(Started {
        run_id: settings.run_id.clone(),
        transport: match inproc {
            true => TransportKind::Inproc.name().to_owned(),
            false => encode_transport(&link.actor_config()),
        },
        metrics: settings.metrics_addr,
        iteration: start.progress.iteration,
        iterations: config.run.iterations,
        resumed_from: start.resumed_from,
        device: device_name(device),
        next_incarnations: incarnations.collect(),
    }));
    Run {
        term_names: config.task.reward.term_names(),
        config,
        run_dir: settings.run_dir,
        stop,
        identity: PolicyIdentity {
            contract,
            run_id: settings.run_id,
            training_commit: start.training_commit,
            config_hash: config.hash_hex(),
            seed: config.run.seed,
        },
        store: start.store,
        ppo: start.ppo,
        collector,
        link,
        fleet,
        publisher,
        reporter,
        progress: start.progress,
        traces: Traces::new(tracer),
        versions,
        tuning: start.tuning,
        began: Instant::now(),
    }
    .train()
}

/// What leads out of a run besides the actors: to the policy server and to a collector of traces, where there
/// are any.
fn outside(settings: &TrainSettings) -> Result<(Option<Publisher>, Tracer), LearnerError> {
    let config = &settings.config;
    let publish = |address: &String| {
        let stream = config.policy_server.stream_of(&settings.run_id);
        Publisher::start(address, stream, config.cluster.certificates(ROLE).as_deref())
    };
    let publisher = settings.policy_server.as_ref().map(publish).transpose()?;
    let tracer = tracer_of(
        config,
        (ROLE, "caudata-learner"),
        ROLE.to_owned(),
        &settings.run_id,
        &settings.metrics,
    );
    let tracer = tracer.map_err(|error| LearnerError::setting(error.to_string()))?;
    Ok((publisher, tracer))
}

/// Makes this process the one learner of the run folder, on whatever transport: one that is still ending is
/// waited for.
fn own(settings: &TrainSettings, stop: &StopFlag) -> Result<Owner, LearnerError> {
    let path = settings.run_dir.join(LEARNER_LOCK);
    let mut said = false;
    let wait = |taken: &OwnerError| {
        settings.pulse.beat();
        if !std::mem::replace(&mut said, true) {
            tracing::warn!("{taken}; waiting for its end");
        }
        !stop.wait(OWNER_PAUSE)
    };
    Ok(Owner::take(&path, OWNER_PATIENCE, wait)?)
}

/// Where a run begins or goes on.
struct Start {
    ppo: Ppo,
    progress: Progress,
    accounting: Accounting,
    snapshots: Vec<ActorSnapshot>,
    store: CheckpointStore,
    resumed_from: Option<String>,
    training_commit: String,
    tuning: Tuning,
}

impl Start {
    fn new(
        settings: &TrainSettings,
        contract: &PolicyContract,
        net: ActorCritic,
        inproc: bool,
    ) -> Result<Self, LearnerError> {
        let config = &settings.config;
        let run_dir = &settings.run_dir;
        let keep = config.learner.keep_checkpoints as usize;
        let store = CheckpointStore::new(run_dir.join("checkpoints"), keep);
        let loaded = resume::load(settings, &store, net.layout(), &contract.hash_hex())?;
        let (resumed_from, state) = loaded.unzip();
        // Of the run's beginning: the same weights give the same bytes, whatever is checked out by now.
        let training_commit = match &state {
            Some(state) => state.saved.training_commit.clone(),
            None => build_info().commit_word(),
        };
        let moments = match (&state, config.warm_start_path()) {
            (None, Some(path)) => {
                let least_std = config.learner.warm_start.least_std;
                Some(warm_start(&net, &path, least_std, contract)?)
            }
            _ => None,
        };
        let done = state.as_ref().map_or(0, |state| state.saved.iteration);
        let tuning = Tuning::open(settings, done, inproc)?;
        let hyper = PpoSettings::new(tuning.now());
        let mut ppo = Ppo::new(net, hyper, threads(config, inproc))?;
        ppo.beat(settings.pulse.clone());
        let ((mut progress, mut accounting), snapshots) = restore(&mut ppo, state, config)?;
        if let Some(moments) = moments {
            progress.moments = moments;
        }
        if settings.resume != Resume::No {
            for ledger in caudata_actor::ledgers_in(&ledger_folder(run_dir)) {
                let actor = (ledger.actor_id, ledger.incarnation);
                if ledger.sent.is_none() {
                    tracing::warn!("{}", torn_ledger(actor));
                }
                accounting.rolled_back(actor, ledger.sent.unwrap_or(0));
            }
        }
        Ok(Self {
            ppo,
            progress,
            accounting,
            snapshots,
            store,
            resumed_from,
            training_commit,
            tuning,
        })
    }
}

fn device(wanted: caudata_config::Device) -> Result<Device, LearnerError> {
    use caudata_config::Device as Wanted;
    match wanted {
        Wanted::Cpu => Ok(Device::Cpu),
        Wanted::Auto => Ok(Device::cuda_if_available()),
        Wanted::Cuda if !tch::Cuda::is_available() => Err(LearnerError::NoCuda),
        Wanted::Cuda => Ok(Device::Cuda(0)),
    }
}

fn device_name(device: Device) -> String {
    match device {
        Device::Cuda(index) => format!("cuda:{index}"),
        _ => "cpu".to_owned(),
    }
}

/// Where actors and learner take turns in one process, the actors' threads are idle during an update; results
/// do not depend on the number.
fn threads(config: &Config, inproc: bool) -> usize {
    let own = config.learner.threads as usize;
    if !inproc || config.actors.max_lead > 0 {
        return own;
    }
    let of_actors = config.actors.count as usize * config.actors.threads as usize;
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    own.max(of_actors.min(cores))
}

fn collector_settings(
    config: &Config,
    run_id: &str,
    contract: &PolicyContract,
    critic: &Critic,
) -> CollectorSettings {
    let actors = &config.actors;
    CollectorSettings {
        run_id: run_id.to_owned(),
        contract_hash: config.world().seal(contract.hash()),
        steps: actors.chunk_steps as usize,
        lanes: actors.lanes as usize,
        obs_dim: contract.obs_dim() + critic.dim(),
        act_dim: contract.act_dim(),
        actors: actors.count,
        chunks_per_version: actors.chunks_per_version,
        max_lead: actors.max_lead,
        lockstep: actors.lockstep,
        max_lag: config.learner.staleness.max_lag,
        min_share: config.learner.min_batch_share,
        limits: DecodeLimits {
            max_frame_bytes: config.transport.max_frame_bytes as usize,
            ..DecodeLimits::default()
        },
    }
}

type Restored = ((Progress, Accounting), Vec<ActorSnapshot>);

/// The start of a run, or where `state` left off.
fn restore(
    ppo: &mut Ppo,
    state: Option<CheckpointState>,
    config: &Config,
) -> Result<Restored, LearnerError> {
    let Some(state) = state else {
        let key = Key::for_run(config.run.seed);
        let progress = Progress {
            iteration: 0,
            version_offset: 0,
            steps_total: 0,
            wall_s: 0.0,
            moments: Moments::new(ppo.net().spec().seen_dim()),
            order: Stream::new(key, Purpose::Minibatch),
            episodes: EpisodeWindow::default(),
            step_rewards: Vec::new(),
            returns: Vec::new(),
            history: History::default(),
        };
        return Ok(((progress, Accounting::default()), Vec::new()));
    };
    ppo.net().copy_from_slice(&state.parameters)?;
    ppo.adam_mut().restore(&state.adam_m, &state.adam_v, state.saved.adam_steps)?;
    ppo.set_learning_rate(state.learning_rate);
    let progress = Progress {
        iteration: state.saved.iteration,
        version_offset: state.saved.version_offset,
        steps_total: state.saved.steps_total,
        wall_s: state.saved.wall_s,
        moments: state.moments,
        order: state.saved.minibatch_order,
        episodes: state.saved.episodes,
        step_rewards: state.step_rewards,
        returns: state.returns,
        history: state.history,
    };
    Ok(((progress, state.saved.accounting), state.actors))
}
