//! `caudata-actor`: one actor as a process. Started by `caudata train`, by hand, or by a cluster's scheduler.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use caudata_actor::{
    ActorError, ActorMetrics, ActorSettings, actor_key, build_env, decode_transport, run,
    transport_config,
};
use caudata_config::ConfigArgs;
use caudata_model::RobotModel;
use caudata_telemetry::{
    ExitCode, Failure, FailureExt, LogArgs, Metrics, MetricsServer, Process, parse_args,
};
use clap::Parser;

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
    /// How many times this actor was started before
    #[arg(long, default_value_t = 0)]
    incarnation: u64,
    /// How to reach the learner, as its `started` event has it (JSON); otherwise `[transport]` says
    #[arg(long, value_name = "JSON")]
    transport: Option<String>,
    /// Robot file, instead of the configuration's
    #[arg(long, value_name = "FILE.robot.toml")]
    robot: Option<PathBuf>,
    /// File in which the count of sent chunks is kept
    #[arg(long, value_name = "FILE")]
    ledger: Option<PathBuf>,
    /// Serve /metrics and /healthz here (port 0: any free port)
    #[arg(long, value_name = "ADDR")]
    metrics_addr: Option<SocketAddr>,
    #[command(flatten)]
    log: LogArgs,
}

fn main() -> std::process::ExitCode {
    let args: Args = parse_args();
    Process::run("caudata-actor", &args.log, |process| act(&args, process))
}

fn act(args: &Args, process: &Process) -> Result<(), Failure> {
    let mut config = args.config.load().or_exit(ExitCode::BadConfig)?;
    if let Some(robot) = &args.robot {
        config.robot.clone_from(robot);
    }
    let transport = match &args.transport {
        None => transport_config(&config.transport),
        Some(text) => decode_transport(text).or_exit_with(
            ExitCode::BadConfig,
            || "--transport is not what a learner prints",
        )?,
    };
    let robot_path = config.robot_path();
    let model = RobotModel::load(&robot_path).or_exit_with(ExitCode::BadInput, || {
        format!("robot file {}", robot_path.display())
    })?;

    let registry = Metrics::new();
    let metrics = ActorMetrics::register(&registry);
    let server = args
        .metrics_addr
        .map(|addr| MetricsServer::start(addr, registry, process.stop.clone()))
        .transpose()?;

    let mut settings =
        ActorSettings::from_config(&config, &args.run_id, args.actor_id, args.incarnation);
    settings.ledger.clone_from(&args.ledger);
    let key = actor_key(args.actor_id, args.incarnation);
    let env = build_env(&config, Arc::new(model), key).map_err(ActorError::into_failure)?;
    let link = caudata_transport::actor_link(&transport, &args.run_id, args.actor_id)
        .map_err(|error| ActorError::from(error).into_failure())?;
    let report = run(&settings, env, link, &process.stop, &metrics, None, None);
    drop(server);
    report.map(|_| ()).map_err(ActorError::into_failure)
}
