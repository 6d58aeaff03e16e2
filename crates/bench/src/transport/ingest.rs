//! Many light actors against one learner. Every frame is counted, every acknowledgement timed.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use caudata_config::TransportSection;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;

use super::peer::{self, Light, Order, Peer};
use super::plan::{Kind, WAIT};
use super::stage::Stage;
use crate::measure::{Cost, own_cpu_s, quantile};

/// Light actors of one helper process.
const PER_PROCESS: u32 = 64;
/// Silence after which nothing more is expected.
const SILENCE_MAX: Duration = Duration::from_secs(90);

/// How many actors, and what they send.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Light actors
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u32).range(1..=1024))]
    actors: u32,
    /// Over which link; not inproc, which has no actors of other processes
    #[arg(long, value_enum, default_value_t = Kind::Zenoh)]
    kind: Kind,
    /// Size of a frame, bytes
    #[arg(long, default_value_t = 32 << 10, value_parser = clap::value_parser!(u32).range(64..=1 << 24))]
    frame_bytes: u32,
    /// Time between two frames of one actor, ms
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..=3_600_000))]
    every_ms: u64,
    /// Frames of each actor
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    frames: u64,
}

/// What came, and how fast it was acknowledged.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// `ingest`.
    pub benchmark: &'static str,
    /// Which link.
    pub kind: &'static str,
    /// Light actors.
    pub actors: u32,
    /// Size of a frame.
    pub frame_bytes: u32,
    /// Time between two frames of one actor.
    pub every_ms: u64,
    /// Frames that the actors' links took, all acknowledged.
    pub sent: u64,
    /// Frames that the learner read, each checked to be the next one of its actor.
    pub received: u64,
    /// From the first frame to the last.
    pub seconds: f64,
    /// Frames per second.
    pub frames_per_s: f64,
    /// From the offer of a frame until the actor knows that the learner has it.
    pub acknowledged_p50_ms: f64,
    /// 99th percentile of it.
    pub acknowledged_p99_ms: f64,
    /// The longest.
    pub acknowledged_max_ms: f64,
    /// Largest resident memory of the learner's process, MB; and before the actors came.
    pub memory_max_mb: f64,
    /// The same before the actors came.
    pub memory_before_mb: f64,
    /// CPU time of the learner's end per frame, us.
    pub cpu_us_per_frame: f64,
}

impl Finding {
    /// Nothing, where every frame was sent, acknowledged and received.
    ///
    /// # Errors
    /// Exit code 70 else.
    pub fn verdict(&self, plan: &Plan) -> Result<(), Failure> {
        let expected = u64::from(plan.actors) * plan.frames;
        let (sent, received) = (self.sent, self.received);
        match received == sent && sent == expected {
            true => Ok(()),
            false => Err(wrong(&format!(
                "{expected} frames were to come, {sent} were sent and acknowledged, {received} came"
            ))),
        }
    }
}

/// Starts the actors and reads what they send.
///
/// # Errors
/// Where a process or a link fails, or a frame is not the next one of its actor.
pub fn run(plan: &Plan) -> Result<Finding, Failure> {
    if plan.kind == Kind::Inproc {
        let message = "--kind inproc: light actors are other processes";
        return Err(
            Failure::message(ExitCode::BadConfig, message).hint("take iceoryx2, zenoh or quic")
        );
    }
    let section = TransportSection {
        max_frame_bytes: u64::from(plan.frame_bytes),
        max_policy_bytes: 1 << 16,
        max_actors: 1024,
        ..TransportSection::default()
    };
    let mut stage = Stage::new(plan.kind, section)?;
    let memory_before_mb = memory_mb("VmRSS:")?;
    let mut peers = Vec::new();
    for first in (0..plan.actors).step_by(PER_PROCESS as usize) {
        peers.push(Peer::start(&Order::Light(Light {
            transport: stage.actor.clone(),
            run_id: stage.run_id.clone(),
            first,
            links: PER_PROCESS.min(plan.actors - first),
            frame_bytes: plan.frame_bytes as usize,
            every_ms: plan.every_ms,
            frames: plan.frames,
        }))?);
    }
    let expected = u64::from(plan.actors) * plan.frames;
    let ((received, seconds), cost) = Cost::of(own_cpu_s, || receive(&mut stage, expected))?;
    let mut micros: Vec<f64> = Vec::new();
    for peer in peers {
        let printed = peer.finish()?;
        let waits: Vec<f64> = serde_json::from_str(&printed).or_exit(ExitCode::Internal)?;
        micros.extend(waits);
    }
    micros.sort_by(f64::total_cmp);
    let milliseconds = |q: f64| quantile(&micros, q).map_or(f64::NAN, |us| us / 1e3);
    Ok(Finding {
        benchmark: "ingest",
        kind: plan.kind.name(),
        actors: plan.actors,
        frame_bytes: plan.frame_bytes,
        every_ms: plan.every_ms,
        sent: micros.len() as u64,
        received,
        seconds,
        frames_per_s: received as f64 / seconds,
        acknowledged_p50_ms: milliseconds(0.5),
        acknowledged_p99_ms: milliseconds(0.99),
        acknowledged_max_ms: milliseconds(1.0),
        memory_max_mb: memory_mb("VmHWM:")?,
        memory_before_mb,
        cpu_us_per_frame: 1e6 * cost.cpu_s / received as f64,
    })
}

/// Frames that came, and the time from the first one on, s.
fn receive(stage: &mut Stage, expected: u64) -> Result<(u64, f64), Failure> {
    let mut next: BTreeMap<u32, u64> = BTreeMap::new();
    let mut received = 0;
    let mut began = Instant::now();
    let mut last = Instant::now();
    while received < expected {
        let Some(frame) = stage.learner.recv(WAIT).or_exit(ExitCode::Internal)? else {
            if last.elapsed() > SILENCE_MAX {
                break;
            }
            continue;
        };
        if received == 0 {
            began = Instant::now();
        }
        last = Instant::now();
        received += 1;
        let number = peer::number_of(&frame.bytes);
        let (id, number) = number.ok_or_else(|| wrong("a frame without its number"))?;
        let due = next.entry(id).or_default();
        if number != *due {
            let message = format!("actor {id}: frame {number} came where {due} was due");
            return Err(wrong(&message));
        }
        *due += 1;
    }
    Ok((received, began.elapsed().as_secs_f64()))
}

fn wrong(message: &str) -> Failure {
    Failure::message(ExitCode::Internal, message)
}

/// A line of `/proc/self/status`, MB.
fn memory_mb(name: &str) -> Result<f64, Failure> {
    let text = std::fs::read_to_string("/proc/self/status").or_exit(ExitCode::Internal)?;
    let kib = text
        .lines()
        .find_map(|line| line.strip_prefix(name))
        .and_then(|rest| rest.trim().strip_suffix(" kB"))
        .and_then(|number| number.parse::<f64>().ok());
    kib.map(|kib| kib * 1024.0 / 1e6)
        .ok_or_else(|| wrong("the system does not say how much memory is used"))
}
