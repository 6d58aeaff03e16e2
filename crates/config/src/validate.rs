//! The rules that values obey, alone and together. One line per rule, in the order of the file.

use std::fmt::Display;

use crate::{Config, ConfigError, TransportKind};

type Check = Result<(), ConfigError>;

const NO_CERTIFICATES: &str = "needs certificates: set cluster.tls_dir";

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
    Err(ConfigError::OutOfRange { key, value: value.to_string(), rule: rule.into() })
}

fn word(key: &'static str, value: &str, longest: usize, extra: &str) -> Check {
    let allowed = |c: char| c.is_ascii_alphanumeric() || extra.contains(c);
    if (1..=longest).contains(&value.len()) && value.chars().all(allowed) {
        return Ok(());
    }
    let rule = format!("must be 1 to {longest} letters, digits or any of `{extra}`");
    broken(key, format!("{value:?}"), rule)
}

/// The range that the value of a key lies in: `a.b in low, high`, or `a.b to high`, which is above 0.
macro_rules! rule {
    ($config:ident, $($key:ident).+ in $low:expr, $high:expr) => {
        within(key!($($key).+), $config.$($key).+, $low, $high)?
    };
    ($config:ident, $($key:ident).+ to $high:expr) => {
        positive(key!($($key).+), $config.$($key).+, $high)?
    };
}

/// The path of a field as the key that it has in the file.
macro_rules! key {
    ($first:ident $(. $rest:ident)*) => {
        concat!(stringify!($first) $(, ".", stringify!($rest))*)
    };
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
        rule!(self, cluster.hang_timeout_s in 1.0, 3_600.0);
        Ok(())
    }

    fn check_run(&self) -> Check {
        word("run.name", &self.run.name, crate::derive::MOST_OF_A_NAME, "-_")?;
        rule!(self, run.seed in 0, i64::MAX as u64);
        rule!(self, run.iterations in 1, 10_000_000);
        rule!(self, evaluation.episodes in 0, 10_000);
        rule!(self, evaluation.choose_from in 0, 64);
        rule!(self, evaluation.robot_run_s in 0.0, 600.0);
        rule!(self, evaluation.robot_command_mps in -5.0, 5.0);
        rule!(self, evaluation.command_mps to 5.0);
        rule!(self, evaluation.gates.speed_share in 0.0, 1.0);
        rule!(self, evaluation.gates.stride_off_clock in 0.0, 100.0);
        rule!(self, evaluation.gates.power_w in 0.0, 1e6);
        rule!(self, evaluation.gates.trunk_contact_share in 0.0, 1.0);
        rule!(self, evaluation.gates.slip_mps in 0.0, 100.0);
        rule!(self, evaluation.gates.clearance_m in 0.0, 10.0);
        rule!(self, evaluation.gates.vibration_share in 0.0, 1.0);
        rule!(self, evaluation.gates.yaw_off_radps in 0.0, 100.0);
        rule!(self, evaluation.gates.vibration_hz to 1_000.0);
        let [least, most] = self.evaluation.gates.duty_factor;
        match 0.0 <= least && least <= most && most <= 1.0 {
            true => Ok(()),
            false => broken(
                "evaluation.gates.duty_factor",
                format!("[{least}, {most}]"),
                "must be [min, max] within 0 to 1",
            ),
        }
    }

    fn check_actors(&self) -> Check {
        rule!(self, actors.count in 1, 1_024);
        rule!(self, actors.lanes in 1, 65_536);
        rule!(self, actors.chunk_steps in 1, 1_024);
        rule!(self, actors.chunks_per_version in 1, 64);
        rule!(self, actors.max_lead in 0, 8);
        rule!(self, actors.threads in 1, 256);
        rule!(self, actors.policy_timeout_s to 86_400.0);
        rule!(self, actors.flush_timeout_s to 600.0);
        rule!(self, actors.restarts_per_minute in 0, 60);
        Ok(())
    }

    fn check_learner(&self) -> Check {
        rule!(self, learner.threads in 1, 256);
        rule!(self, learner.publish_every in 1, 1_000_000);
        rule!(self, learner.checkpoint_every in 1, 1_000_000);
        rule!(self, learner.keep_checkpoints in 1, 10_000);
        rule!(self, learner.warm_start.value_only_iterations in 0, 100_000);
        rule!(self, learner.warm_start.least_std in 0.0, 5.0);
        rule!(self, learner.teacher.weight in 0.0, 1000.0);
        rule!(self, learner.batch_timeout_s to 86_400.0);
        rule!(self, learner.min_batch_share to 1.0);
        rule!(self, learner.starve_timeout_s in self.learner.batch_timeout_s, 86_400.0);
        Ok(())
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
        rule!(self, learner.network.std_min to 10.0);
        rule!(self, learner.network.std_max in network.std_min, 10.0);
        rule!(self, learner.network.init_std in network.std_min, network.std_max);
        rule!(self, learner.network.observation_clip in 1.0, 100.0);
        Ok(())
    }

    fn check_ppo(&self) -> Check {
        let ppo = &self.learner.ppo;
        rule!(self, learner.ppo.epochs in 1, 100);
        rule!(self, learner.ppo.minibatches in 1, 1_024);
        if !(0.0..1.0).contains(&ppo.gamma) {
            return broken("learner.ppo.gamma", ppo.gamma, "must be at least 0 and below 1");
        }
        rule!(self, learner.ppo.lambda in 0.0, 1.0);
        if !(ppo.clip > 0.0 && ppo.clip < 1.0) {
            return broken("learner.ppo.clip", ppo.clip, "must be above 0 and below 1");
        }
        rule!(self, learner.ppo.value_loss_weight in 0.0, 100.0);
        rule!(self, learner.ppo.entropy_weight in 0.0, 1.0);
        rule!(self, learner.ppo.max_grad_norm to 1_000.0);
        rule!(self, learner.ppo.learning_rate_min to 1.0);
        rule!(self, learner.ppo.learning_rate_max in ppo.learning_rate_min, 1.0);
        rule!(self, learner.ppo.learning_rate in ppo.learning_rate_min, ppo.learning_rate_max);
        rule!(self, learner.ppo.target_kl in 0.0, 1.0);
        rule!(self, learner.ppo.target_kl_final in 0.0, ppo.target_kl);
        rule!(self, learner.ppo.value_learning_rate in 0.0, 1.0);
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
        rule!(self, learner.staleness.max_lag in 0, 1_000);
        rule!(self, learner.staleness.rho_max in 0.1, 10.0);
        rule!(self, learner.staleness.c_max in 0.1, 10.0);
        rule!(self, learner.staleness.weight_max in 1.0, 100.0);
        rule!(self, learner.staleness.min_effective_share in 0.0, 1.0);
        Ok(())
    }

    fn check_physics(&self) -> Check {
        let section = |section, error: &dyn Display| ConfigError::Section {
            section,
            message: error.to_string(),
        };
        self.engine.validate().map_err(|error| section("engine", &error))?;
        self.terrain.validate().map_err(|error| section("terrain", &error))?;
        self.task.validate().map_err(|error| section("task", &error))?;
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
        rule!(self, transport.max_frame_bytes in 1, BYTES_MAX);
        rule!(self, transport.max_policy_bytes in 1, BYTES_MAX);
        rule!(self, transport.window_frames in 1, 1_024);
        rule!(self, transport.max_actors in self.actors.count, 1_024);
        rule!(self, transport.max_frames_per_s in 0, 100_000);
        rule!(self, transport.heartbeat_ms in 10, 60_000);
        rule!(self, transport.peer_timeout_ms in 3 * transport.heartbeat_ms, 3_600_000);
        if transport.kind == TransportKind::Zenoh {
            self.check_endpoints("transport.zenoh_listen", &transport.zenoh_listen)?;
            self.check_endpoints("transport.zenoh_connect", &transport.zenoh_connect)?;
        }
        Ok(())
    }

    fn check_endpoints(&self, key: &'static str, endpoints: &[String]) -> Check {
        for endpoint in endpoints {
            let rule = match endpoint.split_once('/') {
                Some(("tcp", address)) if is_loopback(address) => continue,
                Some(("tcp", _)) => {
                    "plain connections stay on loopback; beyond this host write quic/ and set cluster.tls_dir"
                }
                Some(("quic", _)) if !self.has_certificates() => NO_CERTIFICATES,
                Some(("quic", _)) => continue,
                _ => "must be tcp/HOST:PORT on loopback, or quic/HOST:PORT",
            };
            broken(key, format!("{endpoint:?}"), rule)?;
        }
        Ok(())
    }

    fn has_certificates(&self) -> bool {
        !self.cluster.tls_dir.as_os_str().is_empty()
    }

    fn check_services(&self) -> Check {
        rule!(self, policy_server.keep_versions in 1, 100_000);
        let stream = self.policy_server.stream.as_str();
        if !stream.is_empty() {
            word("policy_server.stream", stream, 64, "-_.")?;
        }
        let addr = self.policy_server.addr;
        if !addr.ip().is_loopback() && !self.has_certificates() {
            broken("policy_server.addr", addr, NO_CERTIFICATES)?;
        }
        self.check_telemetry()
    }

    fn check_telemetry(&self) -> Check {
        let telemetry = &self.telemetry;
        rule!(self, telemetry.trace_every in 1, 1_000_000);
        let endpoint = telemetry.otlp_endpoint.as_str();
        let rule = match endpoint.split_once("://") {
            _ if endpoint.is_empty() => return Ok(()),
            Some(("http", address)) if is_loopback(address) => return Ok(()),
            Some(("http", _)) => {
                "is plain and leaves this host: take a collector on this host, or https:// with cluster.tls_dir"
            }
            Some(("https", _)) if !self.has_certificates() => NO_CERTIFICATES,
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
