//! Measures every transport on this machine: streaming rate and one-way latency, actors in processes of their own
//! (in-process: threads).
//!
//! `cargo run --release -p caudata-transport --example throughput -- [frame KiB] [seconds] [actors]`, by default
//! 256 KiB, 3 s, 1 actor.

#![allow(clippy::print_stdout)]

use std::error::Error;
use std::process::{Child, Command};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use caudata_transport::{
    ActorLink, Control, Iceoryx2Config, InprocConfig, InprocHub, LearnerLink, Limits, PolicyUpdate,
    SendError, TransportConfig, ZenohConfig, actor_link, learner_link,
};

type Outcome<T> = Result<T, Box<dyn Error + Send + Sync>>;

/// Set in helper processes to the configuration of the run.
const CONFIG: &str = "CAUDATA_TRANSPORT_EXAMPLE_CONFIG";
const RUN_ID: &str = "throughput";
const WAIT: Duration = Duration::from_millis(100);
/// Pause between the frames of the latency measurement, so that each finds the link at rest.
const AT_REST: Duration = Duration::from_millis(3);
const WARM_UP: Duration = Duration::from_millis(500);

/// What is measured, as the command line gives it.
#[derive(Clone, Copy)]
struct Plan {
    frame_bytes: usize,
    seconds: f64,
    actors: usize,
}

fn main() -> Outcome<()> {
    let number = |at: usize, default: u64| match std::env::args().nth(at) {
        Some(text) => text.parse(),
        None => Ok(default),
    };
    let plan = Plan {
        frame_bytes: number(1, 256)? as usize * 1024,
        seconds: number(2, 3)? as f64,
        actors: number(3, 1)? as usize,
    };
    if let Ok(config) = std::env::var(CONFIG) {
        let config: TransportConfig = toml::from_str(&config)?;
        return act(&mut *actor_link(&config, RUN_ID, 0)?, plan.frame_bytes);
    }
    println!(
        "frames of {} KiB, {} actor(s), {} s",
        plan.frame_bytes / 1024,
        plan.actors,
        plan.seconds
    );
    let limits = Limits {
        max_frame_bytes: plan.frame_bytes,
        ..Limits::default()
    };
    let inproc = InprocConfig {
        limits: limits.clone(),
    };
    measure_inproc(&inproc, plan)?;
    let iceoryx2 = Iceoryx2Config { limits, root: None };
    let zenoh = ZenohConfig {
        limits: iceoryx2.limits.clone(),
        ..ZenohConfig::default()
    };
    measure_processes("iceoryx2", &TransportConfig::Iceoryx2(iceoryx2), plan)?;
    measure_processes("zenoh", &TransportConfig::Zenoh(zenoh), plan)
}

fn measure_inproc(config: &InprocConfig, plan: Plan) -> Outcome<()> {
    let hub = InprocHub::new(config)?;
    let learner = hub.learner()?;
    let start = |_| -> Outcome<JoinHandle<Outcome<()>>> {
        let mut actor = hub.actor()?;
        Ok(std::thread::spawn(move || {
            act(&mut *actor, plan.frame_bytes)
        }))
    };
    let threads: Vec<_> = (0..plan.actors).map(start).collect::<Outcome<_>>()?;
    measure("inproc", learner, plan)?;
    for thread in threads {
        thread.join().map_err(|_| "an actor thread panicked")??;
    }
    Ok(())
}

fn measure_processes(name: &str, config: &TransportConfig, plan: Plan) -> Outcome<()> {
    let learner = learner_link(config, RUN_ID)?;
    let actor_config = toml::to_string(&learner.actor_config())?;
    let start = |_| -> Outcome<Child> {
        let child = Command::new(std::env::current_exe()?)
            .arg((plan.frame_bytes / 1024).to_string())
            .env(CONFIG, &actor_config)
            .spawn()?;
        Ok(child)
    };
    let children: Vec<_> = (0..plan.actors).map(start).collect::<Outcome<_>>()?;
    measure(name, learner, plan)?;
    for mut child in children {
        child.wait()?;
    }
    Ok(())
}

/// Version 1 lets the actors stream, version 2 has them send one frame at a time, stop ends them.
fn measure(name: &str, mut learner: Box<dyn LearnerLink>, plan: Plan) -> Outcome<()> {
    publish(&mut *learner, 1, Control::Run)?;
    receive(&mut *learner, WARM_UP.as_secs_f64())?;
    let start = Instant::now();
    let frames = receive(&mut *learner, plan.seconds)?.len() as f64 / start.elapsed().as_secs_f64();
    publish(&mut *learner, 2, Control::Run)?;
    receive(&mut *learner, WARM_UP.as_secs_f64())?;
    let mut micros = receive(&mut *learner, plan.seconds)?;
    publish(&mut *learner, 2, Control::Stop)?;
    // Reads on until the actors have left, so that none is stuck behind a full window.
    while learner.stats().peers > 0 {
        learner.recv(WAIT)?;
    }
    micros.sort_by(f64::total_cmp);
    let quantile = |q: f64| micros[((micros.len() - 1) as f64 * q) as usize];
    println!(
        "{name:8}  {frames:8.0} frames/s  {:7.0} MB/s  latency p50 {:6.0} us  p99 {:6.0} us  ({} samples)",
        frames * plan.frame_bytes as f64 / 1e6,
        quantile(0.5),
        quantile(0.99),
        micros.len()
    );
    Ok(())
}

/// One-way times of the frames that arrive within `seconds`, microseconds.
fn receive(learner: &mut dyn LearnerLink, seconds: f64) -> Outcome<Vec<f64>> {
    let start = Instant::now();
    let mut micros = Vec::new();
    while start.elapsed().as_secs_f64() < seconds {
        if let Some(frame) = learner.recv(WAIT)? {
            let stamp = frame.bytes[..16].try_into()?;
            micros.push((now_ns()? - u128::from_le_bytes(stamp)) as f64 / 1e3);
        }
    }
    Ok(micros)
}

fn publish(learner: &mut dyn LearnerLink, version: u64, control: Control) -> Outcome<()> {
    learner.publish_policy(PolicyUpdate {
        version,
        sha256: [0; 32],
        bytes: Arc::default(),
        control,
    })?;
    Ok(())
}

/// The actor: does what the newest policy's version says.
fn act(actor: &mut dyn ActorLink, frame_bytes: usize) -> Outcome<()> {
    let mut frame = vec![0x5a; frame_bytes];
    let mut version = 0;
    while !actor.stop_requested() {
        let wait = if version == 0 { WAIT } else { Duration::ZERO };
        if let Some(update) = actor.next_policy(wait)? {
            version = update.version;
        }
        if version == 0 {
            continue;
        }
        if version == 2 {
            std::thread::sleep(AT_REST);
        }
        frame[..16].copy_from_slice(&now_ns()?.to_le_bytes());
        match actor.send(&frame, WAIT) {
            Ok(()) | Err(SendError::Full { .. } | SendError::Disconnected { .. }) => {}
            Err(error) => return Err(error.into()),
        }
    }
    Ok(())
}

fn now_ns() -> Outcome<u128> {
    Ok(SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)?
        .as_nanos())
}
