//! `caudata-policy-server`: holds policy versions and hands them to robots.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode as OsExitCode;
use std::time::Duration;

use caudata_policy_server::{
    ServeError, ServerMetrics, Store, StoreError, StoreLimits, listen, serve, serve_tls, tls_config,
};
use caudata_telemetry::{
    ExitCode, Failure, FailureExt, LogArgs, Metrics, MetricsServer, Process, StopFlag, announce,
    parse_args,
};
use clap::Parser;
use tokio::sync::watch;
use tonic::transport::ServerTlsConfig;

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
    /// Folder with ca.crt, tls.crt and tls.key (`caudata pki`): clients must show a certificate. Needed beyond loopback
    #[arg(long, value_name = "DIR")]
    tls_dir: Option<PathBuf>,
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
    let tls = tls_of(args)?;
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
        match tls {
            None => serve(listener, store, counters, stopped).await,
            Some(tls) => serve_tls(listener, store, counters, stopped, tls).await,
        }
        .map_err(serve_failure)
    })
}

/// The certificates; none on loopback unless asked for.
fn tls_of(args: &Args) -> Result<Option<ServerTlsConfig>, Failure> {
    let Some(folder) = &args.tls_dir else {
        if args.addr.ip().is_loopback() {
            return Ok(None);
        }
        let message = format!(
            "{} can be reached from other hosts, and there are no certificates",
            args.addr
        );
        return Err(Failure::message(ExitCode::BadConfig, message)
            .hint("make some with `caudata pki` and give --tls-dir, or listen on 127.0.0.1"));
    };
    let tls = tls_config(folder).map_err(|(path, error)| {
        Failure::message(ExitCode::NoInput, format!("{}: {error}", path.display()))
    })?;
    Ok(Some(tls))
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
