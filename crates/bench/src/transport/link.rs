//! What a link does with frames.

use std::hint::black_box;
use std::io::Read;
use std::net::TcpListener;
use std::sync::Arc;

use caudata_config::TransportSection;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use caudata_transport::{Control, LearnerLink};
use serde::Serialize;

use super::peer::{self, Order, Peer};
use super::plan::{Kind, LEAVE_MAX, Plan, WAIT, WARM_UP_S};
use super::stage::{Ends, Stage};
use crate::measure::{Cost, own_cpu_s, quantile, until};

/// What a link does with frames.
#[derive(Clone, Debug, Serialize)]
pub struct Speed {
    /// Which link.
    pub what: &'static str,
    /// Frames per second.
    pub frames_per_s: f64,
    /// Gigabytes per second.
    pub gigabytes_per_s: f64,
    /// One way, the link at rest.
    pub latency_p50_us: Option<f64>,
    /// 99th percentile of it.
    pub latency_p99_us: Option<f64>,
    /// CPU time of both ends.
    pub cpu_s_per_gigabyte: f64,
}

impl Speed {
    /// So many frames at this cost; `micros`: one-way times of others.
    fn of(what: &'static str, bytes: usize, frames: f64, cost: Cost, mut micros: Vec<f64>) -> Self {
        micros.sort_by(f64::total_cmp);
        let gigabytes = frames * bytes as f64 / 1e9;
        Self {
            what,
            frames_per_s: frames / cost.wall_s,
            gigabytes_per_s: gigabytes / cost.wall_s,
            latency_p50_us: quantile(&micros, 0.5),
            latency_p99_us: quantile(&micros, 0.99),
            cpu_s_per_gigabyte: cost.cpu_s / gigabytes,
        }
    }
}

/// Each link, then what they are compared with.
pub fn all(kinds: &[Kind], plan: &Plan) -> Result<Vec<Speed>, Failure> {
    let mut speeds = Vec::new();
    for kind in kinds {
        speeds.push(link(*kind, plan)?);
    }
    speeds.push(socket(plan)?);
    speeds.push(copy(plan)?);
    Ok(speeds)
}

/// Version 1 lets the actors stream, version 2 has them send one frame at a time.
fn link(kind: Kind, plan: &Plan) -> Result<Speed, Failure> {
    let section = TransportSection {
        max_frame_bytes: u64::from(plan.frame_bytes),
        ..TransportSection::default()
    };
    let mut stage = Stage::new(kind, section)?;
    let frame_bytes = plan.frame_bytes as usize;
    let mut ends = Ends::default();
    for _ in 0..plan.actors {
        match &stage.hub {
            Some(hub) => {
                let mut link = hub.actor().or_exit(ExitCode::Internal)?;
                ends.thread(move || peer::stream(&mut *link, frame_bytes));
            }
            None => ends.peers.push(Peer::start(&Order::Stream {
                transport: stage.actor.clone(),
                run_id: stage.run_id.clone(),
                frame_bytes,
            })?),
        }
    }
    stage.publish(1, Arc::default(), Control::Run)?;
    // From the first frame on: a process takes its time to start.
    stage.learner.recv(LEAVE_MAX).or_exit(ExitCode::Internal)?;
    receive(&mut *stage.learner, WARM_UP_S)?;
    let (streamed, cost) =
        Cost::of(|| ends.cpu_s(), || receive(&mut *stage.learner, plan.time.seconds))?;
    stage.publish(2, Arc::default(), Control::Run)?;
    receive(&mut *stage.learner, WARM_UP_S)?;
    let micros = receive(&mut *stage.learner, plan.time.seconds)?;
    stage.publish(2, Arc::default(), Control::Stop)?;
    stage.let_go()?;
    ends.finish()?;
    let frames = streamed.len() as f64;
    Ok(Speed::of(kind.name(), frame_bytes, frames, cost, micros))
}

/// One-way times of the frames that arrive within `seconds`, microseconds.
fn receive(learner: &mut dyn LearnerLink, seconds: f64) -> Result<Vec<f64>, Failure> {
    let mut micros = Vec::new();
    until(seconds, || {
        if let Some(frame) = learner.recv(WAIT).or_exit(ExitCode::Internal)? {
            micros.push(peer::micros_since_stamp(&frame.bytes));
        }
        Ok(())
    })?;
    Ok(micros)
}

/// The same frames over a TCP socket that does nothing else.
fn socket(plan: &Plan) -> Result<Speed, Failure> {
    let frame_bytes = plan.frame_bytes as usize;
    let phase = |paced: bool| -> Result<(Vec<f64>, Cost), Failure> {
        let listener = TcpListener::bind("127.0.0.1:0").or_exit(ExitCode::OsResource)?;
        let address = listener.local_addr().or_exit(ExitCode::OsResource)?;
        let peer = Peer::start(&Order::Socket { address, frame_bytes, paced })?;
        let (mut socket, _) = listener.accept().or_exit(ExitCode::OsResource)?;
        let mut frame = vec![0; frame_bytes];
        let mut read = |seconds: f64| -> Result<Vec<f64>, Failure> {
            let mut micros = Vec::new();
            until(seconds, || {
                socket.read_exact(&mut frame).or_exit(ExitCode::Internal)?;
                micros.push(peer::micros_since_stamp(&frame));
                Ok(())
            })?;
            Ok(micros)
        };
        read(WARM_UP_S)?;
        let found = Cost::of(|| Ok(own_cpu_s()? + peer.cpu_s()), || read(plan.time.seconds))?;
        drop(socket);
        peer.finish()?;
        Ok(found)
    };
    let (streamed, cost) = phase(false)?;
    let (micros, _) = phase(true)?;
    let frames = streamed.len() as f64;
    Ok(Speed::of("tcp socket", frame_bytes, frames, cost, micros))
}

/// Copying frames in memory: what no link can beat that copies once.
fn copy(plan: &Plan) -> Result<Speed, Failure> {
    let from = vec![0x5a_u8; plan.frame_bytes as usize];
    let mut to = vec![0_u8; from.len()];
    let mut frames = 0.0;
    let ((), cost) = Cost::of(own_cpu_s, || {
        until(plan.time.seconds.min(1.0), || {
            to.copy_from_slice(black_box(&from));
            black_box(&mut to);
            frames += 1.0;
            Ok(())
        })
    })?;
    Ok(Speed::of("memcpy", from.len(), frames, cost, Vec::new()))
}
