//! What may break a rule, and why. An exception that nothing needs any more is a fault too.

/// (rule, place, reason)
#[rustfmt::skip]
const EXCEPTIONS: &[(&str, &str, &str)] = &[
    ("unused dependency", "proto tonic", "the code that is generated from the .proto files names it"),
    ("unused dependency", "proto tonic-prost", "the code that is generated from the .proto files names it"),
    ("unused dependency", "tests proptest", "so that programs and tests resolve the same features, and nothing is compiled twice"),
];

/// Something that breaks a rule.
pub struct Offence {
    place: String,
    what: String,
}

impl Offence {
    /// At `place`, as exceptions name it; `what` is for people.
    pub fn new(place: impl Into<String>, what: impl Into<String>) -> Self {
        Self { place: place.into(), what: what.into() }
    }
}

/// Fails where `rule` is broken and nothing excepts it, and where an exception is not needed.
pub fn hold(rule: &str, offences: Vec<Offence>) {
    let excepted: Vec<&str> =
        EXCEPTIONS.iter().filter(|(r, _, _)| *r == rule).map(|(_, place, _)| *place).collect();
    let mut faults: Vec<String> = offences
        .iter()
        .filter(|o| !excepted.contains(&o.place.as_str()))
        .map(|o| format!("{}: {}", o.place, o.what))
        .collect();
    let needed = |place: &&&str| offences.iter().any(|o| o.place == **place);
    let idle = excepted.iter().filter(|place| !needed(place));
    faults
        .extend(idle.map(|place| format!("{place}: an exception that nothing needs; take it out")));
    assert!(faults.is_empty(), "{rule}: {} faults\n{}", faults.len(), faults.join("\n"));
}
