//! The rules that values obey, alone and together. One line per rule, in the order of the file.

use std::fmt::Display;

use crate::{Config, ConfigError};

type Check = Result<(), ConfigError>;

fn within<T: PartialOrd + Display>(key: &'static str, value: T, low: T, high: T) -> Check {
    // Written so that NaN fails.
    if value >= low && value <= high {
        return Ok(());
    }
    broken(key, value, format!("must lie in {low} to {high}"))
}

/// Above 0, to `high`.
fn positive(key: &'static str, value: f64, high: f64) -> Check {
    if value > 0.0 && value <= high {
        return Ok(());
    }
    broken(key, value, format!("must be above 0 and at most {high}"))
}

fn broken(key: &'static str, value: impl Display, rule: impl Into<String>) -> Check {
    Err(ConfigError::OutOfRange {
        key,
        value: value.to_string(),
        rule: rule.into(),
    })
}

fn word(key: &'static str, value: &str, longest: usize, extra: &str) -> Check {
    let allowed = |c: char| c.is_ascii_alphanumeric() || extra.contains(c);
    if (1..=longest).contains(&value.len()) && value.chars().all(allowed) {
        return Ok(());
    }
    let rule = format!("must be 1 to {longest} letters, digits or any of `{extra}`");
    broken(key, format!("{value:?}"), rule)
}

impl Config {
    /// Checks every value's range and that the sections fit each other.
    ///
    /// # Errors
    /// [`ConfigError::OutOfRange`] or [`ConfigError::Section`] for the first rule that is broken.
    pub fn validate(&self) -> Check {
        self.check_run()?;
        self.check_actors()?;
        self.check_learner()?;
        self.check_network()?;
        self.check_ppo()?;
        self.check_staleness()?;
        self.check_physics()?;
        self.check_transport()?;
        self.check_cluster()?;
        self.check_services()
    }

    fn check_cluster(&self) -> Check {
        let cluster = &self.cluster;
        if !cluster.run_id.is_empty() {
            word("cluster.run_id", &cluster.run_id, 64, "-_.")?;
        }
        within(
            "cluster.hang_timeout_s",
            cluster.hang_timeout_s,
            1.0,
            3_600.0,
        )?;
        within("cluster.learner_ranks", cluster.learner_ranks, 1, 64)?;
        let address = cluster.rank_address.rsplit_once(':');
        if !address.is_some_and(|(host, port)| {
            !host.is_empty() && port.parse::<u16>().is_ok_and(|port| port > 0)
        }) {
            let value = format!("{:?}", cluster.rank_address);
            return broken("cluster.rank_address", value, "must be host:port");
        }
        let (join, answer) = (cluster.rank_join_timeout_s, cluster.rank_timeout_s);
        positive("cluster.rank_join_timeout_s", join, 86_400.0)?;
        positive("cluster.rank_timeout_s", answer, 3_600.0)
    }

    fn check_run(&self) -> Check {
        let run = &self.run;
        word("run.name", &run.name, 40, "-_")?;
        within("run.seed", run.seed, 0, i64::MAX as u64)?;
        within("run.iterations", run.iterations, 1, 10_000_000)?;
        let evaluation = &self.evaluation;
        within("evaluation.episodes", evaluation.episodes, 0, 10_000)?;
        within("evaluation.robot_run_s", evaluation.robot_run_s, 0.0, 600.0)?;
        within(
            "evaluation.robot_command_mps",
            evaluation.robot_command_mps,
            -1.0,
            1.0,
        )
    }

    fn check_actors(&self) -> Check {
        let actors = &self.actors;
        within("actors.count", actors.count, 1, 1_024)?;
        within("actors.lanes", actors.lanes, 1, 65_536)?;
        within("actors.chunk_steps", actors.chunk_steps, 1, 1_024)?;
        within(
            "actors.chunks_per_version",
            actors.chunks_per_version,
            1,
            64,
        )?;
        within("actors.max_lead", actors.max_lead, 0, 8)?;
        within("actors.threads", actors.threads, 1, 256)?;
        within("actors.inference_threads", actors.inference_threads, 1, 64)?;
        positive("actors.policy_timeout_s", actors.policy_timeout_s, 86_400.0)?;
        positive("actors.flush_timeout_s", actors.flush_timeout_s, 600.0)?;
        within(
            "actors.restarts_per_minute",
            actors.restarts_per_minute,
            0,
            60,
        )
    }

    fn check_learner(&self) -> Check {
        let learner = &self.learner;
        within("learner.threads", learner.threads, 1, 256)?;
        within("learner.publish_every", learner.publish_every, 1, 1_000_000)?;
        within(
            "learner.checkpoint_every",
            learner.checkpoint_every,
            1,
            1_000_000,
        )?;
        within(
            "learner.keep_checkpoints",
            learner.keep_checkpoints,
            1,
            10_000,
        )?;
        within(
            "learner.warm_start.value_only_iterations",
            learner.warm_start.value_only_iterations,
            0,
            100_000,
        )?;
        within(
            "learner.warm_start.least_std",
            learner.warm_start.least_std,
            0.0,
            5.0,
        )?;
        positive("learner.batch_timeout_s", learner.batch_timeout_s, 86_400.0)?;
        positive("learner.min_batch_share", learner.min_batch_share, 1.0)?;
        let (shortest, starve) = (learner.batch_timeout_s, learner.starve_timeout_s);
        within("learner.starve_timeout_s", starve, shortest, 86_400.0)
    }

    fn check_network(&self) -> Check {
        let network = &self.learner.network;
        let layers = |key, hidden: &[u32]| {
            if !(1..=8).contains(&hidden.len()) || hidden.iter().any(|n| !(1..=4_096).contains(n)) {
                return broken(
                    key,
                    format!("{hidden:?}"),
                    "must be 1 to 8 layers of 1 to 4096 units",
                );
            }
            Ok(())
        };
        layers("learner.network.policy_hidden", &network.policy_hidden)?;
        layers("learner.network.value_hidden", &network.value_hidden)?;
        positive("learner.network.std_min", network.std_min, 10.0)?;
        within(
            "learner.network.std_max",
            network.std_max,
            network.std_min,
            10.0,
        )?;
        within(
            "learner.network.init_std",
            network.init_std,
            network.std_min,
            network.std_max,
        )?;
        within(
            "learner.network.observation_clip",
            network.observation_clip,
            1.0,
            100.0,
        )
    }

    fn check_ppo(&self) -> Check {
        let ppo = &self.learner.ppo;
        within("learner.ppo.epochs", ppo.epochs, 1, 100)?;
        within("learner.ppo.minibatches", ppo.minibatches, 1, 1_024)?;
        if !(0.0..1.0).contains(&ppo.gamma) {
            return broken(
                "learner.ppo.gamma",
                ppo.gamma,
                "must be at least 0 and below 1",
            );
        }
        within("learner.ppo.lambda", ppo.lambda, 0.0, 1.0)?;
        if !(ppo.clip > 0.0 && ppo.clip < 1.0) {
            return broken("learner.ppo.clip", ppo.clip, "must be above 0 and below 1");
        }
        within(
            "learner.ppo.value_loss_weight",
            ppo.value_loss_weight,
            0.0,
            100.0,
        )?;
        within("learner.ppo.entropy_weight", ppo.entropy_weight, 0.0, 1.0)?;
        positive("learner.ppo.max_grad_norm", ppo.max_grad_norm, 1_000.0)?;
        positive("learner.ppo.learning_rate_min", ppo.learning_rate_min, 1.0)?;
        let (low, high) = (ppo.learning_rate_min, ppo.learning_rate_max);
        within("learner.ppo.learning_rate_max", high, low, 1.0)?;
        within("learner.ppo.learning_rate", ppo.learning_rate, low, high)?;
        within("learner.ppo.target_kl", ppo.target_kl, 0.0, 1.0)?;
        within(
            "learner.ppo.target_kl_final",
            ppo.target_kl_final,
            0.0,
            ppo.target_kl,
        )?;
        let value_rate = ppo.value_learning_rate;
        within("learner.ppo.value_learning_rate", value_rate, 0.0, 1.0)?;
        let samples = self.actors.steps_per_iteration();
        if u64::from(ppo.minibatches) > samples {
            let rule = format!("must not exceed the {samples} steps of an iteration");
            return broken("learner.ppo.minibatches", ppo.minibatches, rule);
        }
        Ok(())
    }

    fn check_staleness(&self) -> Check {
        let staleness = &self.learner.staleness;
        let lead = u64::from(self.actors.max_lead);
        if staleness.max_lag < lead {
            let rule =
                format!("must be at least actors.max_lead = {lead}, or all early work is dropped");
            return broken("learner.staleness.max_lag", staleness.max_lag, rule);
        }
        within("learner.staleness.max_lag", staleness.max_lag, 0, 1_000)?;
        within("learner.staleness.rho_max", staleness.rho_max, 0.1, 10.0)?;
        within("learner.staleness.c_max", staleness.c_max, 0.1, 10.0)?;
        within(
            "learner.staleness.weight_max",
            staleness.weight_max,
            1.0,
            100.0,
        )?;
        let share = staleness.min_effective_share;
        within("learner.staleness.min_effective_share", share, 0.0, 1.0)
    }

    fn check_physics(&self) -> Check {
        let section = |section, error: &dyn Display| ConfigError::Section {
            section,
            message: error.to_string(),
        };
        self.engine
            .validate()
            .map_err(|error| section("engine", &error))?;
        self.task
            .validate()
            .map_err(|error| section("task", &error))?;
        let (physics, policy) = (self.engine.control_period_s(), self.task.control_period_s);
        if (physics - policy).abs() > 1e-6 {
            let rule = format!(
                "must be engine.dt_s × engine.substeps = {physics}, so that one action lasts one control period"
            );
            return broken("task.control_period_s", policy, rule);
        }
        Ok(())
    }

    fn check_transport(&self) -> Check {
        /// 256 MiB, the transports' own bound.
        const BYTES_MAX: u64 = 256 << 20;
        let transport = &self.transport;
        within(
            "transport.max_frame_bytes",
            transport.max_frame_bytes,
            1,
            BYTES_MAX,
        )?;
        within(
            "transport.max_policy_bytes",
            transport.max_policy_bytes,
            1,
            BYTES_MAX,
        )?;
        within("transport.window_frames", transport.window_frames, 1, 1_024)?;
        within(
            "transport.max_actors",
            transport.max_actors,
            self.actors.count,
            1_024,
        )?;
        within(
            "transport.max_frames_per_s",
            transport.max_frames_per_s,
            0,
            100_000,
        )?;
        within("transport.heartbeat_ms", transport.heartbeat_ms, 10, 60_000)?;
        let silence = transport.peer_timeout_ms;
        within(
            "transport.peer_timeout_ms",
            silence,
            3 * transport.heartbeat_ms,
            3_600_000,
        )
    }

    fn check_services(&self) -> Check {
        within(
            "policy_server.keep_versions",
            self.policy_server.keep_versions,
            1,
            100_000,
        )?;
        let stream = self.policy_server.stream.as_str();
        if !stream.is_empty() {
            word("policy_server.stream", stream, 64, "-_.")?;
        }
        self.check_telemetry()
    }

    fn check_telemetry(&self) -> Check {
        let telemetry = &self.telemetry;
        within("telemetry.trace_every", telemetry.trace_every, 1, 1_000_000)?;
        let endpoint = telemetry.otlp_endpoint.as_str();
        let rule = match endpoint.split_once("://") {
            _ if endpoint.is_empty() => return Ok(()),
            Some(("http", address)) if is_loopback(address) => return Ok(()),
            Some(("http", _)) => {
                "is plain and leaves this host: take a collector on this host, or https:// with cluster.tls_dir"
            }
            Some(("https", _)) if self.cluster.certificates().is_none() => {
                "needs certificates: set cluster.tls_dir"
            }
            Some(("https", address)) if has_port(address) => return Ok(()),
            _ => "must be http://HOST:PORT on this host, https://HOST:PORT, or empty",
        };
        broken("telemetry.otlp_endpoint", format!("{endpoint:?}"), rule)
    }
}

/// Whether `host:port` is on this host. A name other than `localhost` may lead anywhere.
fn is_loopback(address: &str) -> bool {
    match address.parse::<std::net::SocketAddr>() {
        Ok(address) => address.ip().is_loopback(),
        Err(_) => has_port(address) && address.starts_with("localhost:"),
    }
}

fn has_port(address: &str) -> bool {
    address
        .rsplit_once(':')
        .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok())
}
