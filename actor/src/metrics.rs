//! What an actor reports to Prometheus.

use caudata_telemetry::{Counter, Histogram, IntGauge, Metrics, SecondsCounter};

/// The metrics of one process's actors. Several actors of one process share them.
#[derive(Clone, Debug)]
pub struct ActorMetrics {
    /// Environment steps.
    pub steps: Counter,
    /// Chunks that the link took.
    pub chunks: Counter,
    /// Bytes of those.
    pub bytes: Counter,
    /// Times that a chunk had to be offered again because the learner was behind or away.
    pub retries: Counter,
    /// Episodes that ended.
    pub episodes: Counter,
    /// Version of the policy in use.
    pub policy_version: IntGauge,
    /// One inference for all lanes.
    pub inference: Histogram,
    /// Seconds spent stepping environments.
    pub env_seconds: SecondsCounter,
    /// Seconds spent checking new policies and taking them up.
    pub policy_seconds: SecondsCounter,
    /// Seconds spent waiting for a policy.
    pub wait_seconds: SecondsCounter,
    /// Seconds spent handing chunks over.
    pub send_seconds: SecondsCounter,
}

impl ActorMetrics {
    /// Registers them.
    pub fn register(metrics: &Metrics) -> Self {
        Self {
            steps: metrics.counter("caudata_actor_steps_total", "Environment steps"),
            chunks: metrics.counter(
                "caudata_actor_chunks_sent_total",
                "Chunks that the link took",
            ),
            bytes: metrics.counter("caudata_actor_bytes_sent_total", "Bytes of the chunks sent"),
            retries: metrics.counter(
                "caudata_actor_send_retries_total",
                "Times that a chunk was offered again because the learner was behind or away",
            ),
            episodes: metrics.counter("caudata_actor_episodes_total", "Episodes that ended"),
            policy_version: metrics.int_gauge(
                "caudata_actor_policy_version",
                "Version of the policy in use",
            ),
            inference: metrics.seconds(
                "caudata_inference_latency_seconds",
                "One inference for all lanes",
            ),
            env_seconds: metrics.seconds_counter(
                "caudata_actor_env_seconds_total",
                "Time stepping environments",
            ),
            policy_seconds: metrics.seconds_counter(
                "caudata_actor_policy_seconds_total",
                "Time checking new policies and taking them up",
            ),
            wait_seconds: metrics.seconds_counter(
                "caudata_actor_wait_seconds_total",
                "Time waiting for a policy",
            ),
            send_seconds: metrics.seconds_counter(
                "caudata_actor_send_seconds_total",
                "Time handing chunks over",
            ),
        }
    }
}
