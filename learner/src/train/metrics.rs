//! What the learner reports to Prometheus.

use caudata_telemetry::{Counter, Gauge, Histogram, IntGauge, LabelledCounter};

caudata_telemetry::metrics! {
    /// The metrics of a learner.
    pub(super) struct LearnerMetrics {
        iterations: Counter = "caudata_learner_iterations_total", "Iterations done";
        steps: Counter = "caudata_learner_steps_total", "Environment steps learnt from";
        skipped_updates: Counter = "caudata_learner_skipped_updates_total",
            "Minibatches left out because something was not finite";
        publish_failures: Counter = "caudata_learner_publish_failures_total",
            "Failed tries to publish to the policy server";
        report_failures: Counter = "caudata_learner_report_failures_total",
            "Curves and events that could not be written";
        policy_version: IntGauge = "caudata_learner_policy_version", "Version of the current policy";
        waiting: IntGauge = "caudata_learner_chunks_waiting", "Chunks in the queue";
        actors: IntGauge = "caudata_learner_actors", "Actors that are waited for";
        staleness: Gauge = "caudata_policy_staleness_versions",
            "Policy versions between collection and use, mean of the last batch";
        staleness_max: Gauge = "caudata_policy_staleness_max_versions",
            "Policy versions between collection and use, oldest data of the last batch";
        scale_advice: Gauge = "caudata_learner_scale_advice",
            "1: more actors would help; -1: fewer would do; 0: as it is";
        effective_share: Gauge = "caudata_learner_effective_sample_share",
            "Effective sample size of the last batch, as a share of it";
        kl: Gauge = "caudata_learner_kl_nats", "KL divergence of the last update";
        learning_rate: Gauge = "caudata_learner_learning_rate", "Learning rate";
        mean_step_reward: Gauge = "caudata_learner_step_reward", "Mean step reward of the last batch";
        mean_return: Gauge = "caudata_learner_episode_return", "Mean return of the last episodes";
        collect: Histogram = "caudata_learner_collect_seconds", "Waiting for a batch";
        learn: Histogram = "caudata_learner_update_seconds", "One update";
        checkpoint: Histogram = "caudata_learner_checkpoint_seconds", "One checkpoint";
        frames: LabelledCounter = "caudata_learner_frames_total",
            "Frames from actors, by what became of them on arrival";
    }
}

impl LearnerMetrics {
    /// Counts a frame under `outcome`: `waiting`, `duplicate`, `hello`, `bye`, or the reason why it was not
    /// taken. Answers the count.
    pub fn frame(&self, outcome: &str) -> u64 {
        let labels = vec![("outcome".to_owned(), outcome.to_owned())];
        let counter = self.frames.get_or_create(&labels).clone();
        counter.inc() + 1
    }
}
