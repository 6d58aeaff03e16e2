//! What the policy server counts.

use caudata_telemetry::{Counter, IntGauge, Metrics};

use crate::store::Store;

/// Handles into the process's registry; cloning shares them.
#[derive(Clone, Debug)]
pub struct ServerMetrics {
    /// New versions stored.
    pub published: Counter,
    /// Publications of a version that was there already.
    pub repeated: Counter,
    /// Publications refused.
    pub refused: Counter,
    /// Fetches answered.
    pub fetched: Counter,
    /// What robots said about versions.
    pub reports: Counter,
    /// 1 where the store cannot be changed.
    pub read_only: IntGauge,
    /// Files that were found damaged and set aside.
    pub damaged: IntGauge,
    /// Watches open now.
    pub watchers: IntGauge,
    /// Versions in the store.
    pub versions: IntGauge,
    /// Streams in the store.
    pub streams: IntGauge,
}

impl ServerMetrics {
    /// Registers all of them.
    #[must_use]
    pub fn register(metrics: &Metrics) -> Self {
        Self {
            published: metrics.counter(
                "caudata_policy_published_total",
                "New policy versions stored",
            ),
            repeated: metrics.counter(
                "caudata_policy_repeated_total",
                "Publications of a version already stored",
            ),
            refused: metrics.counter("caudata_policy_refused_total", "Publications refused"),
            fetched: metrics.counter("caudata_policy_fetched_total", "Policy fetches answered"),
            reports: metrics.counter(
                "caudata_policy_reports_total",
                "Reports of robots about policy versions",
            ),
            read_only: metrics.int_gauge(
                "caudata_policy_read_only",
                "1 while the disk takes no changes",
            ),
            damaged: metrics.int_gauge(
                "caudata_policy_damaged_files",
                "Files of the store that were found damaged and set aside",
            ),
            watchers: metrics.int_gauge("caudata_policy_watchers", "Watches open now"),
            versions: metrics.int_gauge("caudata_policy_versions", "Policy versions in the store"),
            streams: metrics.int_gauge("caudata_policy_streams", "Policy streams in the store"),
        }
    }

    /// Shows how a store is.
    pub(crate) fn show(&self, store: &Store) {
        for (gauge, value) in [
            (&self.versions, store.records(None).count()),
            (&self.streams, store.stream_names().count()),
            (&self.read_only, usize::from(store.trouble().is_some())),
            (&self.damaged, store.damaged_files()),
        ] {
            gauge.set(i64::try_from(value).unwrap_or(i64::MAX));
        }
    }
}
