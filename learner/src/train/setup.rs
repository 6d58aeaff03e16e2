//! From settings to a run that is ready to go.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use caudata_actor::{encode_transport, tracer_of, transport_of};
use caudata_config::{Config, TransportKind};
use caudata_model::RobotModel;
use caudata_proto::DecodeLimits;
use caudata_random::{Key, Purpose, Stream};
use caudata_task::PolicyContract;
use caudata_telemetry::progress::{Event, Finished, Started};
use caudata_telemetry::{Metrics, StopFlag, build_info};
use caudata_transport::{InprocHub, LearnerLink, TransportConfig, learner_link};
use tch::Device;

use super::fleet::Fleet;
use super::metrics::LearnerMetrics;
use super::report::Reporter;
use super::resume::{self, Resume};
use super::run::{Progress, Run};
use super::traces::Traces;
use super::versions::Versions;
use crate::LearnerError;
use crate::batch::{Accounting, Collector, CollectorSettings};
use crate::checkpoint::{CheckpointState, CheckpointStore, EpisodeWindow};
use crate::export::PolicyIdentity;
use crate::network::{ActorCritic, NetworkSpec};
use crate::normaliser::Moments;
use crate::ppo::{Ppo, PpoSettings};
use crate::publish::Publisher;
use crate::ranks::{RankSettings, Ranks, serve};
use crate::report::History;
use crate::warm_start::warm_start;

/// What a run needs to know besides its configuration.
pub struct TrainSettings {
    /// The configuration.
    pub config: Config,
    /// The run folder.
    pub run_dir: PathBuf,
    /// Identifier of the run.
    pub run_id: String,
    /// Whether to go on from a checkpoint.
    pub resume: Resume,
    /// `host:port` of the policy server, if policies are to go there.
    pub policy_server: Option<String>,
    /// Instead of what the configuration says.
    pub transport: Option<TransportConfig>,
    /// Where metrics are registered.
    pub metrics: Metrics,
    /// Bound address of `/metrics`, for the first event.
    pub metrics_addr: Option<String>,
    /// Where progress events go, one JSON object per line.
    pub events: Box<dyn Write + Send>,
}

/// Trains until the configured number of iterations is done or `stop` is raised; then saves everything, stops the
/// actors and accounts for every chunk.
///
/// # Errors
/// See [`LearnerError`]. What was learnt until then is saved if it can be.
pub fn train(settings: TrainSettings, stop: &StopFlag) -> Result<Finished, LearnerError> {
    let config = &settings.config;
    let robot = config.robot_path();
    let model = RobotModel::load(&robot).map_err(|source| LearnerError::Robot {
        path: robot.clone(),
        source,
    })?;
    let contract = PolicyContract::new(&model, &config.task)?;
    let network = &config.learner.network;
    let spec = NetworkSpec::new(network, contract.obs_dim(), contract.act_dim())?;
    let transport = settings
        .transport
        .clone()
        .unwrap_or_else(|| transport_of(config));
    let inproc = matches!(transport, TransportConfig::Inproc(_));

    let device = device(config.learner.device, 0)?;
    let net = ActorCritic::new(spec, config.run.seed, device);
    let store = CheckpointStore::new(
        settings.run_dir.join("checkpoints"),
        config.learner.keep_checkpoints as usize,
    );
    let contract_hash = contract.hash_hex();
    let loaded = resume::load(
        &settings.resume,
        &store,
        net.layout(),
        config,
        &contract_hash,
    )?;
    let (resumed_from, state) = loaded.unzip();
    // Of the run's beginning: the same weights give the same bytes, whatever is checked out by now.
    let training_commit = match &state {
        Some(state) => state.saved.training_commit.clone(),
        None => build_info().commit_word(),
    };

    let moments = match (&state, config.warm_start_path()) {
        (None, Some(path)) => {
            let least_std = config.learner.warm_start.least_std;
            Some(warm_start(&net, &path, least_std, &contract)?)
        }
        _ => None,
    };
    let ppo = PpoSettings::new(config, &model, &contract)?;
    let ranks = RankSettings::new(config, &settings.run_id, contract_hash);
    let threads = threads(config, inproc);
    let mut ppo = match ranks.count {
        0 | 1 => Ppo::new(net, ppo, threads)?,
        _ => {
            let ranks = Ranks::gather(&ranks, &net, threads, stop)?;
            Ppo::with_reduction(net, ppo, Box::new(ranks))
        }
    };
    let (mut progress, snapshots) = restore(&mut ppo, state, config, contract.obs_dim())?;
    if let Some(moments) = moments {
        progress.0.moments = moments;
    }
    if settings.resume != Resume::No {
        for ledger in caudata_actor::ledgers_in(&ledger_folder(&settings.run_dir)) {
            let actor = (ledger.actor_id, ledger.incarnation);
            progress.1.rolled_back(actor, ledger.sent);
        }
    }
    let collector = Collector::new(
        collector_settings(config, &settings.run_id, &contract),
        progress.1,
    );
    let next_incarnations = (0..config.actors.count)
        .map(|id| collector.accounting().next_incarnation(id))
        .collect();

    let model = Arc::new(model);
    let publisher = settings
        .policy_server
        .as_deref()
        .map(|address| {
            let stream = config.policy_server.stream_of(&settings.run_id);
            Publisher::start_with(address, stream, config.cluster.certificates())
        })
        .transpose()?;
    let tracer = tracer_of(
        config,
        "caudata-learner",
        "learner".to_owned(),
        &settings.run_id,
        &settings.metrics,
    )
    .map_err(|error| LearnerError::setting(error.to_string()))?;
    let hub = match &transport {
        TransportConfig::Inproc(inproc) => Some(InprocHub::new(inproc)?),
        _ => None,
    };
    let link: Box<dyn LearnerLink> = match &hub {
        Some(hub) => hub.learner()?,
        None => learner_link(&transport, &settings.run_id)?,
    };
    let fleet = hub
        .as_ref()
        .map(|hub| {
            let accounting = collector.accounting();
            Fleet::start(&settings, &model, hub, accounting, &snapshots, &tracer)
        })
        .transpose()?;

    // The actors of this process end with it, and no version that only they have seen is seen again.
    let versions = match &fleet {
        Some(_) => None,
        None => Some(Versions::open(&settings.run_dir, &settings.run_id)?),
    };
    let metrics = LearnerMetrics::register(&settings.metrics);
    let mut reporter = Reporter::new(&settings.run_dir, settings.events, metrics);
    reporter.event(&Event::Started(Started {
        run_id: settings.run_id.clone(),
        transport: if inproc {
            TransportKind::Inproc.name().to_owned()
        } else {
            encode_transport(&link.actor_config())
        },
        metrics: settings.metrics_addr,
        iteration: progress.0.iteration,
        iterations: config.run.iterations,
        resumed_from,
        device: device_name(device),
        next_incarnations,
    }));
    let identity = PolicyIdentity {
        contract,
        run_id: settings.run_id,
        training_commit,
        config_hash: config.hash_hex(),
        seed: config.run.seed,
    };
    let run = Run {
        config,
        run_dir: settings.run_dir,
        stop,
        identity,
        store,
        ppo,
        collector,
        link,
        fleet,
        publisher,
        reporter,
        progress: progress.0,
        traces: Traces::new(tracer),
        versions,
        began: Instant::now(),
    };
    run.train()
}

/// Learns as another rank than 0: works on shards for the learner of run `run_id` until that ends, or `stop` is raised.
///
/// # Errors
/// See [`LearnerError`]: the configuration does not fit the robot or the learner's, or rank 0 is lost.
pub fn train_as_rank(
    config: &Config,
    run_id: &str,
    rank: u32,
    stop: &StopFlag,
) -> Result<(), LearnerError> {
    let robot = config.robot_path();
    let model = RobotModel::load(&robot).map_err(|source| LearnerError::Robot {
        path: robot.clone(),
        source,
    })?;
    let contract = PolicyContract::new(&model, &config.task)?;
    let spec = NetworkSpec::new(
        &config.learner.network,
        contract.obs_dim(),
        contract.act_dim(),
    )?;
    let device = device(config.learner.device, rank)?;
    let net = ActorCritic::new(spec, config.run.seed, device);
    let settings = RankSettings::new(config, run_id, contract.hash_hex());
    let threads = config.learner.threads as usize;
    serve(rank, &settings, &net, threads, stop)
}

/// Where the actors of a run keep their ledgers.
pub(super) fn ledger_folder(run_dir: &Path) -> PathBuf {
    run_dir.join("ledgers")
}

/// Ranks of one host take its GPUs in turn.
fn device(wanted: caudata_config::Device, rank: u32) -> Result<Device, LearnerError> {
    use caudata_config::Device as Wanted;
    let there = tch::Cuda::is_available();
    let gpus = usize::try_from(tch::Cuda::device_count()).unwrap_or(0);
    let gpu = Device::Cuda(rank as usize % gpus.max(1));
    match wanted {
        Wanted::Cpu => Ok(Device::Cpu),
        Wanted::Auto if !there => Ok(Device::Cpu),
        Wanted::Cuda if !there => Err(LearnerError::NoCuda),
        Wanted::Auto | Wanted::Cuda => Ok(gpu),
    }
}

fn device_name(device: Device) -> String {
    match device {
        Device::Cuda(index) => format!("cuda:{index}"),
        _ => "cpu".to_owned(),
    }
}

/// Where actors and learner take turns in one process, the actors' threads are idle during an update; results do not
/// depend on the number.
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
) -> CollectorSettings {
    let actors = &config.actors;
    CollectorSettings {
        run_id: run_id.to_owned(),
        contract_hash: contract.hash(),
        steps: actors.chunk_steps as usize,
        lanes: actors.lanes as usize,
        obs_dim: contract.obs_dim(),
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

type Restored = ((Progress, Accounting), Vec<caudata_actor::ActorSnapshot>);

/// The start of a run, or where `state` left off.
fn restore(
    ppo: &mut Ppo,
    state: Option<CheckpointState>,
    config: &Config,
    obs_dim: usize,
) -> Result<Restored, LearnerError> {
    let Some(state) = state else {
        let key = Key {
            seed: config.run.seed,
            actor: 0,
            env: 0,
            episode: 0,
        };
        let progress = Progress {
            iteration: 0,
            version_offset: 0,
            steps_total: 0,
            wall_s: 0.0,
            moments: Moments::new(obs_dim),
            order: Stream::new(key, Purpose::Minibatch),
            episodes: EpisodeWindow::default(),
            step_rewards: Vec::new(),
            returns: Vec::new(),
            history: History::default(),
        };
        return Ok(((progress, Accounting::default()), Vec::new()));
    };
    ppo.net().copy_from_slice(&state.parameters)?;
    ppo.adam_mut()
        .restore(&state.adam_m, &state.adam_v, state.saved.adam_steps)?;
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
