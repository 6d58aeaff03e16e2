//! `caudata-actor`: one actor as a process. Started by `caudata train`, by hand, or by a cluster's scheduler.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, SystemTime};

use caudata_actor::{
    ActorError, ActorMetrics, ActorSettings, PulsedLink, actor_key, build_env, clock_incarnation,
    decode_transport, host_name, named_actor_id, run, say_alive, tracer_of, transport_of,
    with_certificates,
};
use caudata_config::ConfigArgs;
use caudata_model::RobotModel;
use caudata_telemetry::{
    ExitCode, Failure, FailureExt, LogArgs, Metrics, MetricsServer, Process, Pulse, parse_args,
};
use clap::Parser;

/// What this process is in a run: which certificates are its own.
const ROLE: &str = "actor";

/// Steps environments with the newest policy and streams what happened to the learner.
#[derive(Debug, Parser)]
#[command(version, about)]
struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    /// The run to take part in
    #[arg(long)]
    run_id: String,
    /// Number of this actor within the run, from 0
    #[arg(long, default_value_t = 0)]
    actor_id: u32,
    /// Instead of a number: a name that no other actor of the run has, for instance a pod's; `@host` takes
    /// this host's
    #[arg(long, value_name = "NAME", env = "CAUDATA_ACTOR_NAME", conflicts_with = "actor_id")]
    actor_name: Option<String>,
    /// How many times this actor was started before; otherwise 0, or with a name the time of the clock
    #[arg(long)]
    incarnation: Option<u64>,
    /// How to reach the learner, as its `started` event has it (JSON); otherwise `[transport]` says
    #[arg(long, value_name = "JSON")]
    transport: Option<String>,
    /// File in which the count of sent chunks is kept
    #[arg(long, value_name = "FILE")]
    ledger: Option<PathBuf>,
    /// Serve /metrics and /healthz here (port 0: any free port)
    #[arg(long, value_name = "ADDR")]
    metrics_addr: Option<SocketAddr>,
    /// Say `alive` on standard output twice a second while the loop runs, for the supervisor that watches
    #[arg(long)]
    heartbeat: bool,
    #[command(flatten)]
    log: LogArgs,
}

fn main() -> std::process::ExitCode {
    let args: Args = parse_args();
    Process::run("caudata-actor", &args.log, |process| act(&args, process))
}

fn act(args: &Args, process: &Process) -> Result<(), Failure> {
    let config = args.config.load().or_exit(ExitCode::BadConfig)?;
    let transport = match &args.transport {
        None => transport_of(&config, ROLE),
        Some(text) => {
            let told = decode_transport(text)
                .or_exit_with(ExitCode::BadConfig, || "--transport is not what a learner prints")?;
            with_certificates(told, &config, ROLE)
        }
    };
    let (actor_id, incarnation) = identity(args)?;
    let count = config.actors.count;
    if config.actors.lockstep && actor_id >= count {
        let message = format!(
            "actor {actor_id}: in lockstep actors are numbered from 0 to actors.count − 1 = {}",
            count - 1
        );
        return Err(Failure::message(ExitCode::BadConfig, message)
            .hint("give --actor-id, or set actors.lockstep=false"));
    }
    let robot_path = config.robot_path();
    let model = RobotModel::load(&robot_path).or_exit_with(ExitCode::BadInput, || "robot file")?;

    let registry = Metrics::new();
    let metrics = ActorMetrics::register(&registry);
    let instance = format!("actor {actor_id}, incarnation {incarnation}");
    let traces = tracer_of(&config, (ROLE, "caudata-actor"), instance, &args.run_id, &registry)
        .or_exit(ExitCode::BadConfig)?;
    let pulse = Pulse::new();
    let patience = Duration::from_secs_f64(config.cluster.hang_timeout_s);
    let stop = &process.stop;
    let serve = |addr| {
        MetricsServer::start_with_pulse(addr, registry, stop.clone(), pulse.clone(), patience)
    };
    let server = args.metrics_addr.map(serve).transpose()?;
    let joined = Arc::new(AtomicBool::new(false));
    if args.heartbeat {
        let (pulse, joined, stop) = (pulse.clone(), Arc::clone(&joined), stop.clone());
        std::thread::Builder::new()
            .name("heartbeat".into())
            .spawn(move || say_alive(&pulse, &joined, &stop, std::io::stdout()))
            .or_exit(ExitCode::OsResource)?;
    }

    let mut settings = ActorSettings::from_config(&config, &args.run_id, actor_id, incarnation);
    settings.ledger.clone_from(&args.ledger);
    settings.traces = traces;
    let key = actor_key(actor_id, incarnation);
    let env = build_env(&config, Arc::new(model), key).map_err(ActorError::into_failure)?;
    let link = caudata_transport::actor_link(&transport, &args.run_id, actor_id)
        .map_err(|error| ActorError::from(error).into_failure())?;
    let link = Box::new(PulsedLink::new(link, pulse, joined));
    let report = run(&settings, env, link, &process.stop, &metrics, None, None);
    drop(server);
    report.map(|_| ()).map_err(ActorError::into_failure)
}

/// Number and incarnation, as told or out of name and clock.
fn identity(args: &Args) -> Result<(u32, u64), Failure> {
    let Some(name) = &args.actor_name else {
        return Ok((args.actor_id, args.incarnation.unwrap_or(0)));
    };
    let name = match name.as_str() {
        "@host" => {
            host_name().or_exit_with(ExitCode::OsResource, || "cannot read the host's name")?
        }
        name => name.to_owned(),
    };
    let incarnation = args.incarnation.unwrap_or_else(|| clock_incarnation(SystemTime::now()));
    let id = named_actor_id(&name);
    tracing::info!(name, id, incarnation, "this actor");
    Ok((id, incarnation))
}
