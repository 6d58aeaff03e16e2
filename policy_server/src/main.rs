//! `caudata-policy-server`: holds policy versions and hands them to robots.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode as OsExitCode;
use std::sync::Arc;
use std::time::Duration;

use caudata_policy_server::{
    ServeOptions, ServerMetrics, SharedStore, Store, StoreError, StoreLimits, listen, serve_page,
    serve_with,
};
use caudata_signing::ReleaseKey;
use caudata_signing::pki::{Callers, PkiError, listen_as};
use caudata_telemetry::{
    CONNECTIONS_MAX, ConnectionLimits, ExitCode, Failure, FailureExt, LogArgs, Metrics,
    MetricsServer, PEER_CONNECTIONS_MAX, Process, StopFlag, announce, parse_args, raise_file_limit,
};
use clap::Parser;
use tokio::sync::watch;
use tokio_rustls::TlsAcceptor;

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
    /// Folder with ca.crt, tls.crt and tls.key (`caudata pki`): clients must show a certificate. Needed
    /// beyond loopback
    #[arg(long, value_name = "DIR")]
    tls_dir: Option<PathBuf>,
    /// Address of /metrics and /healthz; none when absent
    #[arg(long, value_name = "ADDR")]
    metrics_addr: Option<SocketAddr>,
    /// Address of the page for people (versions, labels, robots); none when absent. Whoever can reach it can
    /// read it
    #[arg(long, value_name = "ADDR")]
    page_addr: Option<SocketAddr>,
    /// Versions kept per stream, newest first; those that a label leads to stay
    #[arg(long, value_name = "N", default_value_t = StoreLimits::default().versions_kept)]
    keep: usize,
    /// Robots that must have run a version through its trial before `stable` may lead to it
    #[arg(long, value_name = "N", default_value_t = StoreLimits::default().stable_needs)]
    stable_needs: usize,
    /// Secret key by which this server says where labels lead (`caudata policy keygen --fresh`)
    #[arg(long, value_name = "FILE", requires = "fresh_key_id")]
    fresh_key: Option<PathBuf>,
    /// Name of that key
    #[arg(long, value_name = "ID", requires = "fresh_key")]
    fresh_key_id: Option<String>,
    /// Connections at once, altogether
    #[arg(long, value_name = "N", default_value_t = CONNECTIONS_MAX)]
    connections: usize,
    /// Connections at once from one other host
    #[arg(long, value_name = "N", default_value_t = PEER_CONNECTIONS_MAX)]
    connections_per_host: usize,
    #[command(flatten)]
    log: LogArgs,
}

fn main() -> OsExitCode {
    let args: Args = parse_args();
    Process::run("caudata-policy-server", &args.log, |process| run(&args, &process.stop))
}

fn run(args: &Args, stop: &StopFlag) -> Result<(), Failure> {
    let limits = StoreLimits {
        versions_kept: args.keep,
        stable_needs: args.stable_needs,
        ..StoreLimits::default()
    };
    let options = ServeOptions {
        tls: tls_of(args)?,
        fresh_key: fresh_key(args)?,
        connections: ConnectionLimits {
            total: args.connections,
            per_peer: args.connections_per_host,
        }
        .within(raise_file_limit()),
        ..ServeOptions::default()
    };
    let store = Store::open(&args.data, limits).map_err(store_failure)?;
    let store = SharedStore::new(store);
    let metrics = Metrics::new();
    let counters = ServerMetrics::register(&metrics);
    let _endpoint = match args.metrics_addr {
        Some(addr) => {
            let trouble = store.trouble();
            let check = move || trouble.borrow().as_ref().map(|why| format!("cannot write: {why}"));
            Some(MetricsServer::start_with_check(addr, metrics, stop.clone(), check)?)
        }
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
        let listener = listen(args.addr).await?;
        let bound = listener.local_addr().or_exit(ExitCode::OsResource)?;
        tracing::info!(addr = %bound, data = %args.data.display(), "serving policies");
        announce("policy_server", bound);
        if let Some(addr) = args.page_addr {
            let listener = listen(addr).await?;
            let bound = listener.local_addr().or_exit(ExitCode::OsResource)?;
            tracing::info!("page at http://{bound}/");
            announce("page", bound);
            let (store, stopped) = (store.clone(), stopped.clone());
            tokio::spawn(async move {
                if let Err(error) = serve_page(listener, store, stopped).await {
                    tracing::error!(%error, "the page ended");
                }
            });
        }
        serve_with(listener, store, counters, stopped, options).await.or_exit(ExitCode::Internal)
    })
}

/// The key for freshness, where one is given.
fn fresh_key(args: &Args) -> Result<Option<Arc<ReleaseKey>>, Failure> {
    let (Some(path), Some(id)) = (&args.fresh_key, &args.fresh_key_id) else { return Ok(None) };
    let key = ReleaseKey::read(path, id).map_err(|error| {
        let code = if error.is_of_reading() { ExitCode::NoInput } else { ExitCode::BadInput };
        Failure::new(code, error)
    })?;
    Ok(Some(Arc::new(key)))
}

/// The certificates; none on loopback unless asked for.
fn tls_of(args: &Args) -> Result<Option<TlsAcceptor>, Failure> {
    let Some(folder) = &args.tls_dir else {
        if args.addr.ip().is_loopback() {
            return Ok(None);
        }
        let message =
            format!("{} can be reached from other hosts, and there are no certificates", args.addr);
        return Err(Failure::message(ExitCode::BadConfig, message)
            .hint("make some with `caudata pki` and give --tls-dir, or listen on 127.0.0.1"));
    };
    let tls = listen_as(folder, Callers::OfTheLab, "h2").map_err(|error| {
        let code = match error {
            PkiError::File { .. } => ExitCode::NoInput,
            _ => ExitCode::BadInput,
        };
        Failure::new(code, error)
    })?;
    Ok(Some(tls))
}

fn store_failure(error: StoreError) -> Failure {
    Failure::new(ExitCode::CannotCreate, error)
}
