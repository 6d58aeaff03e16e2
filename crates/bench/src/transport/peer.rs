//! The other ends of measured links: this program again, in processes of their own, told by a variable what
//! to do.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use caudata_telemetry::{ExitCode, Failure, FailureExt, PARENT_PID_VAR};
use caudata_transport::{ActorLink, SendError, TransportConfig, actor_link};
use serde::{Deserialize, Serialize};

use super::plan::WAIT;
use crate::measure::cpu_s_of;

/// Holds an [`Order`] as JSON; set for helper processes only.
const ORDER: &str = "CAUDATA_BENCH_PEER";
/// Pause between frames whose latency is measured, so that each finds the link at rest.
const AT_REST: Duration = Duration::from_millis(3);
/// Silence after which the measuring process is taken for gone.
const GONE: Duration = Duration::from_secs(20);
/// Longest time that one light frame may take to be acknowledged before the helper gives up.
const ACK_MAX: Duration = Duration::from_secs(60);

/// What a helper process does.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Order {
    /// An actor that streams time-stamped frames (policy version 1) or sends one at a time (2), until the
    /// stop.
    Stream { transport: TransportConfig, run_id: String, frame_bytes: usize },
    /// Writes time-stamped frames to a TCP socket until it is closed; `paced`: one at a time.
    Socket { address: SocketAddr, frame_bytes: usize, paced: bool },
    /// Many light actors; all their waits are printed at the end as a JSON array, microseconds.
    Light(Light),
}

/// Each sends `frames` frames, one every `every_ms`, and waits for each one's acknowledgement.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Light {
    pub transport: TransportConfig,
    pub run_id: String,
    pub first: u32,
    pub links: u32,
    pub frame_bytes: usize,
    pub every_ms: u64,
    pub frames: u64,
}

/// Does what this process was started for, if it is a helper; whether it is one.
///
/// # Errors
/// When the variable holds something else than an order, or a link fails for good.
pub fn serve_if_peer() -> Result<bool, Failure> {
    let Ok(text) = std::env::var(ORDER) else { return Ok(false) };
    let order: Order = serde_json::from_str(&text).or_exit(ExitCode::BadConfig)?;
    obey(order).map(|()| true)
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
        command.args(["bench", "transport"]).env(ORDER, order).stdout(Stdio::piped());
        Self::of(command)
    }

    /// Any other program as one.
    pub fn of(mut command: Command) -> Result<Self, Failure> {
        let child = command
            .stdin(Stdio::null())
            .env(PARENT_PID_VAR, std::process::id().to_string())
            // zenoh warns about every QUIC session that its access control does not tell network interfaces
            // apart; ours does not ask.
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
            stdout.read_to_string(&mut printed).or_exit(ExitCode::Internal)?;
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

/// Time since 1970, ns: the processes of one machine agree about it.
fn now_ns() -> u128 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_nanos())
}

fn obey(order: Order) -> Result<(), Failure> {
    match order {
        Order::Stream { transport, run_id, frame_bytes } => {
            let mut link = actor_link(&transport, &run_id, 0).or_exit(ExitCode::Unavailable)?;
            stream(&mut *link, frame_bytes)
        }
        Order::Socket { address, frame_bytes, paced } => socket(address, frame_bytes, paced),
        Order::Light(order) => light(&order),
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
    let stamped = frame.first_chunk().map_or(0, |head| u128::from_le_bytes(*head));
    now_ns().saturating_sub(stamped) as f64 / 1e3
}

fn light(order: &Light) -> Result<(), Failure> {
    let all: Vec<Result<Vec<f64>, Failure>> = std::thread::scope(|scope| {
        let threads: Vec<_> = (order.first..order.first + order.links)
            .map(|id| scope.spawn(move || light_actor(order, id)))
            .collect();
        let panicked = |_| Err(Failure::message(ExitCode::Internal, "a light actor panicked"));
        threads.into_iter().map(|thread| thread.join().unwrap_or_else(panicked)).collect()
    });
    let mut micros = Vec::new();
    for waits in all {
        micros.extend(waits?);
    }
    let line = serde_json::to_string(&micros).or_exit(ExitCode::Internal)?;
    writeln!(std::io::stdout(), "{line}").or_exit(ExitCode::IoError)
}

/// What each of its frames took until it was acknowledged, microseconds.
fn light_actor(order: &Light, id: u32) -> Result<Vec<f64>, Failure> {
    let mut link =
        actor_link(&order.transport, &order.run_id, id).or_exit(ExitCode::Unavailable)?;
    let every = Duration::from_millis(order.every_ms);
    // Spread over the period, as actors that started one after the other are.
    std::thread::sleep(every * (id % 97) / 97);
    let mut frame = vec![0x5a; order.frame_bytes];
    let mut micros = Vec::new();
    for number in 0..order.frames {
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
