//! The other ends of measured links: this program again, in processes of their own, told by a variable what to do.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use caudata_signing::pki::{Authority, Request, Role};
use caudata_telemetry::{ExitCode, Failure, FailureExt, PARENT_PID_VAR};
use caudata_transport::{ActorLink, SendError, TlsFiles, TransportConfig, actor_link};
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;
use serde::{Deserialize, Serialize};

use crate::say;

/// Holds an [`Order`] as JSON; set for helper processes only.
const ORDER: &str = "CAUDATA_BENCH_PEER";
/// Longest single wait on a link.
pub const WAIT: Duration = Duration::from_millis(100);
/// Pause between frames whose latency is measured, so that each finds the link at rest.
const AT_REST: Duration = Duration::from_millis(3);
/// What the kernel counts CPU time of other processes in; the same on every Linux that Rust knows.
const TICKS_PER_S: f64 = 100.0;
/// Silence after which the measuring process is taken for gone.
const GONE: Duration = Duration::from_secs(20);
/// Longest time that one light frame may take to be acknowledged before the helper gives up.
const ACK_MAX: Duration = Duration::from_secs(60);

/// What a helper process does.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Order {
    /// An actor that streams time-stamped frames (policy version 1) or sends one at a time (2), until the stop.
    Stream {
        transport: TransportConfig,
        run_id: String,
        frame_bytes: usize,
    },
    /// Writes time-stamped frames to a TCP socket until it is closed; `paced`: one at a time.
    Socket {
        address: SocketAddr,
        frame_bytes: usize,
        paced: bool,
    },
    /// Many light actors: each sends `frames` frames, one every `every_ms`, waits for each one's acknowledgement, and all
    /// their waits are printed at the end as a JSON array, microseconds.
    Light {
        transport: TransportConfig,
        run_id: String,
        first: u32,
        links: u32,
        frame_bytes: usize,
        every_ms: u64,
        frames: u64,
    },
}

/// What this process was started for, if it is a helper.
///
/// # Errors
/// When the variable holds something else.
pub fn order() -> Result<Option<Order>, Failure> {
    match std::env::var(ORDER) {
        Err(_) => Ok(None),
        Ok(text) => serde_json::from_str(&text).or_exit(ExitCode::BadConfig),
    }
}

/// A helper process. Dropped while it runs, it is killed.
pub struct Peer {
    child: Child,
}

impl Peer {
    /// Starts one.
    pub fn start(order: &Order) -> Result<Self, Failure> {
        let own = std::env::current_exe().or_exit(ExitCode::Internal)?;
        let order = serde_json::to_string(order).or_exit(ExitCode::Internal)?;
        let mut command = Command::new(own);
        command
            .args(["bench", "transport"])
            .env(ORDER, order)
            .stdout(Stdio::piped());
        Self::of(command)
    }

    /// Any other program as one.
    pub fn of(mut command: Command) -> Result<Self, Failure> {
        let child = command
            .stdin(Stdio::null())
            .env(PARENT_PID_VAR, std::process::id().to_string())
            // zenoh warns about every QUIC session that its access control does not tell network interfaces apart; ours does not ask.
            .env("CAUDATA_LOG", "error")
            .spawn()
            .or_exit(ExitCode::OsResource)?;
        Ok(Self { child })
    }

    /// CPU time of it so far, s.
    pub fn cpu_s(&self) -> f64 {
        cpu_s_of(self.child.id()).unwrap_or(0.0)
    }

    /// Waits for its end; what it printed.
    pub fn finish(mut self) -> Result<String, Failure> {
        let mut printed = String::new();
        if let Some(stdout) = &mut self.child.stdout {
            stdout
                .read_to_string(&mut printed)
                .or_exit(ExitCode::Internal)?;
        }
        let status = self.child.wait().or_exit(ExitCode::OsResource)?;
        if !status.success() {
            let message = format!("the other end of the link ended with {status}");
            return Err(Failure::message(ExitCode::Internal, message));
        }
        Ok(printed)
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It may have ended long ago.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// CPU time of process `pid` so far, all threads, user and system, s.
fn cpu_s_of(pid: u32) -> Option<f64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The second field is the name in brackets, which may have spaces; utime and stime are the 14th and 15th.
    let rest = text.rsplit_once(") ")?.1;
    let mut fields = rest.split(' ').skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / TICKS_PER_S)
}

/// CPU time of this process so far, s.
///
/// # Errors
/// When the system does not tell.
pub fn own_cpu_s() -> Result<f64, Failure> {
    cpu_s(UsageWho::RUSAGE_SELF)
}

/// CPU time of this thread so far, s.
///
/// # Errors
/// When the system does not tell.
pub fn thread_cpu_s() -> Result<f64, Failure> {
    cpu_s(UsageWho::RUSAGE_THREAD)
}

fn cpu_s(who: UsageWho) -> Result<f64, Failure> {
    let usage = getrusage(who).or_exit(ExitCode::Internal)?;
    let micros = usage.user_time().num_microseconds() + usage.system_time().num_microseconds();
    Ok(micros as f64 / 1e6)
}

/// Time since 1970, ns: the processes of one machine agree about it.
pub fn now_ns() -> u128 {
    SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)
        .map_or(0, |since| since.as_nanos())
}

/// A lab's certificates for a learner and its actors on this host, in `folder`.
///
/// # Errors
/// When they cannot be made.
pub fn certificates(folder: &Path) -> Result<(TlsFiles, TlsFiles), Failure> {
    let made = |error: caudata_signing::pki::PkiError| {
        Failure::message(ExitCode::CannotCreate, error.to_string())
    };
    let now = SystemTime::now();
    let authority = Authority::create(folder, "bench", now).map_err(made)?;
    let issue = |role: Role, name: &str| {
        let request = Request {
            role,
            name: name.to_owned(),
            hosts: vec!["localhost".to_owned()],
            days: 1,
        };
        let folder = authority.issue(&request, now, false).map_err(made)?;
        Ok::<_, Failure>(TlsFiles::in_folder(&folder))
    };
    Ok((
        issue(Role::Learner, "learner")?,
        issue(Role::Actor, "actor")?,
    ))
}

/// Does what this process was started for.
///
/// # Errors
/// When the link fails for good.
pub fn obey(order: &Order) -> Result<(), Failure> {
    match order {
        Order::Stream {
            transport,
            run_id,
            frame_bytes,
        } => {
            let mut link = actor_link(transport, run_id, 0).or_exit(ExitCode::Unavailable)?;
            stream(&mut *link, *frame_bytes)
        }
        Order::Socket {
            address,
            frame_bytes,
            paced,
        } => socket(*address, *frame_bytes, *paced),
        Order::Light { .. } => light(order),
    }
}

/// Does what the newest policy's version says, until the stop.
///
/// # Errors
/// When the link fails for good.
pub fn stream(link: &mut dyn ActorLink, frame_bytes: usize) -> Result<(), Failure> {
    let mut frame = vec![0x5a; frame_bytes];
    let mut version = 0;
    let mut heard = Instant::now();
    while !link.stop_requested() {
        if link.is_connected() {
            heard = Instant::now();
        } else if heard.elapsed() > GONE {
            return Err(Failure::message(ExitCode::Unavailable, "nobody reads"));
        }
        let wait = if version == 0 { WAIT } else { Duration::ZERO };
        if let Some(update) = link.next_policy(wait).or_exit(ExitCode::Unavailable)? {
            version = update.version;
        }
        if version == 0 {
            continue;
        }
        if version == 2 {
            std::thread::sleep(AT_REST);
        }
        stamp(&mut frame);
        match link.send(&frame, WAIT) {
            Ok(()) | Err(SendError::Full { .. } | SendError::Disconnected { .. }) => {}
            Err(error) => return Err(error).or_exit(ExitCode::Unavailable),
        }
    }
    Ok(())
}

fn socket(address: SocketAddr, frame_bytes: usize, paced: bool) -> Result<(), Failure> {
    let mut socket = TcpStream::connect(address).or_exit(ExitCode::Unavailable)?;
    socket.set_nodelay(true).or_exit(ExitCode::Internal)?;
    let mut frame = vec![0x5a; frame_bytes];
    loop {
        if paced {
            std::thread::sleep(AT_REST);
        }
        stamp(&mut frame);
        if socket.write_all(&frame).is_err() {
            // Closed: the measurement is over.
            return Ok(());
        }
    }
}

/// Writes the time into the first 16 bytes.
fn stamp(frame: &mut [u8]) {
    if let Some(head) = frame.first_chunk_mut() {
        *head = now_ns().to_le_bytes();
    }
}

/// Microseconds since a frame was stamped.
pub fn micros_since_stamp(frame: &[u8]) -> f64 {
    let stamped = frame
        .first_chunk()
        .map_or(0, |head| u128::from_le_bytes(*head));
    now_ns().saturating_sub(stamped) as f64 / 1e3
}

fn light(order: &Order) -> Result<(), Failure> {
    let Order::Light {
        transport,
        run_id,
        first,
        links,
        frame_bytes,
        every_ms,
        frames,
    } = order
    else {
        return Ok(());
    };
    let actor = |id: u32| -> Result<Vec<f64>, Failure> {
        let mut link = actor_link(transport, run_id, id).or_exit(ExitCode::Unavailable)?;
        let every = Duration::from_millis(*every_ms);
        // Spread over the period, as actors that started one after the other are.
        std::thread::sleep(every * (id % 97) / 97);
        let mut frame = vec![0x5a; *frame_bytes];
        let mut micros = Vec::new();
        for number in 0..*frames {
            let began = Instant::now();
            stamp_number(&mut frame, id, number);
            loop {
                match link.send(&frame, WAIT) {
                    Ok(()) => break,
                    Err(SendError::Full { .. } | SendError::Disconnected { .. })
                        if began.elapsed() < ACK_MAX => {}
                    Err(error) => return Err(error).or_exit(ExitCode::Unavailable),
                }
            }
            link.flush(ACK_MAX).or_exit(ExitCode::Unavailable)?;
            micros.push(began.elapsed().as_secs_f64() * 1e6);
            std::thread::sleep(every.saturating_sub(began.elapsed()));
        }
        Ok(micros)
    };
    let all: Vec<Result<Vec<f64>, Failure>> = std::thread::scope(|scope| {
        let threads: Vec<_> = (*first..first + links)
            .map(|id| scope.spawn(move || actor(id)))
            .collect();
        threads
            .into_iter()
            .map(|thread| {
                thread.join().unwrap_or_else(|_| {
                    Err(Failure::message(
                        ExitCode::Internal,
                        "a light actor panicked",
                    ))
                })
            })
            .collect()
    });
    let mut micros = Vec::new();
    for waits in all {
        micros.extend(waits?);
    }
    say::json(&micros)
}

/// Who sends, and which of its frames it is, after the time stamp's place.
fn stamp_number(frame: &mut [u8], id: u32, number: u64) {
    if let Some(head) = frame.get_mut(..12) {
        head[..4].copy_from_slice(&id.to_le_bytes());
        head[4..].copy_from_slice(&number.to_le_bytes());
    }
}

/// Who sent a light frame, and which of its frames it is.
pub fn number_of(frame: &[u8]) -> Option<(u32, u64)> {
    let id = u32::from_le_bytes(frame.get(..4)?.try_into().ok()?);
    let number = u64::from_le_bytes(frame.get(4..12)?.try_into().ok()?);
    Some((id, number))
}
