//! `caudata-learner`: PPO on libtorch as a process. Started by `caudata train`, by hand, or by a cluster's
//! scheduler.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use caudata_actor::{decode_transport, say_alive};
use caudata_config::{ConfigArgs, TransportKind};
use caudata_learner::LearnerError;
use caudata_learner::train::{Resume, TrainSettings, train};
use caudata_telemetry::{
    ExitCode, Failure, FailureExt, LogArgs, Metrics, MetricsServer, Process, Pulse, StopFlag,
    parse_args,
};
use clap::Parser;

/// Learns from the rollouts of actors and hands out policies. Progress goes to standard output, one JSON
/// object per line.
#[derive(Debug, Parser)]
#[command(version, about)]
struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    /// Folder of the run: checkpoints, policy, curves, TensorBoard files
    #[arg(long, value_name = "DIR")]
    run_dir: PathBuf,
    /// Identifier of the run, the same for learner and actors
    #[arg(long, value_name = "ID")]
    run_id: String,
    /// Go on from the newest checkpoint of the run folder
    #[arg(long)]
    resume: bool,
    /// Go on from this checkpoint, for instance iter_000100
    #[arg(long, value_name = "NAME", conflicts_with = "resume")]
    resume_from: Option<String>,
    /// Policy server to publish to
    #[arg(long, value_name = "HOST:PORT")]
    policy_server: Option<String>,
    /// Transport to the actors (JSON), instead of what [transport] says
    #[arg(long, value_name = "JSON", conflicts_with = "inproc")]
    transport: Option<String>,
    /// Run the actors as threads of this process
    #[arg(long)]
    inproc: bool,
    /// Serve /metrics and /healthz here (port 0: any free port), instead of where [telemetry] says
    #[arg(long, value_name = "ADDR")]
    metrics_addr: Option<SocketAddr>,
    /// Say `alive` on standard output, between the events, twice a second while the run makes progress
    #[arg(long)]
    heartbeat: bool,
    #[command(flatten)]
    log: LogArgs,
}

fn main() -> std::process::ExitCode {
    let args: Args = parse_args();
    Process::run("caudata-learner", &args.log, |process| learn(&args, process))
}

fn learn(args: &Args, process: &Process) -> Result<(), Failure> {
    let mut config = args.config.load().or_exit(ExitCode::BadConfig)?;
    let run_dir = args.run_dir.clone();
    if args.inproc {
        config.transport.kind = TransportKind::Inproc;
    }
    let transport = args
        .transport
        .as_deref()
        .map(decode_transport)
        .transpose()
        .or_exit_with(ExitCode::BadConfig, || "--transport is not a transport configuration")?;
    std::fs::create_dir_all(&run_dir)
        .or_exit_with(ExitCode::CannotCreate, || format!("cannot make {}", run_dir.display()))?;

    let metrics = Metrics::new();
    let pulse = Pulse::new();
    let patience = Duration::from_secs_f64(config.cluster.hang_timeout_s);
    let configured = config.telemetry.metrics.then_some(config.telemetry.metrics_addr);
    let server = args
        .metrics_addr
        .or(configured)
        .map(|addr| {
            let (metrics, stop) = (metrics.clone(), process.stop.clone());
            MetricsServer::start_with_pulse(addr, metrics, stop, pulse.clone(), patience)
        })
        .transpose()?;
    if args.heartbeat {
        // Not until a stop is asked for: the end of a run makes progress, too.
        let (pulse, until) = (pulse.clone(), StopFlag::new());
        std::thread::Builder::new()
            .name("heartbeat".into())
            .spawn(move || say_alive(&pulse, &AtomicBool::new(false), &until, std::io::stdout()))
            .or_exit(ExitCode::OsResource)?;
    }
    let resume = match &args.resume_from {
        Some(name) => Resume::Named(name.clone()),
        None if args.resume => Resume::Latest,
        None => Resume::No,
    };
    let settings = TrainSettings {
        config,
        run_dir,
        run_id: args.run_id.clone(),
        resume,
        policy_server: args.policy_server.clone(),
        transport,
        metrics,
        metrics_addr: server.as_ref().map(|server| server.addr().to_string()),
        events: Box::new(std::io::stdout()),
        pulse,
    };
    train(settings, &process.stop).map_err(LearnerError::into_failure)?;
    Ok(())
}
