//! What one chunk adds to the trace of its policy: when it was collected and handed over, its first simulator
//! step and inference as samples of all of them, and what all took.

use std::time::Duration;

use caudata_proto::TraceContext;
use caudata_telemetry::now_ns;
use caudata_telemetry::traces::{Kind, Span, Tracer};

use crate::policy::LoadedPolicy;

/// The times of a chunk that is being collected.
pub(crate) struct ChunkTrace {
    /// The root of the trace: the policy.
    policy: TraceContext,
    /// The span in which it is collected; travels with the chunk.
    pub collected: TraceContext,
    began_ns: u64,
    ended_ns: u64,
    inference: Duration,
    simulation: Duration,
    /// Beginning and end of the first of each.
    first_inference_ns: Option<[u64; 2]>,
    first_step_ns: Option<[u64; 2]>,
}

impl ChunkTrace {
    /// `None` when the version is not traced.
    pub fn begin(tracer: &Tracer, policy: &LoadedPolicy) -> Option<Self> {
        if !tracer.is_traced(policy.version) {
            return None;
        }
        let root = TraceContext::of_policy(&policy.sha256);
        Some(Self {
            policy: root,
            collected: tracer.child_of(root),
            began_ns: now_ns(),
            ended_ns: 0,
            inference: Duration::ZERO,
            simulation: Duration::ZERO,
            first_inference_ns: None,
            first_step_ns: None,
        })
    }

    /// An inference for all lanes has just ended.
    pub fn inferred(&mut self, took: Duration) {
        self.inference += took;
        self.first_inference_ns.get_or_insert_with(|| just_now(took));
    }

    /// A simulator step of all lanes has just ended.
    pub fn stepped(&mut self, took: Duration) {
        self.simulation += took;
        self.first_step_ns.get_or_insert_with(|| just_now(took));
    }

    /// All steps are done.
    pub fn ended(&mut self) {
        self.ended_ns = now_ns();
    }

    /// The link has taken the chunk: tells everything.
    pub fn sent(self, tracer: &Tracer, chunk: &SentChunk) {
        let steps = chunk.steps;
        let part = |name, time_ns: Option<[u64; 2]>, took: Duration| {
            let time_ns = time_ns?;
            let context = tracer.child_of(self.collected);
            Some(Span {
                parent: Some(self.collected.span),
                time_ns,
                attributes: vec![
                    ("caudata.of_so_many", steps.into()),
                    ("caudata.all_s", took.as_secs_f64().into()),
                ],
                ..Span::since(0, name, Kind::Internal, context)
            })
        };
        let parts = [
            part("policy inference", self.first_inference_ns, self.inference),
            part("simulator step", self.first_step_ns, self.simulation),
        ];
        parts.into_iter().flatten().for_each(|span| tracer.record(span));
        tracer.record(Span {
            parent: Some(self.policy.span),
            time_ns: [self.began_ns, self.ended_ns],
            attributes: vec![
                ("caudata.actor", u64::from(chunk.actor_id).into()),
                ("caudata.incarnation", chunk.incarnation.into()),
                ("caudata.sequence", chunk.sequence.into()),
                ("caudata.policy_version", chunk.policy_version.into()),
                ("caudata.steps", steps.into()),
                ("caudata.lanes", chunk.lanes.into()),
            ],
            ..Span::since(0, "collect chunk", Kind::Internal, self.collected)
        });
        let context = tracer.child_of(self.collected);
        tracer.record(Span {
            parent: Some(self.collected.span),
            attributes: vec![("caudata.bytes", chunk.bytes.into())],
            ..Span::since(self.ended_ns, "send chunk", Kind::Producer, context)
        });
    }
}

/// What is known of a chunk when it has been sent.
pub(crate) struct SentChunk {
    pub actor_id: u32,
    pub incarnation: u64,
    pub sequence: u64,
    pub policy_version: u64,
    pub steps: usize,
    pub lanes: usize,
    pub bytes: usize,
}

/// Beginning and end of something that took so long and is over now.
fn just_now(took: Duration) -> [u64; 2] {
    let end = now_ns();
    let took = u64::try_from(took.as_nanos()).unwrap_or(u64::MAX);
    [end.saturating_sub(took), end]
}
