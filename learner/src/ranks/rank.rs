//! The other ranks' side: work on shards until the run ends.

use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use caudata_telemetry::StopFlag;
use tch::Tensor;

use super::link::{Certificates, Link};
use super::wire::{Hello, Kind, Reader, VERSION, Writer};
use super::{RankSettings, share, unless_asked};
use crate::LearnerError;
use crate::network::ActorCritic;
use crate::ppo::{Drawn, Local, Minibatch, Total, host};

/// Pause between two attempts to reach rank 0.
const RETRY_EVERY: Duration = Duration::from_millis(250);
/// Longest single attempt.
const CONNECT_MAX: Duration = Duration::from_secs(5);
/// How long a rank that was asked to stop works on, so that rank 0 can end the run in good order. Shorter than a process may take to drain.
const STOP_PATIENCE: Duration = Duration::from_secs(45);

/// How serving one rank 0 ended.
enum Ended {
    /// The run is over.
    InOrder,
    /// This one was asked to stop, and rank 0 had its time.
    Asked,
}

/// Why the connection is of no use any more.
enum Trouble {
    /// The other side is gone or talks nonsense: a new one may come.
    Link(String),
    /// This side cannot work.
    Own(LearnerError),
}

impl From<String> for Trouble {
    fn from(reason: String) -> Self {
        Self::Link(reason)
    }
}

impl From<LearnerError> for Trouble {
    fn from(error: LearnerError) -> Self {
        Self::Own(error)
    }
}

/// Works for rank 0 as `rank` on `net`, whose parameters it is given, until the run ends or `stop` is raised. Where rank 0 is lost, the next one is
/// waited for.
///
/// # Errors
/// When rank 0 does not come (again) in time, refuses this rank, or this process cannot work.
pub fn serve(
    rank: u32,
    settings: &RankSettings,
    net: &ActorCritic,
    threads: usize,
    stop: &StopFlag,
) -> Result<(), LearnerError> {
    if rank == 0 || rank >= settings.count {
        return Err(LearnerError::setting(format!(
            "--rank {rank}: cluster.learner_ranks is {}, so others than the learner itself are 1 to {}",
            settings.count,
            settings.count.saturating_sub(1)
        )));
    }
    let _no_grad = tch::no_grad_guard();
    let mut local = Local::new(net, threads, settings.count as usize)?;
    loop {
        let Some(mut link) = join(rank, settings, net, stop)? else {
            return Ok(());
        };
        tracing::info!(rank, root = %link.peer, "joined");
        match work(rank, settings, &mut local, &mut link, stop) {
            Ok(Ended::InOrder) => {
                tracing::info!("the run has ended");
                return Ok(());
            }
            Ok(Ended::Asked) => return Ok(()),
            Err(Trouble::Own(error)) => return Err(error),
            Err(Trouble::Link(reason)) if stop.is_set() => {
                tracing::info!(reason, "rank 0 is gone");
                return Ok(());
            }
            Err(Trouble::Link(reason)) => {
                tracing::warn!(reason, "rank 0 is gone; waiting for the next one");
            }
        }
    }
}

/// Connects and is let in; nothing when asked to stop.
fn join(
    rank: u32,
    settings: &RankSettings,
    net: &ActorCritic,
    stop: &StopFlag,
) -> Result<Option<Link>, LearnerError> {
    let until = Instant::now() + settings.join_timeout;
    loop {
        // Looked up each time: a name may lead elsewhere when rank 0 has moved.
        let why = match settings.resolve() {
            Ok((addresses, folder)) => {
                let certificates = folder
                    .map(|folder| Certificates::read(folder))
                    .transpose()
                    .map_err(LearnerError::setting)?;
                let link = connect(&addresses, certificates.as_ref(), settings.host(), stop);
                match link.and_then(|link| introduce(link, rank, settings, net, stop)) {
                    Ok(Ok(link)) => return Ok(Some(link)),
                    Ok(Err(reason)) => return Err(LearnerError::RankRefused { rank, reason }),
                    Err(reason) => reason,
                }
            }
            Err(LearnerError::RankAddress { source, .. }) => source.to_string(),
            Err(other) => return Err(other),
        };
        if stop.wait(RETRY_EVERY) {
            return Ok(None);
        }
        if Instant::now() >= until {
            return Err(LearnerError::RankLost {
                rank: 0,
                peer: settings.address.clone(),
                reason: format!(
                    "not reached within {:.0} s: {why}",
                    settings.join_timeout.as_secs_f64()
                ),
            });
        }
    }
}

fn connect(
    addresses: &[SocketAddr],
    certificates: Option<&Certificates>,
    host: &str,
    stop: &StopFlag,
) -> Result<Link, String> {
    let mut why = "no address".to_owned();
    for address in addresses {
        match TcpStream::connect_timeout(address, CONNECT_MAX) {
            Ok(stream) => {
                return Link::connected(stream, certificates, host, CONNECT_MAX, || {
                    unless_asked(stop)
                });
            }
            Err(error) => why = error.to_string(),
        }
    }
    Err(why)
}

/// The link when rank 0 lets this one in, or the reason why not.
fn introduce(
    mut link: Link,
    rank: u32,
    settings: &RankSettings,
    net: &ActorCritic,
    stop: &StopFlag,
) -> Result<Result<Link, String>, String> {
    let mut words = Writer::default();
    words.hello(&Hello {
        version: VERSION,
        rank,
        ranks: settings.count,
        parameters: net.layout().len() as u64,
        identity: settings.identity.clone(),
    });
    link.send(Kind::Hello, &words, CONNECT_MAX)?;
    // Rank 0 may be busy with another one that connected first.
    let refused = match link.receive(settings.join_timeout, || unless_asked(stop))? {
        (Kind::Welcome, _) => None,
        (Kind::Refused, payload) => Some(Reader(payload).text()?),
        (other, _) => return Err(format!("it sent {other:?} instead of a welcome")),
    };
    link.admit();
    Ok(refused.map_or(Ok(link), Err))
}

fn work(
    rank: u32,
    settings: &RankSettings,
    local: &mut Local,
    link: &mut Link,
    stop: &StopFlag,
) -> Result<Ended, Trouble> {
    let ranks = settings.count;
    let net = local.net().share();
    let (obs_dim, act_dim) = (net.spec().obs_dim, net.spec().act_dim);
    let device = net.device();
    let patience = settings.answer_timeout;
    let mut out = Writer::default();
    // Rows of the minibatch whose gradient this rank has begun.
    let mut begun: Option<Vec<(Tensor, Tensor)>> = None;
    let mut asked_since: Option<Instant> = None;
    loop {
        let asked = |since: &mut Option<Instant>| {
            stop.is_set() && since.get_or_insert_with(Instant::now).elapsed() >= STOP_PATIENCE
        };
        let received = link.receive(settings.idle_timeout, || match asked(&mut asked_since) {
            true => Err(String::new()),
            false => Ok(()),
        });
        let (kind, payload) = match received {
            Ok(frame) => frame,
            Err(reason) if reason.is_empty() => return Ok(Ended::Asked),
            Err(reason) => return Err(reason.into()),
        };
        let mut reader = Reader(payload);
        let answer = match kind {
            Kind::Parameters => {
                net.copy_from_slice(&reader.f32s()?)?;
                None
            }
            Kind::Begin => {
                local.begin(Vec::new());
                begun = None;
                None
            }
            Kind::Table => {
                let rows = reader.size()?;
                local.push_table(matrix(&reader.f32s()?, rows, obs_dim)?.to_device(device));
                None
            }
            Kind::Forward => {
                let wanted = reader.forward()?;
                let rows = usize::try_from(wanted.rows).map_err(|e| e.to_string())?;
                let which = share(rank, ranks, local.cut(rows).len());
                let outputs = local.forward(wanted.head, wanted.table as usize, rows, which)?;
                out.0.clear();
                out.u8(stop.is_set().into());
                for output in outputs {
                    out.f32s(&host(&output)?);
                }
                Some(Kind::Outputs)
            }
            Kind::Drawn => {
                let rows = reader.size()?;
                let numbers = reader.f32s()?;
                let (log_std, samples) = numbers
                    .split_at_checked(act_dim)
                    .ok_or_else(|| "a frame ends too early".to_owned())?;
                let width = Drawn::width(act_dim);
                let samples = matrix(samples, samples.len() / width, width)?;
                local.load(Drawn {
                    samples: samples.to_device(device),
                    prox_log_std: Tensor::from_slice(log_std).to_device(device),
                    rows,
                });
                None
            }
            Kind::Shuffle => {
                let order: Vec<i64> = reader.u32s()?.into_iter().map(i64::from).collect();
                local.shuffle(&order)?;
                None
            }
            Kind::Gradient => {
                let minibatch: Minibatch = reader.minibatch()?;
                let which = share(rank, ranks, local.cut(minibatch.part.1).len());
                begun = Some(local.gradient(&minibatch, which)?);
                None
            }
            Kind::Before => {
                let sums = reader.sums()?;
                let before = reader.f32s()?;
                let gradient = match before.len() {
                    0 => None,
                    len if len == net.layout().len() => {
                        Some(Tensor::from_slice(&before).to_device(device))
                    }
                    len => return Err(format!("it sent a gradient of {len} numbers").into()),
                };
                let own = begun
                    .take()
                    .ok_or_else(|| "it wants a gradient that was not begun".to_owned())?;
                let mut total = Total { sums, gradient };
                total.add(own)?;
                out.0.clear();
                out.u8(stop.is_set().into());
                out.sums(&total.sums);
                if let Some(gradient) = &total.gradient {
                    out.f32s(&host(gradient)?);
                }
                Some(Kind::Total)
            }
            Kind::End => return Ok(Ended::InOrder),
            other => return Err(format!("it sent {other:?}, which is not for a rank").into()),
        };
        if let Some(kind) = answer {
            link.send(kind, &out, patience)?;
        }
    }
}

fn matrix(values: &[f32], rows: usize, columns: usize) -> Result<Tensor, String> {
    if rows.checked_mul(columns) != Some(values.len()) {
        return Err(format!(
            "it sent {} numbers for {rows} rows of {columns}",
            values.len()
        ));
    }
    Ok(Tensor::from_slice(values).view([rows as i64, columns as i64]))
}
