//! `caudata bench ingest`: many light actors against one learner. Every frame is counted, every acknowledgement timed.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use caudata_config::TransportSection;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde::Serialize;

use super::bench_peer::{self as peer, Order, Peer, WAIT, own_cpu_s};
use super::bench_transport::{Kind, Stage};
use crate::say;

/// Light actors of one helper process.
const PER_PROCESS: u32 = 64;
/// Silence after which nothing more is expected.
const QUIET_MAX: Duration = Duration::from_secs(90);

#[derive(Debug, Args)]
pub struct IngestBench {
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
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Finding {
    benchmark: &'static str,
    kind: &'static str,
    actors: u32,
    frame_bytes: u32,
    every_ms: u64,
    /// Frames that the actors' links took, all acknowledged.
    sent: u64,
    /// Frames that the learner read, each checked to be the next one of its actor.
    received: u64,
    seconds: f64,
    frames_per_s: f64,
    /// From the offer of a frame until the actor knows that the learner has it.
    acknowledged_p50_ms: f64,
    acknowledged_p99_ms: f64,
    acknowledged_max_ms: f64,
    /// Largest resident memory of the learner's process, MB; and before the actors came.
    memory_max_mb: f64,
    memory_before_mb: f64,
    /// CPU time of the learner's end per frame, us.
    cpu_us_per_frame: f64,
}

pub fn run(args: &IngestBench) -> Result<(), Failure> {
    if args.kind == Kind::Inproc {
        let message = "--kind inproc: light actors are other processes";
        return Err(
            Failure::message(ExitCode::BadConfig, message).hint("take iceoryx2, zenoh or quic")
        );
    }
    let section = TransportSection {
        max_frame_bytes: u64::from(args.frame_bytes),
        max_policy_bytes: 1 << 16,
        max_actors: 1024,
        ..TransportSection::default()
    };
    let mut stage = Stage::new(args.kind, section)?;
    let memory_before_mb = memory_mb("VmRSS:")?;
    let mut peers = Vec::new();
    let mut first = 0;
    while first < args.actors {
        let links = PER_PROCESS.min(args.actors - first);
        peers.push(Peer::start(&Order::Light {
            transport: stage.actor.clone(),
            run_id: stage.run_id.clone(),
            first,
            links,
            frame_bytes: args.frame_bytes as usize,
            every_ms: args.every_ms,
            frames: args.frames,
        })?);
        first += links;
    }
    let expected = u64::from(args.actors) * args.frames;
    let mut next: BTreeMap<u32, u64> = BTreeMap::new();
    let mut received = 0;
    let cpu_before = own_cpu_s()?;
    let mut began = Instant::now();
    let mut last = Instant::now();
    while received < expected {
        let Some(frame) = stage.learner.recv(WAIT).or_exit(ExitCode::Internal)? else {
            if last.elapsed() > QUIET_MAX {
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
            return Err(wrong(&format!(
                "actor {id}: frame {number} came where {due} was due"
            )));
        }
        *due += 1;
    }
    let seconds = began.elapsed().as_secs_f64();
    let cpu_s = own_cpu_s()? - cpu_before;
    let mut micros: Vec<f64> = Vec::new();
    for peer in peers {
        let printed = peer.finish()?;
        let waits: Vec<f64> = serde_json::from_str(&printed).or_exit(ExitCode::Internal)?;
        micros.extend(waits);
    }
    micros.sort_by(f64::total_cmp);
    let milliseconds = |q: f64| {
        let at = (micros.len().saturating_sub(1) as f64 * q).round() as usize;
        micros.get(at).map_or(f64::NAN, |us| us / 1e3)
    };
    let finding = Finding {
        benchmark: "ingest",
        kind: args.kind.name(),
        actors: args.actors,
        frame_bytes: args.frame_bytes,
        every_ms: args.every_ms,
        sent: micros.len() as u64,
        received,
        seconds,
        frames_per_s: received as f64 / seconds,
        acknowledged_p50_ms: milliseconds(0.5),
        acknowledged_p99_ms: milliseconds(0.99),
        acknowledged_max_ms: milliseconds(1.0),
        memory_max_mb: memory_mb("VmHWM:")?,
        memory_before_mb,
        cpu_us_per_frame: 1e6 * cpu_s / received as f64,
    };
    if args.json {
        say::json(&finding)?;
    } else {
        print(&finding);
    }
    if finding.received != finding.sent || finding.sent != expected {
        let (sent, received) = (finding.sent, finding.received);
        return Err(wrong(&format!(
            "{expected} frames were to come, {sent} were sent and acknowledged, {received} came"
        )));
    }
    Ok(())
}

fn wrong(message: &str) -> Failure {
    Failure::message(ExitCode::Internal, message.to_owned())
}

fn print(finding: &Finding) {
    say::line(format_args!(
        "{} actors over {}, a frame of {} KiB every {} ms: {} sent = {} received in {:.1} s ({:.0}/s)",
        finding.actors,
        finding.kind,
        finding.frame_bytes / 1024,
        finding.every_ms,
        finding.sent,
        finding.received,
        finding.seconds,
        finding.frames_per_s
    ));
    say::line(format_args!(
        "acknowledged after p50 {:.1} ms, p99 {:.1} ms, at most {:.1} ms; learner: {:.0} MB at most ({:.0} before), {:.0} us CPU per frame",
        finding.acknowledged_p50_ms,
        finding.acknowledged_p99_ms,
        finding.acknowledged_max_ms,
        finding.memory_max_mb,
        finding.memory_before_mb,
        finding.cpu_us_per_frame
    ));
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
