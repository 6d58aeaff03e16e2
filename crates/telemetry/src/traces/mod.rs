//! Traces: from a simulator step over the chunk, the transport and the batch to the next policy version, as
//! spans to an OpenTelemetry collector (OTLP over gRPC). Off unless an endpoint is configured.
//!
//! There is one trace per policy version. Its identifier is the beginning of the policy's SHA-256
//! (`TraceContext::of_policy`), so that actors and learner agree about it without telling each other, and
//! whoever has a policy's hash finds its trace. What a chunk adds to that is the span in which it was
//! collected: that travels with it.
//!
//! *Invariant:* nothing waits for a collector. A queue of [`QUEUE_MAX`] spans stands between; what does not
//! fit, and what the collector does not take, is dropped and counted.

mod export;
mod span;

use std::hash::{BuildHasher, RandomState};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::SystemTime;

use caudata_proto::TraceContext;

use crate::metrics::Metrics;
use export::Exporter;
pub use export::{QUEUE_MAX, TraceError, TraceSettings};
pub use span::{Kind, Span, Value};

/// Takes spans. Cheap to clone; all clones share the queue. When the last one goes, what waits is still
/// exported, for at most a few seconds.
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
        let exporter = Exporter::start(settings, metrics)?;
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
        self.inner.as_ref().is_some_and(|inner| version.is_multiple_of(inner.every))
    }

    /// A span of `trace` with an identifier of its own.
    pub fn child_of(&self, parent: TraceContext) -> TraceContext {
        let number = self.inner.as_ref().map_or(0, |inner| {
            inner.base.wrapping_add(inner.count.fetch_add(1, Ordering::Relaxed))
        });
        TraceContext { trace: parent.trace, span: scattered(number).to_le_bytes() }
    }

    /// Hands a span over. Never waits.
    pub fn record(&self, span: Span) {
        if let Some(inner) = &self.inner {
            inner.exporter.offer(span);
        }
    }
}

/// Neighbouring numbers far apart, none twice, and never 0, which is no identifier (the finaliser of
/// SplitMix64).
fn scattered(number: u64) -> u64 {
    let mut x = number.wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (x ^ (x >> 31)).max(1)
}
