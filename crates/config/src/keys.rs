//! Keys: the tree of those that exist, and the nearest one to a mistyped one.

use serde::Serialize;
use toml::{Table, Value};

/// A configuration as a TOML tree. Empty only if a value has no TOML form, which the callers' types exclude.
pub(crate) fn table_of(config: &impl Serialize) -> Table {
    Table::try_from(config).unwrap_or_default()
}

/// All leaves as `(full key, value as TOML text)`, in the order of the tree.
pub(crate) fn entries(table: &Table) -> Vec<(String, String)> {
    let mut out = Vec::new();
    collect(table, "", &mut out);
    out
}

fn collect(table: &Table, prefix: &str, out: &mut Vec<(String, String)>) {
    for (name, value) in table {
        let key = join(prefix, name);
        match value {
            Value::Table(inner) => collect(inner, &key, out),
            leaf => out.push((key, text_of(leaf))),
        }
    }
}

/// A value as TOML text. Fields of type f32 arrive widened; they are shown as they were written.
fn text_of(value: &Value) -> String {
    match value {
        Value::Float(x) if f64::from(*x as f32) == *x => format!("{:?}", *x as f32),
        Value::Array(items) => {
            let items: Vec<String> = items.iter().map(text_of).collect();
            format!("[{}]", items.join(", "))
        }
        other => other.to_string(),
    }
}

/// The first key of `given` that `known` does not have, as a full key.
pub(crate) fn first_unknown(given: &Table, known: &Table) -> Option<String> {
    find_unknown(given, known, "")
}

fn find_unknown(given: &Table, known: &Table, prefix: &str) -> Option<String> {
    given.iter().find_map(|(name, value)| {
        let key = join(prefix, name);
        match (value, known.get(name)) {
            (_, None) => Some(key),
            (Value::Table(inner), Some(Value::Table(known))) => find_unknown(inner, known, &key),
            _ => None,
        }
    })
}

/// The known key that `key` most likely means: the same last word somewhere else, or the fewest letters
/// changed.
pub(crate) fn nearest(key: &str, known: &Table) -> Option<String> {
    /// Below this similarity (0 to 1, Jaro–Winkler) a suggestion confuses more than it helps.
    const SIMILAR_ENOUGH: f64 = 0.8;
    let mut all: Vec<String> = entries(known).into_iter().map(|(key, _)| key).collect();
    all.extend(sections(known, ""));
    let last = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
    let alone = all.iter().filter(|candidate| last(candidate) == key).count() == 1;
    let score = |candidate: &String| {
        let whole = strsim::jaro_winkler(key, candidate);
        let word = strsim::jaro_winkler(&last(key), &last(candidate));
        // A right last word in a wrong section counts more than a section that looks alike.
        let score = 0.4 * whole + 0.6 * word;
        // people leave a section out: the last word alone, where there is one such
        let bare = !key.contains('.') && *candidate != key && last(candidate) == key;
        if bare && alone { score.max(SIMILAR_ENOUGH) } else { score }
    };
    all.into_iter()
        .map(|candidate| (score(&candidate), candidate))
        .filter(|(score, _)| *score >= SIMILAR_ENOUGH)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, candidate)| candidate)
}

fn sections(table: &Table, prefix: &str) -> Vec<String> {
    let mut out = Vec::new();
    for (name, value) in table {
        if let Value::Table(inner) = value {
            let key = join(prefix, name);
            out.extend(sections(inner, &key));
            out.push(key);
        }
    }
    out
}

fn join(prefix: &str, name: &str) -> String {
    if prefix.is_empty() { name.to_owned() } else { format!("{prefix}.{name}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn known() -> Table {
        "[learner.ppo]\ngamma = 0.97\nlambda = 0.9\n[actors]\ncount = 2\nlanes = 4".parse().unwrap()
    }

    #[test]
    fn the_nearest_key_is_the_one_that_was_meant() {
        let cases = [
            ("learner.ppo.gama", Some("learner.ppo.gamma")),
            ("learner.gamma", Some("learner.ppo.gamma")),
            ("actor.count", Some("actors.count")),
            ("actor", Some("actors")),
            ("lanes", Some("actors.lanes")),
            ("zebra", None),
        ];
        for (typed, meant) in cases {
            assert_eq!(nearest(typed, &known()).as_deref(), meant, "{typed}");
        }
    }

    #[test]
    fn single_precision_is_shown_as_it_was_written() {
        let widened = Value::Array(vec![Value::Float(f64::from(0.1f32)), Value::Float(0.3)]);
        assert_eq!(text_of(&widened), "[0.1, 0.3]");
    }

    #[test]
    fn entries_are_full_keys() {
        let entries = entries(&known());
        assert!(entries.contains(&("learner.ppo.gamma".into(), "0.97".into())), "{entries:?}");
    }
}
