//! `caudata bench transport`: rate, latency and CPU of every link, beside memcpy and a bare TCP socket in the same run; and what
//! collecting rollouts costs over each link, beside the bare simulator and policy.

use std::hint::black_box;
use std::io::Read;
use std::net::TcpListener;
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_actor::{
    ActorMetrics, ActorSettings, build_env, encode_transport, gaussian, transport_config,
};
use caudata_config::{Config, ConfigArgs, TransportSection};
use caudata_policy::{Inference, PolicyFile};
use caudata_proto::{DecodeLimits, Envelope, decode};
use caudata_task::PolicyContract;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Metrics, StopFlag};
use caudata_transport::{
    Control, InprocHub, LearnerLink, PolicyUpdate, TransportConfig, ZenohConfig, learner_link,
};
use clap::{Args, ValueEnum};
use serde::Serialize;
use sha2::{Digest, Sha256};

use super::bench::{Common, as_flags, example_policy, or_quick};
use super::bench_peer::{self as peer, Order, Peer, WAIT, own_cpu_s, thread_cpu_s};
use crate::commands::robot_model;
use crate::commands::train::Programs;
use crate::say;

/// What is not measured at the start of each phase.
const WARM_UP_S: f64 = 0.5;
/// Longest wait for the other ends to come or to leave.
const LEAVE_MAX: Duration = Duration::from_secs(10);
/// Quotas that measured actors may be ahead: so many that they never wait for a policy.
const LEAD: u32 = 8;

#[derive(Debug, Args)]
pub struct TransportBench {
    #[command(flatten)]
    common: Common,
    /// Links to measure; default: all. May be given several times
    #[arg(long, value_enum)]
    kind: Vec<Kind>,
    /// Size of a frame, bytes
    #[arg(long, default_value_t = 256 << 10, value_parser = clap::value_parser!(u32).range(64..=1 << 28))]
    frame_bytes: u32,
    /// Actors that send
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    actors: u32,
    /// Leave out what collecting rollouts costs
    #[arg(long)]
    no_rollouts: bool,
    /// Only what collecting rollouts costs
    #[arg(long, conflicts_with = "no_rollouts")]
    rollouts_only: bool,
    /// How often that is measured over each link, in turns with the bare simulator and policy; medians are printed
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    rounds: u32,
    /// Robot, task and network of the rollouts; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Kind {
    /// Between threads
    Inproc,
    /// Shared memory
    Iceoryx2,
    /// zenoh over plain TCP on this machine
    Zenoh,
    /// zenoh over QUIC with certificates on both sides
    Quic,
}

impl Kind {
    pub fn name(self) -> &'static str {
        match self {
            Kind::Inproc => "inproc",
            Kind::Iceoryx2 => "iceoryx2",
            Kind::Zenoh => "zenoh",
            Kind::Quic => "quic",
        }
    }
}

/// What a link does with frames.
#[derive(Debug, Serialize)]
struct Speed {
    what: &'static str,
    frames_per_s: f64,
    gigabytes_per_s: f64,
    /// One way, the link at rest.
    latency_p50_us: Option<f64>,
    latency_p99_us: Option<f64>,
    /// CPU time of both ends.
    cpu_s_per_gigabyte: f64,
}

/// What collecting costs.
#[derive(Debug, Serialize)]
struct Rollouts {
    what: &'static str,
    steps_per_s: f64,
    /// CPU time of the actor and of the learner's receiving and checking.
    steps_per_cpu_s: f64,
    /// Of the bare simulator and policy.
    share_of_bare: f64,
}

#[derive(Debug, Serialize)]
struct Finding {
    benchmark: &'static str,
    frame_bytes: u32,
    actors: u32,
    seconds: f64,
    links: Vec<Speed>,
    rollouts: Vec<Rollouts>,
    /// What the actor of the in-process link spends its time on, as shares; empty where that link was not measured.
    phases: Vec<Phase>,
}

/// A part of an actor's time.
#[derive(Clone, Debug, Serialize)]
struct Phase {
    what: &'static str,
    share: f64,
}

/// Parts of an actor's time, by the metric that counts its seconds. The rest is exploration, copies and writing the frame.
const PHASES: [(&str, &str); 5] = [
    ("simulator", "caudata_actor_env_seconds_total"),
    ("inference", "caudata_inference_latency_seconds_sum"),
    ("new policies", "caudata_actor_policy_seconds_total"),
    ("handing over", "caudata_actor_send_seconds_total"),
    ("waiting", "caudata_actor_wait_seconds_total"),
];

pub fn run(args: &TransportBench) -> Result<(), Failure> {
    if let Some(order) = peer::order()? {
        return peer::obey(&order);
    }
    let kinds = match args.kind.as_slice() {
        [] => Kind::value_variants(),
        some => some,
    };
    let mut finding = Finding {
        benchmark: "transport",
        frame_bytes: args.frame_bytes,
        actors: args.actors,
        seconds: args.common.seconds,
        links: Vec::new(),
        rollouts: Vec::new(),
        phases: Vec::new(),
    };
    if !args.rollouts_only {
        for kind in kinds {
            finding.links.push(link(*kind, args)?);
        }
        finding.links.push(socket(args)?);
        finding.links.push(copy(args)?);
    }
    if !args.no_rollouts {
        (finding.rollouts, finding.phases) = rollouts(kinds, args)?;
    }
    if args.common.json {
        return say::json(&finding);
    }
    print(&finding);
    Ok(())
}

fn print(finding: &Finding) {
    print_links(finding);
    if finding.rollouts.is_empty() {
        return;
    }
    let header = ["rollouts", "steps/s", "steps per CPU s", "of bare"];
    let mut rows = vec![header.map(str::to_owned).to_vec()];
    for row in &finding.rollouts {
        rows.push(vec![
            row.what.to_owned(),
            format!("{:.0}", row.steps_per_s),
            format!("{:.0}", row.steps_per_cpu_s),
            format!("{:.0} %", 100.0 * row.share_of_bare),
        ]);
    }
    say::table(&rows);
    if !finding.phases.is_empty() {
        let parts: Vec<String> = finding
            .phases
            .iter()
            .map(|phase| format!("{} {:.1} %", phase.what, 100.0 * phase.share))
            .collect();
        say::line(format_args!("the in-process actor: {}", parts.join(", ")));
    }
}

fn print_links(finding: &Finding) {
    if finding.links.is_empty() {
        return;
    }
    say::line(format_args!(
        "frames of {} KiB from {} actor(s), {} s each",
        finding.frame_bytes / 1024,
        finding.actors,
        finding.seconds
    ));
    let header = [
        "link",
        "frames/s",
        "GB/s",
        "latency p50 us",
        "p99 us",
        "CPU s/GB",
    ];
    let mut rows = vec![header.map(str::to_owned).to_vec()];
    let micros = |us: Option<f64>| us.map_or("-".to_owned(), |us| format!("{us:.0}"));
    for speed in &finding.links {
        rows.push(vec![
            speed.what.to_owned(),
            format!("{:.0}", speed.frames_per_s),
            format!("{:.2}", speed.gigabytes_per_s),
            micros(speed.latency_p50_us),
            micros(speed.latency_p99_us),
            format!("{:.2}", speed.cpu_s_per_gigabyte),
        ]);
    }
    say::table(&rows);
}

/// The learner's end of a link, and what the other ends are given.
pub struct Stage {
    pub learner: Box<dyn LearnerLink>,
    /// For actors, certificates included.
    pub actor: TransportConfig,
    pub run_id: String,
    hub: Option<InprocHub>,
    /// Holds the certificates.
    _folder: Option<tempfile::TempDir>,
}

impl Stage {
    pub fn new(kind: Kind, mut section: TransportSection) -> Result<Self, Failure> {
        use caudata_config::TransportKind;
        let run_id = format!("bench-{}-{}", kind.name(), std::process::id());
        section.kind = match kind {
            Kind::Inproc => TransportKind::Inproc,
            Kind::Iceoryx2 => TransportKind::Iceoryx2,
            Kind::Zenoh | Kind::Quic => TransportKind::Zenoh,
        };
        let mut config = transport_config(&section);
        if let TransportConfig::Inproc(inproc) = &config {
            let hub = InprocHub::new(inproc).or_exit(ExitCode::BadConfig)?;
            return Ok(Self {
                learner: hub.learner().or_exit(ExitCode::Internal)?,
                actor: config,
                run_id,
                hub: Some(hub),
                _folder: None,
            });
        }
        let mut own_and_folder = None;
        if let (Kind::Quic, TransportConfig::Zenoh(zenoh)) = (kind, &mut config) {
            let folder = tempfile::tempdir().or_exit(ExitCode::CannotCreate)?;
            let (learner, actor) = peer::certificates(folder.path())?;
            zenoh.listen = vec!["quic/localhost:0".to_owned()];
            zenoh.tls = Some(learner);
            own_and_folder = Some((actor, folder));
        }
        let learner = learner_link(&config, &run_id).or_exit(ExitCode::OsResource)?;
        let (tls, folder) = own_and_folder.unzip();
        let actor = match learner.actor_config() {
            TransportConfig::Zenoh(zenoh) => TransportConfig::Zenoh(ZenohConfig { tls, ..zenoh }),
            other => other,
        };
        Ok(Self {
            learner,
            actor,
            run_id,
            hub: None,
            _folder: folder,
        })
    }

    pub fn publish(
        &mut self,
        version: u64,
        bytes: Arc<[u8]>,
        control: Control,
    ) -> Result<(), Failure> {
        let update = PolicyUpdate {
            version,
            sha256: Sha256::digest(&bytes).into(),
            bytes,
            control,
        };
        self.learner
            .publish_policy(update)
            .or_exit(ExitCode::Internal)
    }

    /// Reads on until the other ends have left, so that none is stuck behind a full window.
    pub fn let_go(&mut self) -> Result<(), Failure> {
        let began = Instant::now();
        while self.learner.stats().peers > 0 && began.elapsed() < LEAVE_MAX {
            self.learner.recv(WAIT).or_exit(ExitCode::Internal)?;
        }
        Ok(())
    }
}

/// Version 1 lets the actors stream, version 2 has them send one frame at a time.
fn link(kind: Kind, args: &TransportBench) -> Result<Speed, Failure> {
    let section = TransportSection {
        max_frame_bytes: u64::from(args.frame_bytes),
        ..TransportSection::default()
    };
    let mut stage = Stage::new(kind, section)?;
    let frame_bytes = args.frame_bytes as usize;
    let mut threads = Vec::new();
    let mut peers = Vec::new();
    for _ in 0..args.actors {
        match &stage.hub {
            Some(hub) => {
                let mut link = hub.actor().or_exit(ExitCode::Internal)?;
                threads.push(std::thread::spawn(move || {
                    peer::stream(&mut *link, frame_bytes)
                }));
            }
            None => peers.push(Peer::start(&Order::Stream {
                transport: stage.actor.clone(),
                run_id: stage.run_id.clone(),
                frame_bytes,
            })?),
        }
    }
    let cpu_s = || -> Result<f64, Failure> {
        Ok(own_cpu_s()? + peers.iter().map(Peer::cpu_s).sum::<f64>())
    };
    stage.publish(1, Arc::default(), Control::Run)?;
    // From the first frame on: a process takes its time to start.
    stage.learner.recv(LEAVE_MAX).or_exit(ExitCode::Internal)?;
    receive(&mut *stage.learner, WARM_UP_S)?;
    let (began, cpu_before) = (Instant::now(), cpu_s()?);
    let frames = receive(&mut *stage.learner, args.common.seconds)?.len() as f64;
    let (seconds, cpu) = (began.elapsed().as_secs_f64(), cpu_s()? - cpu_before);
    stage.publish(2, Arc::default(), Control::Run)?;
    receive(&mut *stage.learner, WARM_UP_S)?;
    let micros = receive(&mut *stage.learner, args.common.seconds)?;
    stage.publish(2, Arc::default(), Control::Stop)?;
    stage.let_go()?;
    for peer in peers {
        peer.finish()?;
    }
    for thread in threads {
        let ended = thread.join();
        ended.map_err(|_| Failure::message(ExitCode::Internal, "an actor panicked"))??;
    }
    Ok(speed(
        kind.name(),
        frame_bytes,
        frames,
        seconds,
        cpu,
        micros,
    ))
}

fn speed(
    what: &'static str,
    frame_bytes: usize,
    frames: f64,
    seconds: f64,
    cpu_s: f64,
    mut micros: Vec<f64>,
) -> Speed {
    micros.sort_by(f64::total_cmp);
    let quantile = |q: f64| {
        let last = micros.len().checked_sub(1)?;
        micros.get((last as f64 * q).round() as usize).copied()
    };
    let gigabytes = frames * frame_bytes as f64 / 1e9;
    Speed {
        what,
        frames_per_s: frames / seconds,
        gigabytes_per_s: gigabytes / seconds,
        latency_p50_us: quantile(0.5),
        latency_p99_us: quantile(0.99),
        cpu_s_per_gigabyte: cpu_s / gigabytes,
    }
}

/// One-way times of the frames that arrive within `seconds`, microseconds.
fn receive(learner: &mut dyn LearnerLink, seconds: f64) -> Result<Vec<f64>, Failure> {
    let began = Instant::now();
    let mut micros = Vec::new();
    while began.elapsed().as_secs_f64() < seconds {
        if let Some(frame) = learner.recv(WAIT).or_exit(ExitCode::Internal)? {
            micros.push(peer::micros_since_stamp(&frame.bytes));
        }
    }
    Ok(micros)
}

/// The same frames over a TCP socket that does nothing else.
fn socket(args: &TransportBench) -> Result<Speed, Failure> {
    let frame_bytes = args.frame_bytes as usize;
    let phase = |paced: bool, warm_up_s: f64| -> Result<(Vec<f64>, f64, f64), Failure> {
        let listener = TcpListener::bind("127.0.0.1:0").or_exit(ExitCode::OsResource)?;
        let address = listener.local_addr().or_exit(ExitCode::OsResource)?;
        let peer = Peer::start(&Order::Socket {
            address,
            frame_bytes,
            paced,
        })?;
        let (mut socket, _) = listener.accept().or_exit(ExitCode::OsResource)?;
        let mut frame = vec![0; frame_bytes];
        let mut read = |seconds: f64| -> Result<Vec<f64>, Failure> {
            let began = Instant::now();
            let mut micros = Vec::new();
            while began.elapsed().as_secs_f64() < seconds {
                socket.read_exact(&mut frame).or_exit(ExitCode::Internal)?;
                micros.push(peer::micros_since_stamp(&frame));
            }
            Ok(micros)
        };
        read(warm_up_s)?;
        let cpu_s = || -> Result<f64, Failure> { Ok(own_cpu_s()? + peer.cpu_s()) };
        let (began, before) = (Instant::now(), cpu_s()?);
        let micros = read(args.common.seconds)?;
        let (seconds, cpu) = (began.elapsed().as_secs_f64(), cpu_s()? - before);
        drop(socket);
        peer.finish()?;
        Ok((micros, seconds, cpu))
    };
    let (streamed, seconds, cpu) = phase(false, WARM_UP_S)?;
    let (micros, _, _) = phase(true, WARM_UP_S)?;
    let frames = streamed.len() as f64;
    Ok(speed(
        "tcp socket",
        frame_bytes,
        frames,
        seconds,
        cpu,
        micros,
    ))
}

/// Copying frames in memory: what no link can beat that copies once.
fn copy(args: &TransportBench) -> Result<Speed, Failure> {
    let from = vec![0x5a_u8; args.frame_bytes as usize];
    let mut to = vec![0_u8; from.len()];
    let (began, before) = (Instant::now(), own_cpu_s()?);
    let mut frames = 0.0;
    while began.elapsed().as_secs_f64() < args.common.seconds.min(1.0) {
        to.copy_from_slice(black_box(&from));
        black_box(&mut to);
        frames += 1.0;
    }
    let (seconds, cpu) = (began.elapsed().as_secs_f64(), own_cpu_s()? - before);
    Ok(speed(
        "memcpy",
        from.len(),
        frames,
        seconds,
        cpu,
        Vec::new(),
    ))
}

/// What one actor collects over each link when it never waits, and what it takes, beside simulator and policy alone. Each link is measured
/// between two measurements of these, several times in turns, so that what else the machine does falls on both; medians.
fn rollouts(kinds: &[Kind], args: &TransportBench) -> Result<(Vec<Rollouts>, Vec<Phase>), Failure> {
    let mut flags = or_quick(&args.config);
    flags.overrides.extend([
        "actors.count=1".to_owned(),
        "actors.threads=1".to_owned(),
        format!("actors.max_lead={LEAD}"),
        format!("learner.staleness.max_lag={LEAD}"),
    ]);
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let model = Arc::new(robot_model::load(&config.robot_path())?);
    let contract = PolicyContract::new(&model, &config.task).or_exit(ExitCode::BadInput)?;
    let scene = Scene {
        flags,
        config,
        model,
        contract,
        seconds: args.common.seconds,
    };
    let mut bares = vec![scene.bare()?];
    let mut of_kinds: Vec<Vec<Rollouts>> = kinds.iter().map(|_| Vec::new()).collect();
    let mut phases = Vec::new();
    for _ in 0..args.rounds {
        for (kind, found) in kinds.iter().zip(&mut of_kinds) {
            let mut rollouts = scene.collected(*kind, &mut phases)?;
            let after = scene.bare()?;
            let before = bares.last().map_or(f64::NAN, |bare| bare.steps_per_cpu_s);
            rollouts.share_of_bare =
                2.0 * rollouts.steps_per_cpu_s / (before + after.steps_per_cpu_s);
            bares.push(after);
            found.push(rollouts);
        }
    }
    let found = std::iter::once(bares)
        .chain(of_kinds)
        .filter_map(|found| medians(&found))
        .collect();
    Ok((found, phases))
}

/// Seconds that the actor's metrics have counted so far, in the order of [`PHASES`].
fn seconds_of_phases(metrics: &Metrics) -> [f64; PHASES.len()] {
    let page = metrics.encode();
    PHASES.map(|(_, metric)| {
        let mut lines = page.lines();
        let value = lines.find_map(|line| line.strip_prefix(metric)?.trim().parse().ok());
        value.unwrap_or(0.0)
    })
}

fn shares(before: [f64; PHASES.len()], after: [f64; PHASES.len()], of_s: f64) -> Vec<Phase> {
    let mut rest = 1.0;
    let mut phases: Vec<Phase> = Vec::new();
    for (i, (what, _)) in PHASES.into_iter().enumerate() {
        let share = (after[i] - before[i]) / of_s;
        rest -= share;
        phases.push(Phase { what, share });
    }
    phases.push(Phase {
        what: "rest",
        share: rest,
    });
    phases
}

/// The median of each figure.
fn medians(found: &[Rollouts]) -> Option<Rollouts> {
    let median = |figure: fn(&Rollouts) -> f64| {
        let mut figures: Vec<f64> = found.iter().map(figure).collect();
        figures.sort_by(f64::total_cmp);
        figures.get(figures.len() / 2).copied()
    };
    Some(Rollouts {
        what: found.first()?.what,
        steps_per_s: median(|r| r.steps_per_s)?,
        steps_per_cpu_s: median(|r| r.steps_per_cpu_s)?,
        share_of_bare: median(|r| r.share_of_bare)?,
    })
}

/// What rollouts are collected of.
struct Scene {
    flags: ConfigArgs,
    config: Config,
    model: Arc<caudata_model::RobotModel>,
    contract: PolicyContract,
    seconds: f64,
}

impl Scene {
    fn policy(&self, run_id: &str, version: u64) -> Result<Vec<u8>, Failure> {
        let hidden = &self.config.learner.network.policy_hidden;
        example_policy(&self.contract, hidden, run_id, version)
    }

    fn bare(&self) -> Result<Rollouts, Failure> {
        let policy = self.policy("bench", 0)?;
        let file = PolicyFile::parse(policy.into()).or_exit(ExitCode::Internal)?;
        bare(&self.config, Arc::clone(&self.model), &file, self.seconds)
    }

    /// Over a link; the share is not known yet. `phases` are filled in for the in-process one.
    fn collected(&self, kind: Kind, phases: &mut Vec<Phase>) -> Result<Rollouts, Failure> {
        let registry = Metrics::new();
        let mut stage = Stage::new(kind, self.config.transport.clone())?;
        let stop = StopFlag::new();
        let mut peers = Vec::new();
        let mut threads = Vec::new();
        match &stage.hub {
            Some(hub) => {
                let link = hub.actor().or_exit(ExitCode::Internal)?;
                let env = build_env(&self.config, Arc::clone(&self.model), 0)
                    .map_err(|error| error.into_failure())?;
                let settings = ActorSettings::from_config(&self.config, &stage.run_id, 0, 0);
                let stop = stop.clone();
                let metrics = ActorMetrics::register(&registry);
                threads.push(std::thread::spawn(move || {
                    caudata_actor::run(&settings, env, link, &stop, &metrics, None, None)
                }));
            }
            None => {
                let program = Programs::beside_this_one()?.find("caudata-actor")?;
                let mut command = Command::new(program);
                command
                    .args(as_flags(&self.flags))
                    .args(["--log-filter", "warn", "--run-id", &stage.run_id])
                    .args(["--transport", &encode_transport(&stage.actor)]);
                peers.push(Peer::of(command)?);
            }
        }
        let mut version = 0;
        let policy = self.policy(&stage.run_id, version)?;
        stage.publish(version, policy.into(), Control::Run)?;
        let mut collect = |stage: &mut Stage, seconds: f64| -> Result<(f64, f64), Failure> {
            let began = Instant::now();
            let mut steps = 0;
            // Making policies is the learner's work, not that of collecting.
            let mut making_s = 0.0;
            while began.elapsed().as_secs_f64() < seconds {
                let Some(frame) = stage.learner.recv(WAIT).or_exit(ExitCode::Internal)? else {
                    continue;
                };
                let checked = decode(&frame.bytes, &DecodeLimits::default());
                if let Envelope::Chunk(chunk) = checked.or_exit(ExitCode::Internal)? {
                    steps += chunk.steps * chunk.lanes;
                    // As in training: a policy per quota, here of made-up weights.
                    version += 1;
                    let before = thread_cpu_s()?;
                    let policy = self.policy(&stage.run_id, version)?;
                    making_s += thread_cpu_s()? - before;
                    stage.publish(version, policy.into(), Control::Run)?;
                }
            }
            Ok((steps as f64, making_s))
        };
        // From the first chunk on: a program takes its time to start.
        let started = Instant::now();
        while collect(&mut stage, WARM_UP_S)?.0 == 0.0 {
            if started.elapsed() > LEAVE_MAX {
                let message = format!("no rollouts came over {}", kind.name());
                return Err(Failure::message(ExitCode::TempFail, message));
            }
        }
        collect(&mut stage, WARM_UP_S)?;
        let cpu_s = || -> Result<f64, Failure> {
            Ok(own_cpu_s()? + peers.iter().map(Peer::cpu_s).sum::<f64>())
        };
        let (began, before) = (Instant::now(), cpu_s()?);
        let counted = seconds_of_phases(&registry);
        let (steps, made_s) = collect(&mut stage, self.seconds)?;
        let wall_s = began.elapsed().as_secs_f64();
        let cpu = cpu_s()? - before - made_s;
        if kind == Kind::Inproc {
            *phases = shares(counted, seconds_of_phases(&registry), wall_s);
        }
        stage.publish(version, Arc::default(), Control::Stop)?;
        stage.let_go()?;
        for peer in peers {
            peer.finish()?;
        }
        for thread in threads {
            let ended = thread.join();
            ended
                .map_err(|_| Failure::message(ExitCode::Internal, "an actor panicked"))?
                .map_err(|error| error.into_failure())?;
        }
        Ok(Rollouts {
            what: kind.name(),
            steps_per_s: steps / wall_s,
            steps_per_cpu_s: steps / cpu,
            share_of_bare: f64::NAN,
        })
    }
}

/// Simulator, policy and exploration alone, on one thread.
fn bare(
    config: &Config,
    model: Arc<caudata_model::RobotModel>,
    file: &PolicyFile,
    seconds: f64,
) -> Result<Rollouts, Failure> {
    let mut env = build_env(config, model, 0).map_err(|error| error.into_failure())?;
    env.reset_all().or_exit(ExitCode::Internal)?;
    let mut inference = Inference::new(file, 1).or_exit(ExitCode::NoInput)?;
    let lanes = env.lanes();
    let width = env.act_dim();
    let (mut means, mut actions) = (vec![0.0; lanes * width], vec![0.0; lanes * width]);
    let std = vec![1.0_f32; width];
    let mut step = || -> Result<(), Failure> {
        inference
            .run(env.observations(), lanes, &mut means)
            .or_exit(ExitCode::Internal)?;
        for lane in 0..lanes {
            let row = lane * width..(lane + 1) * width;
            let action = &mut actions[row.clone()];
            gaussian::sample(&means[row], &std, env.action_stream(lane), action);
        }
        env.step(&actions).map(|_| ()).or_exit(ExitCode::Internal)
    };
    let mut steps_in = |seconds: f64| -> Result<f64, Failure> {
        let began = Instant::now();
        let mut steps = 0;
        while began.elapsed().as_secs_f64() < seconds {
            step()?;
            steps += lanes;
        }
        Ok(steps as f64)
    };
    steps_in(WARM_UP_S)?;
    let (began, before) = (Instant::now(), own_cpu_s()?);
    let steps = steps_in(seconds)?;
    let (wall_s, cpu) = (began.elapsed().as_secs_f64(), own_cpu_s()? - before);
    Ok(Rollouts {
        what: "bare",
        steps_per_s: steps / wall_s,
        steps_per_cpu_s: steps / cpu,
        share_of_bare: 1.0,
    })
}
