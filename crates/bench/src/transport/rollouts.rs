//! What collecting rollouts costs over each link, beside the bare simulator and policy.

use std::process::Command;
use std::sync::Arc;
use std::time::Instant;

use caudata_actor::{ActorMetrics, ActorSettings, Network, build_env, encode_transport, gaussian};
use caudata_config::{Config, ConfigArgs};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_proto::{DecodeLimits, Envelope, RolloutChunk, decode};
use caudata_studies::{files, flags};
use caudata_task::PolicyContract;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Metrics, StopFlag};
use caudata_transport::{Control, Frame};
use serde::Serialize;

use super::peer::Peer;
use super::plan::{FindActor, Kind, LEAVE_MAX, Plan, WAIT, WARM_UP_S};
use super::stage::{Ends, Stage};
use crate::measure::{Cost, median, own_cpu_s, thread_cpu_s, until};
use crate::parts::example_policy;

/// Quotas that measured actors may be ahead: so many that they never wait for a policy.
const LEAD: u32 = 8;

/// What collecting costs.
#[derive(Clone, Debug, Serialize)]
pub struct Rollouts {
    /// Which link, or `bare`.
    pub what: &'static str,
    /// Environment steps per second.
    pub steps_per_s: f64,
    /// CPU time of the actor and of the learner's receiving and checking.
    pub steps_per_cpu_s: f64,
    /// Share of what the bare simulator and policy do.
    pub share_of_bare: f64,
}

/// What one actor collects over each link when it never waits, and what it takes, beside simulator and policy
/// alone. Each link is measured between two measurements of these, several times in turns, so that what else
/// the machine does falls on both; medians.
pub fn all(kinds: &[Kind], plan: &Plan, actor: FindActor<'_>) -> Result<Vec<Rollouts>, Failure> {
    let mut flags = flags::or_preset(&plan.config, "quick");
    flags.overrides.extend([
        "actors.count=1".to_owned(),
        "actors.threads=1".to_owned(),
        format!("actors.max_lead={LEAD}"),
        format!("learner.staleness.max_lag={LEAD}"),
    ]);
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let model = Arc::new(files::robot(&config.robot_path())?);
    let contract = PolicyContract::new(&model, &config.task).or_exit(ExitCode::BadInput)?;
    let scene = Scene { flags, config, model, contract, seconds: plan.time.seconds };
    let mut bares = vec![scene.bare()?];
    let mut of_kinds: Vec<Vec<Rollouts>> = kinds.iter().map(|_| Vec::new()).collect();
    for _ in 0..plan.rounds {
        for (kind, found) in kinds.iter().zip(&mut of_kinds) {
            let mut rollouts = scene.collected(*kind, actor)?;
            let after = scene.bare()?;
            let before = bares.last().map_or(f64::NAN, |bare| bare.steps_per_cpu_s);
            rollouts.share_of_bare =
                2.0 * rollouts.steps_per_cpu_s / (before + after.steps_per_cpu_s);
            bares.push(after);
            found.push(rollouts);
        }
    }
    let found = std::iter::once(bares).chain(of_kinds);
    Ok(found.filter_map(|found| medians(&found)).collect())
}

/// The median of each figure.
fn medians(found: &[Rollouts]) -> Option<Rollouts> {
    let of = |figure: fn(&Rollouts) -> f64| median(found.iter().map(figure).collect());
    Some(Rollouts {
        what: found.first()?.what,
        steps_per_s: of(|r| r.steps_per_s)?,
        steps_per_cpu_s: of(|r| r.steps_per_cpu_s)?,
        share_of_bare: of(|r| r.share_of_bare)?,
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

    /// Over a link; the share is not known yet.
    fn collected(&self, kind: Kind, actor: FindActor<'_>) -> Result<Rollouts, Failure> {
        let mut stage = Stage::new(kind, self.config.transport.clone())?;
        let ends = self.actor(&stage, actor)?;
        let mut version = 0;
        let policy = self.policy(&stage.run_id, version)?;
        stage.publish(version, policy.into(), Control::Run)?;
        // From the first chunk on: a program takes its time to start.
        let started = Instant::now();
        while self.collect(&mut stage, &mut version, WARM_UP_S)?.0 == 0.0 {
            if started.elapsed() > LEAVE_MAX {
                let message = format!("no rollouts came over {}", kind.name());
                return Err(Failure::message(ExitCode::TempFail, message));
            }
        }
        self.collect(&mut stage, &mut version, WARM_UP_S)?;
        let ((steps, made_s), cost) =
            Cost::of(|| ends.cpu_s(), || self.collect(&mut stage, &mut version, self.seconds))?;
        stage.publish(version, Arc::default(), Control::Stop)?;
        stage.let_go()?;
        ends.finish()?;
        Ok(Rollouts {
            what: kind.name(),
            steps_per_s: steps / cost.wall_s,
            steps_per_cpu_s: steps / (cost.cpu_s - made_s),
            share_of_bare: f64::NAN,
        })
    }

    /// The actor: a thread on a link within this process, else the program.
    fn actor(&self, stage: &Stage, program: FindActor<'_>) -> Result<Ends, Failure> {
        let mut ends = Ends::default();
        let Some(hub) = &stage.hub else {
            let mut command = Command::new(program()?);
            command
                .args(flags::as_words(&self.flags))
                .args(["--log-filter", "warn", "--run-id", &stage.run_id])
                .args(["--transport", &encode_transport(&stage.actor)]);
            ends.peers.push(Peer::of(command)?);
            return Ok(ends);
        };
        let link = hub.actor().or_exit(ExitCode::Internal)?;
        let env = build_env(&self.config, Arc::clone(&self.model), 0)
            .map_err(|error| error.into_failure())?;
        let settings = ActorSettings::from_config(&self.config, &stage.run_id, 0, 0);
        let (stop, metrics) = (StopFlag::new(), ActorMetrics::register(&Metrics::new()));
        ends.thread(move || {
            caudata_actor::run(&settings, env, link, &stop, &metrics, None, None)
                .map(|_| ())
                .map_err(|error| error.into_failure())
        });
        Ok(ends)
    }

    /// Steps that arrive within `seconds`, and the CPU time that making policies took.
    fn collect(
        &self,
        stage: &mut Stage,
        version: &mut u64,
        seconds: f64,
    ) -> Result<(f64, f64), Failure> {
        let (mut steps, mut making_s) = (0, 0.0);
        until(seconds, || {
            let Some(frame) = stage.learner.recv(WAIT).or_exit(ExitCode::Internal)? else {
                return Ok(());
            };
            if let Some(chunk) = chunk_of(frame)? {
                steps += chunk.steps * chunk.lanes;
                // As in training: a policy per quota, here of made-up weights. Making it is the learner's
                // work, not that of collecting.
                *version += 1;
                let before = thread_cpu_s()?;
                let policy = self.policy(&stage.run_id, *version)?;
                making_s += thread_cpu_s()? - before;
                stage.publish(*version, policy.into(), Control::Run)?;
            }
            Ok(())
        })?;
        Ok((steps as f64, making_s))
    }
}

/// The chunk of a frame, checked; `None` for a greeting.
fn chunk_of(frame: Frame) -> Result<Option<RolloutChunk>, Failure> {
    let limits = DecodeLimits::default();
    let value = frame.value.map(|value| value.content.downcast::<RolloutChunk>());
    if let Some(Ok(chunk)) = value {
        chunk.check(&limits).or_exit(ExitCode::Internal)?;
        return Ok(Some(*chunk));
    }
    match decode(&frame.bytes, &limits).or_exit(ExitCode::Internal)? {
        Envelope::Chunk(chunk) => Ok(Some(*chunk)),
        _ => Ok(None),
    }
}

/// Simulator, policy and exploration alone, on one thread.
fn bare(
    config: &Config,
    model: Arc<RobotModel>,
    file: &PolicyFile,
    seconds: f64,
) -> Result<Rollouts, Failure> {
    let mut env = build_env(config, model, 0).map_err(|error| error.into_failure())?;
    env.reset_all().or_exit(ExitCode::Internal)?;
    let mut network = Network::new(file.spec(), env.mirror());
    let lanes = env.lanes();
    let width = env.act_dim();
    let (mut means, mut actions) = (vec![0.0; lanes * width], vec![0.0; lanes * width]);
    let std = vec![1.0_f32; width];
    let mut steps_in = |seconds: f64| -> Result<f64, Failure> {
        let mut steps = 0;
        until(seconds, || {
            network.run(env.observations(), lanes, &mut means);
            for lane in 0..lanes {
                let row = lane * width..(lane + 1) * width;
                let action = &mut actions[row.clone()];
                gaussian::sample(&means[row], &std, env.action_stream(lane), action);
            }
            steps += lanes;
            env.step(&actions).map(|_| ()).or_exit(ExitCode::Internal)
        })?;
        Ok(steps as f64)
    };
    steps_in(WARM_UP_S)?;
    let (steps, cost) = Cost::of(own_cpu_s, || steps_in(seconds))?;
    Ok(Rollouts {
        what: "bare",
        steps_per_s: steps / cost.wall_s,
        steps_per_cpu_s: steps / cost.cpu_s,
        share_of_bare: 1.0,
    })
}
