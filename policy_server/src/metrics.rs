//! What the policy server counts.

use caudata_telemetry::{Counter, IntGauge};

use crate::store::Store;

caudata_telemetry::metrics! {
    /// Handles into the process's registry; cloning shares them.
    pub struct ServerMetrics {
        published: Counter = "caudata_policy_published_total", "New policy versions stored";
        repeated: Counter = "caudata_policy_repeated_total", "Publications of a version already stored";
        refused: Counter = "caudata_policy_refused_total", "Publications refused";
        fetched: Counter = "caudata_policy_fetched_total", "Policy fetches answered";
        reports: Counter = "caudata_policy_reports_total", "Reports of robots about policy versions";
        read_only: IntGauge = "caudata_policy_read_only", "1 while the disk takes no changes";
        damaged: IntGauge = "caudata_policy_damaged_files",
            "Files of the store that were found damaged and set aside";
        watchers: IntGauge = "caudata_policy_watchers", "Watches open now";
        versions: IntGauge = "caudata_policy_versions", "Policy versions in the store";
        streams: IntGauge = "caudata_policy_streams", "Policy streams in the store";
    }
}

impl ServerMetrics {
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
