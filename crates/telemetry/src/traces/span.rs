//! One span, and how it looks on the wire.

use caudata_proto::TraceContext;
use caudata_proto::wire::otlp as wire;
/// How a span stands to other processes.
pub use caudata_proto::wire::otlp::span::SpanKind as Kind;
/// Value of an attribute.
pub use serde_json::Value;

/// Something that happened, from when to when, and where it belongs.
#[derive(Clone, Debug, PartialEq)]
pub struct Span {
    /// What happened, in a few words that are the same each time.
    pub name: &'static str,
    /// Whether it hands something over to another process.
    pub kind: Kind,
    /// Its trace and its own identifier.
    pub context: TraceContext,
    /// The span of the same trace that it is a part of; `None` for the root.
    pub parent: Option<[u8; 8]>,
    /// Beginning and end since 1970, ns.
    pub time_ns: [u64; 2],
    /// What else is known.
    pub attributes: Vec<(&'static str, Value)>,
    /// Spans of this and other traces that it follows from.
    pub links: Vec<TraceContext>,
}

impl Span {
    /// From `began_ns` until now, with nothing else known.
    pub fn since(began_ns: u64, name: &'static str, kind: Kind, context: TraceContext) -> Self {
        let time_ns = [began_ns, crate::now_ns()];
        let (attributes, links) = (Vec::new(), Vec::new());
        Self { name, kind, context, parent: None, time_ns, attributes, links }
    }
}

pub(crate) fn to_wire(span: Span) -> wire::Span {
    let [start_time_unix_nano, end_time_unix_nano] = span.time_ns;
    wire::Span {
        trace_id: span.context.trace.to_vec(),
        span_id: span.context.span.to_vec(),
        parent_span_id: span.parent.map_or_else(Vec::new, |id| id.to_vec()),
        name: span.name.to_owned(),
        kind: span.kind.into(),
        start_time_unix_nano,
        end_time_unix_nano,
        attributes: attributes(span.attributes),
        links: span
            .links
            .iter()
            .map(|link| wire::span::Link {
                trace_id: link.trace.to_vec(),
                span_id: link.span.to_vec(),
            })
            .collect(),
    }
}

pub(crate) fn attributes(
    named: impl IntoIterator<Item = (&'static str, Value)>,
) -> Vec<wire::KeyValue> {
    use wire::any_value::Value as Wire;
    let value = |value| match value {
        Value::String(text) => Wire::StringValue(text),
        Value::Number(number) => match number.as_i64() {
            Some(count) => Wire::IntValue(count),
            None => Wire::DoubleValue(number.as_f64().unwrap_or(f64::NAN)),
        },
        // What JSON has instead of numbers that are none.
        Value::Null => Wire::DoubleValue(f64::NAN),
        other => Wire::StringValue(other.to_string()),
    };
    named
        .into_iter()
        .map(|(key, of)| wire::KeyValue {
            key: key.to_owned(),
            value: Some(wire::AnyValue { value: Some(value(of)) }),
        })
        .collect()
}
