//! One span, and how it looks on the wire.

use caudata_proto::TraceContext;
use caudata_proto::wire::otlp as wire;

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

/// How a span stands to other processes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Within this process.
    Internal,
    /// It makes what another process takes later.
    Producer,
    /// It takes what another process has made.
    Consumer,
}

/// Value of an attribute.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// A count or number; larger ones than fit become `i64::MAX`.
    Count(u64),
    /// A measure; its unit is in the attribute's name.
    Number(f64),
    /// Words.
    Text(String),
}

impl From<u64> for Value {
    fn from(count: u64) -> Self {
        Self::Count(count)
    }
}

impl From<usize> for Value {
    fn from(count: usize) -> Self {
        Self::Count(count as u64)
    }
}

impl From<f64> for Value {
    fn from(number: f64) -> Self {
        Self::Number(number)
    }
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

pub(crate) fn to_wire(span: Span) -> wire::Span {
    use wire::span::SpanKind;
    let kind = match span.kind {
        Kind::Internal => SpanKind::Internal,
        Kind::Producer => SpanKind::Producer,
        Kind::Consumer => SpanKind::Consumer,
    };
    let [start_time_unix_nano, end_time_unix_nano] = span.time_ns;
    wire::Span {
        trace_id: span.context.trace.to_vec(),
        span_id: span.context.span.to_vec(),
        parent_span_id: span.parent.map_or_else(Vec::new, |id| id.to_vec()),
        name: span.name.to_owned(),
        kind: kind.into(),
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
        Value::Count(count) => Wire::IntValue(i64::try_from(count).unwrap_or(i64::MAX)),
        Value::Number(number) => Wire::DoubleValue(number),
        Value::Text(text) => Wire::StringValue(text),
    };
    named
        .into_iter()
        .map(|(key, of)| wire::KeyValue {
            key: key.to_owned(),
            value: Some(wire::AnyValue { value: Some(value(of)) }),
        })
        .collect()
}
