//! Traces: from a simulator step over the chunk, the transport and the batch to the next policy version, as spans to an OpenTelemetry
//! collector (OTLP over gRPC). Off unless an endpoint is configured.
//!
//! There is one trace per policy version. Its identifier is the beginning of the policy's SHA-256 (`TraceContext::of_policy`), so that
//! actors and learner agree about it without telling each other, and whoever has a policy's hash finds its trace. What a
//! chunk adds to that is the span in which it was collected: that travels with it.
//!
//! *Invariant:* nothing waits for a collector. A queue of [`QUEUE_MAX`] spans stands between; what does not fit, and what the collector does
//! not take, is dropped and counted.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

mod export;
mod span;

use std::hash::{BuildHasher, RandomState};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::SystemTime;

use caudata_proto::TraceContext;
use caudata_telemetry::{Counter, Metrics};

use export::Exporter;
pub use export::{QUEUE_MAX, TraceError};
pub use span::{Kind, Span, Value};

/// What a process needs to know to trace.
#[derive(Clone, Debug)]
pub struct TraceSettings {
    /// `http://host:port` or `https://host:port` of the collector's OTLP/gRPC port.
    pub endpoint: String,
    /// Every so many policy versions one is traced. At least 1.
    pub every: u64,
    /// Folder with `ca.crt`, `tls.crt` and `tls.key`, for `https://`.
    pub tls_dir: Option<PathBuf>,
    /// The program: `caudata-actor`.
    pub service: &'static str,
    /// Which one of them: `actor 3, incarnation 0`.
    pub instance: String,
    /// The training run.
    pub run_id: String,
}

/// Takes spans. Cheap to clone; all clones share the queue. When the last one goes, what waits is still exported, for at most a few seconds.
#[derive(Clone, Debug, Default)]
pub struct Tracer {
    inner: Option<Arc<Inner>>,
}

#[derive(Debug)]
struct Inner {
    every: u64,
    /// Where this process's span identifiers begin, and how many there are.
    base: u64,
    count: AtomicU64,
    exporter: Exporter,
}

/// What a process counts about its traces.
#[derive(Clone, Debug)]
pub(crate) struct Counters {
    pub exported: Counter,
    pub dropped: Counter,
}

impl Tracer {
    /// Traces nothing.
    pub fn off() -> Self {
        Self::default()
    }

    /// Exports to a collector, which need not be there.
    ///
    /// # Errors
    /// An address that is none, certificates that do not work, or the system refuses the thread.
    pub fn start(settings: &TraceSettings, metrics: &Metrics) -> Result<Self, TraceError> {
        let counters = Counters {
            exported: metrics.counter(
                "caudata_trace_spans_exported_total",
                "Spans that the collector took",
            ),
            dropped: metrics.counter(
                "caudata_trace_spans_dropped_total",
                "Spans given up because the collector is away, slow, or refuses them",
            ),
        };
        let exporter = Exporter::start(settings, counters)?;
        let base = RandomState::new().hash_one((std::process::id(), SystemTime::now()));
        Ok(Self {
            inner: Some(Arc::new(Inner {
                every: settings.every.max(1),
                base,
                count: AtomicU64::new(0),
                exporter,
            })),
        })
    }

    /// Whether it is [`Tracer::off`].
    pub fn is_off(&self) -> bool {
        self.inner.is_none()
    }

    /// Whether policy `version` is one of those that are traced.
    pub fn is_traced(&self, version: u64) -> bool {
        self.inner
            .as_ref()
            .is_some_and(|inner| version.is_multiple_of(inner.every))
    }

    /// A span of `trace` with an identifier of its own.
    pub fn child_of(&self, parent: TraceContext) -> TraceContext {
        let number = self.inner.as_ref().map_or(0, |inner| {
            inner
                .base
                .wrapping_add(inner.count.fetch_add(1, Ordering::Relaxed))
        });
        TraceContext {
            trace: parent.trace,
            span: scattered(number).to_le_bytes(),
        }
    }

    /// Hands a span over. Never waits.
    pub fn record(&self, span: Span) {
        if let Some(inner) = &self.inner {
            inner.exporter.offer(span);
        }
    }
}

/// Neighbouring numbers far apart, none twice, and never 0, which is no identifier (the finaliser of SplitMix64).
fn scattered(number: u64) -> u64 {
    let mut x = number.wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (x ^ (x >> 31)).max(1)
}

/// Time since 1970, ns.
pub fn now_ns() -> u64 {
    SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)
        .map_or(0, |since| {
            u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
        })
}
