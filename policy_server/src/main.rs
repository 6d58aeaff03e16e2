//! `caudata-policy-server`: holds policy versions and hands them to robots.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode as OsExitCode;
use std::time::Duration;

use caudata_policy_server::{
    ServeError, ServerMetrics, Store, StoreError, StoreLimits, listen, serve,
};
use caudata_telemetry::{
    ExitCode, Failure, FailureExt, LogArgs, Metrics, MetricsServer, Process, StopFlag, announce,
    parse_args,
};
use clap::Parser;
use tokio::sync::watch;

/// Holds policy versions and hands them to robots: a content-addressed store behind gRPC.
#[derive(Parser)]
#[command(name = "caudata-policy-server", version)]
struct Args {
    /// Folder that holds the policies; made where it is absent
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Address to listen on; port 0 takes any free one
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7401")]
    addr: SocketAddr,
    /// Address of /metrics and /healthz; none when absent
    #[arg(long, value_name = "ADDR")]
    metrics_addr: Option<SocketAddr>,
    /// Versions kept per stream, newest first
    #[arg(long, value_name = "N", default_value_t = StoreLimits::default().versions_kept)]
    keep: usize,
    #[command(flatten)]
    log: LogArgs,
}

fn main() -> OsExitCode {
    let args: Args = parse_args();
    Process::run("caudata-policy-server", &args.log, |process| {
        run(&args, &process.stop)
    })
}

fn run(args: &Args, stop: &StopFlag) -> Result<(), Failure> {
    let limits = StoreLimits {
        versions_kept: args.keep,
        ..StoreLimits::default()
    };
    let store = Store::open(&args.data, limits).map_err(store_failure)?;
    let metrics = Metrics::new();
    let counters = ServerMetrics::register(&metrics);
    let _endpoint = match args.metrics_addr {
        Some(addr) => Some(MetricsServer::start(addr, metrics, stop.clone())?),
        None => None,
    };
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .or_exit(ExitCode::OsResource)?;
    let (stopping, stopped) = watch::channel(false);
    let flag = stop.clone();
    std::thread::spawn(move || {
        while !flag.wait(Duration::from_secs(3600)) {}
        let _ = stopping.send(true);
    });
    runtime.block_on(async {
        let listener = listen(args.addr).await.map_err(serve_failure)?;
        let bound = listener.local_addr().or_exit(ExitCode::OsResource)?;
        tracing::info!(addr = %bound, data = %args.data.display(), "serving policies");
        announce("policy_server", bound);
        serve(listener, store, counters, stopped)
            .await
            .map_err(serve_failure)
    })
}

fn store_failure(error: StoreError) -> Failure {
    Failure::new(ExitCode::CannotCreate, error)
}

fn serve_failure(error: ServeError) -> Failure {
    let code = match error {
        ServeError::InUse(_) | ServeError::Listen { .. } => ExitCode::OsResource,
        ServeError::Transport(_) | ServeError::Reflection(_) => ExitCode::Internal,
    };
    Failure::new(code, error)
}
