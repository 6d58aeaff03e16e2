//! What an actor reports to Prometheus.

use caudata_telemetry::{Counter, Histogram, IntGauge, SecondsCounter};

caudata_telemetry::metrics! {
    /// The metrics of one process's actors. Several actors of one process share them.
    pub struct ActorMetrics {
        steps: Counter = "caudata_actor_steps_total", "Environment steps";
        chunks: Counter = "caudata_actor_chunks_sent_total", "Chunks that the link took";
        bytes: Counter = "caudata_actor_bytes_sent_total", "Bytes of the chunks sent";
        retries: Counter = "caudata_actor_send_retries_total",
            "Times that a chunk was offered again because the learner was behind or away";
        episodes: Counter = "caudata_actor_episodes_total", "Episodes that ended";
        policy_version: IntGauge = "caudata_actor_policy_version", "Version of the policy in use";
        inference: Histogram = "caudata_inference_latency_seconds", "One inference for all lanes";
        env_seconds: SecondsCounter = "caudata_actor_env_seconds_total", "Time stepping environments";
        policy_seconds: SecondsCounter = "caudata_actor_policy_seconds_total",
            "Time checking new policies and taking them up";
        wait_seconds: SecondsCounter = "caudata_actor_wait_seconds_total", "Time waiting for a policy";
        send_seconds: SecondsCounter = "caudata_actor_send_seconds_total", "Time handing chunks over";
    }
}
