//! What the learner adds to the traces: chunks that arrive, the batch, the update, and the policy version
//! that comes of it.

use caudata_proto::hex::hex;
use caudata_proto::{ChunkIdentity, RolloutChunk, TraceContext, chunk_identity};
use caudata_telemetry::traces::{Kind, Span, Tracer, Value};

/// Chunks that a batch names as its origin.
const LINKS_MAX: usize = 256;

/// The trace of the version that is current, and where spans go.
pub(super) struct Traces {
    tracer: Tracer,
    current: Option<Current>,
}

/// A policy version that actors have been given.
struct Current {
    version: u64,
    sha256: [u8; 32],
    root: TraceContext,
    began_ns: u64,
    /// The batch that it was learnt from.
    origin: Option<TraceContext>,
    /// The batch that is learnt from now.
    batch: Option<TraceContext>,
}

impl Traces {
    pub fn new(tracer: Tracer) -> Self {
        Self { tracer, current: None }
    }

    /// Which chunk a frame is, where that is asked for.
    pub fn identity(&self, frame: &[u8]) -> Option<ChunkIdentity> {
        if self.tracer.is_off() {
            return None;
        }
        chunk_identity(frame)
    }

    /// A chunk of so many bytes has been taken in since `began_ns`; `outcome` is what became of it.
    pub fn received(
        &self,
        chunk: Option<ChunkIdentity>,
        bytes: usize,
        began_ns: u64,
        outcome: &str,
    ) {
        let Some((chunk, collected)) = chunk.and_then(|chunk| chunk.trace.map(|t| (chunk, t)))
        else {
            return;
        };
        self.tracer.record(Span {
            parent: Some(collected.span),
            attributes: vec![
                ("caudata.actor", u64::from(chunk.actor_id).into()),
                ("caudata.incarnation", chunk.incarnation.into()),
                ("caudata.sequence", chunk.sequence.into()),
                ("caudata.bytes", bytes.into()),
                ("caudata.outcome", outcome.into()),
            ],
            ..Span::since(
                began_ns,
                "receive chunk",
                Kind::Consumer,
                self.tracer.child_of(collected),
            )
        });
    }

    /// A batch is complete; it was waited for since `began_ns`.
    pub fn batch(&mut self, chunks: &[RolloutChunk], began_ns: u64) {
        let Some(current) = &mut self.current else { return };
        let context = self.tracer.child_of(current.root);
        current.batch = Some(context);
        let oldest = chunks.iter().map(|chunk| chunk.policy_version).min();
        let lag = oldest.map_or(0, |oldest| current.version.saturating_sub(oldest));
        self.tracer.record(Span {
            parent: Some(current.root.span),
            attributes: vec![
                ("caudata.chunks", chunks.len().into()),
                ("caudata.lag_max", lag.into()),
            ],
            links: chunks.iter().filter_map(|chunk| chunk.trace).take(LINKS_MAX).collect(),
            ..Span::since(began_ns, "batch", Kind::Internal, context)
        });
    }

    /// Something was done with the batch since `began_ns`.
    pub fn done(&self, name: &'static str, began_ns: u64, attributes: Vec<(&'static str, Value)>) {
        let batch = self.current.as_ref().and_then(|current| current.batch);
        let Some(batch) = batch else { return };
        self.tracer.record(Span {
            parent: Some(batch.span),
            attributes,
            ..Span::since(began_ns, name, Kind::Internal, self.tracer.child_of(batch))
        });
    }

    /// Actors are given another version, since `began_ns`: the trace of the one before is complete.
    pub fn handed_out(&mut self, version: u64, sha256: [u8; 32], began_ns: u64) {
        let root = TraceContext::of_policy(&sha256);
        self.done(
            "hand out policy",
            began_ns,
            vec![
                ("caudata.policy_version", version.into()),
                ("caudata.policy_sha256", hex(&sha256).as_str().into()),
            ],
        );
        let origin = self.current.as_ref().and_then(|current| current.batch);
        self.complete();
        if self.tracer.is_traced(version) {
            self.current = Some(Current { version, sha256, root, began_ns, origin, batch: None });
        }
    }

    /// Tells the root span of the version that was current.
    pub fn complete(&mut self) {
        let Some(current) = self.current.take() else { return };
        self.tracer.record(Span {
            attributes: vec![
                ("caudata.policy_version", current.version.into()),
                ("caudata.policy_sha256", hex(&current.sha256).as_str().into()),
            ],
            links: current.origin.into_iter().collect(),
            ..Span::since(current.began_ns, "policy version", Kind::Internal, current.root)
        });
    }
}
