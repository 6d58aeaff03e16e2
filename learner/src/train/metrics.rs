//! What the learner reports to Prometheus.

use caudata_telemetry::{Counter, Gauge, Histogram, IntGauge, Metrics, Pulse};
use prometheus_client::metrics::family::Family;

type Labels = Vec<(String, String)>;

/// The metrics of a learner.
#[derive(Clone, Debug)]
pub(super) struct LearnerMetrics {
    pub iterations: Counter,
    pub steps: Counter,
    pub skipped_updates: Counter,
    pub publish_failures: Counter,
    pub report_failures: Counter,
    pub policy_version: IntGauge,
    pub waiting: IntGauge,
    pub actors: IntGauge,
    pub staleness: Gauge,
    pub staleness_max: Gauge,
    pub scale_advice: Gauge,
    pub effective_share: Gauge,
    pub kl: Gauge,
    pub learning_rate: Gauge,
    pub mean_step_reward: Gauge,
    pub mean_return: Gauge,
    pub collect: Histogram,
    pub learn: Histogram,
    pub checkpoint: Histogram,
    frames: Family<Labels, Counter>,
    /// Beats while the run makes progress, or waits for what it needs.
    pub pulse: Pulse,
}

impl LearnerMetrics {
    pub fn register(metrics: &Metrics, pulse: Pulse) -> Self {
        let frames = Family::<Labels, Counter>::default();
        metrics.register(
            "caudata_learner_frames",
            "Frames from actors, by what became of them on arrival",
            frames.clone(),
        );
        Self {
            iterations: metrics.counter("caudata_learner_iterations_total", "Iterations done"),
            steps: metrics.counter(
                "caudata_learner_steps_total",
                "Environment steps learnt from",
            ),
            skipped_updates: metrics.counter(
                "caudata_learner_skipped_updates_total",
                "Minibatches left out because something was not finite",
            ),
            publish_failures: metrics.counter(
                "caudata_learner_publish_failures_total",
                "Failed tries to publish to the policy server",
            ),
            report_failures: metrics.counter(
                "caudata_learner_report_failures_total",
                "Curves and events that could not be written",
            ),
            policy_version: metrics.int_gauge(
                "caudata_learner_policy_version",
                "Version of the current policy",
            ),
            waiting: metrics.int_gauge("caudata_learner_chunks_waiting", "Chunks in the queue"),
            actors: metrics.int_gauge("caudata_learner_actors", "Actors that are waited for"),
            staleness: metrics.gauge(
                "caudata_policy_staleness_versions",
                "Policy versions between collection and use, mean of the last batch",
            ),
            staleness_max: metrics.gauge(
                "caudata_policy_staleness_max_versions",
                "Policy versions between collection and use, oldest data of the last batch",
            ),
            scale_advice: metrics.gauge(
                "caudata_learner_scale_advice",
                "1: more actors would help; -1: fewer would do; 0: as it is",
            ),
            effective_share: metrics.gauge(
                "caudata_learner_effective_sample_share",
                "Effective sample size of the last batch, as a share of it",
            ),
            kl: metrics.gauge(
                "caudata_learner_kl_nats",
                "KL divergence of the last update",
            ),
            learning_rate: metrics.gauge("caudata_learner_learning_rate", "Learning rate"),
            mean_step_reward: metrics.gauge(
                "caudata_learner_step_reward",
                "Mean step reward of the last batch",
            ),
            mean_return: metrics.gauge(
                "caudata_learner_episode_return",
                "Mean return of the last episodes",
            ),
            collect: metrics.seconds("caudata_learner_collect_seconds", "Waiting for a batch"),
            learn: metrics.seconds("caudata_learner_update_seconds", "One update"),
            checkpoint: metrics.seconds("caudata_learner_checkpoint_seconds", "One checkpoint"),
            frames,
            pulse,
        }
    }

    /// Counts a frame under `outcome`: `waiting`, `duplicate`, `hello`, `bye`, or the reason why it was not
    /// taken. Answers the count.
    pub fn frame(&self, outcome: &str) -> u64 {
        let labels = vec![("outcome".to_owned(), outcome.to_owned())];
        let counter = self.frames.get_or_create(&labels).clone();
        counter.inc() + 1
    }
}
