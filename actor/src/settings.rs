//! What an actor is told, and how its environments are made.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use caudata_config::{Config, World};
use caudata_env::VecEnv;
use caudata_model::RobotModel;
use caudata_telemetry::traces::{TraceError, TraceSettings, Tracer};
use caudata_telemetry::{Metrics, build_info};

use crate::{ActorError, Retunes};

/// What an actor is told. All of it comes from the configuration except who it is.
#[derive(Clone, Debug)]
pub struct ActorSettings {
    /// The training run.
    pub run_id: String,
    /// Number within the run, from 0.
    pub actor_id: u32,
    /// How many times this actor was started before.
    pub incarnation: u64,
    /// Where it acts.
    pub world: World,
    /// Steps per chunk, T.
    pub chunk_steps: usize,
    /// Chunks per policy version.
    pub chunks_per_version: u32,
    /// Quotas that may be collected ahead.
    pub max_lead: u32,
    /// Whether a policy is taken only when the quotas of the one before are collected.
    pub lockstep: bool,
    /// Longest wait for a policy, or for the learner to come back.
    pub policy_timeout: Duration,
    /// Longest wait at the end for the learner to take what was sent.
    pub flush_timeout: Duration,
    /// File with the count of chunks sent.
    pub ledger: Option<PathBuf>,
    /// Version and commit of this program, for the learner's log.
    pub build: String,
    /// Where traces go.
    pub traces: Tracer,
    /// What a learner in this process changes of the task.
    pub retunes: Retunes,
}

impl ActorSettings {
    /// Settings of actor `actor_id` as the configuration has them.
    pub fn from_config(config: &Config, run_id: &str, actor_id: u32, incarnation: u64) -> Self {
        let actors = &config.actors;
        let build = build_info();
        Self {
            run_id: run_id.to_owned(),
            actor_id,
            incarnation,
            world: config.world(),
            chunk_steps: actors.chunk_steps as usize,
            chunks_per_version: actors.chunks_per_version,
            max_lead: actors.max_lead,
            lockstep: actors.lockstep,
            policy_timeout: Duration::from_secs_f64(actors.policy_timeout_s),
            flush_timeout: Duration::from_secs_f64(actors.flush_timeout_s),
            ledger: None,
            build: format!("{}, {}", build.version, build.code),
            traces: Tracer::off(),
            retunes: Retunes::default(),
        }
    }
}

/// The tracer of a process, of a role and with a name, as the configuration has it: off where it names no collector.
pub fn tracer_of(
    config: &Config,
    (role, service): (&str, &'static str),
    instance: String,
    run_id: &str,
    metrics: &Metrics,
) -> Result<Tracer, TraceError> {
    let telemetry = &config.telemetry;
    if telemetry.otlp_endpoint.is_empty() {
        return Ok(Tracer::off());
    }
    let settings = TraceSettings {
        endpoint: telemetry.otlp_endpoint.clone(),
        every: telemetry.trace_every.into(),
        tls_dir: config.cluster.certificates(role),
        service,
        instance,
        run_id: run_id.to_owned(),
    };
    Tracer::start(&settings, metrics)
}

/// The actor number in the keys of the random streams: every incarnation draws its own episodes, so that a
/// restarted actor does not collect the same ones again.
pub fn actor_key(actor_id: u32, incarnation: u64) -> u64 {
    (incarnation << 32) | u64::from(actor_id)
}

/// Actor and first lane in the keys of the random streams. In lockstep the lanes of all actors are numbered
/// through and the actor's number tells nothing apart, so that it does not matter which actor steps a lane.
fn stream_keys(config: &Config, actor_key: u64) -> (u64, u64) {
    if !config.actors.lockstep {
        return (actor_key, 0);
    }
    let (incarnation, id) = (actor_key >> 32, actor_key & u64::from(u32::MAX));
    (incarnation << 32, id * u64::from(config.actors.lanes))
}

/// The environments of one actor: engine, terrain and task as configured. `actor_key` comes from
/// [`actor_key`], or from a saved actor that goes on.
///
/// All actors share the run's terrain, which is drawn from the run's seed.
///
/// # Errors
/// The engine refuses the robot or its settings, or the task refuses its own.
pub fn build_env(
    config: &Config,
    model: Arc<RobotModel>,
    actor_key: u64,
) -> Result<VecEnv, ActorError> {
    let engine = caudata_sim::build(
        Arc::clone(&model),
        config.actors.lanes as usize,
        &config.engine,
        &config.terrain,
        config.run.seed,
        config.actors.threads as usize,
    )
    .map_err(|error| ActorError::Env(error.into()))?;
    let (actor, first_lane) = stream_keys(config, actor_key);
    Ok(VecEnv::from_lane(model, config.task.clone(), engine, config.run.seed, actor, first_lane)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn in_lockstep_lanes_are_numbered_through() {
        let keys = |lockstep: &str, id, incarnation| {
            let source = caudata_config::Source::default().set("actors.lanes=8").set(lockstep);
            stream_keys(&Config::load(&source).unwrap(), actor_key(id, incarnation))
        };
        assert_eq!(keys("actors.lockstep=true", 0, 0), (0, 0));
        assert_eq!(keys("actors.lockstep=true", 3, 0), (0, 24));
        // A restarted actor steps the same lanes and draws other episodes.
        assert_eq!(keys("actors.lockstep=true", 3, 2), (2 << 32, 24));
        assert_eq!(keys("actors.lockstep=false", 3, 2), (actor_key(3, 2), 0));
    }

    #[test]
    fn each_incarnation_has_its_own_key() {
        assert_eq!(actor_key(3, 0), 3);
        assert_eq!(actor_key(3, 1), (1 << 32) + 3);
        assert_ne!(actor_key(4, 1), actor_key(3, 1));
    }
}
