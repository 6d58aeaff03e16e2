//! What units are called in headers and in maps.

use caudata_model::RobotModel;

/// What a map calls a unit, and last words of a header that are it, with spaces between.
const UNIT_WORDS: &[(&str, &str)] = &[
    ("rad", "rad rads radians"),
    ("deg", "deg degrees °"),
    ("turn", "turns rev"),
    ("mrad", "mrad"),
    ("rad/s", "rad/s rad/sec"),
    ("mrad/s", "mrad/s"),
    ("deg/s", "deg/s deg/sec °/s dps"),
    ("rev/s", "rev/s turns/s rps"),
    ("rev/min", "rpm rev/min r/min u/min 1/min min-1"),
    ("counts/4096", "ticks counts"),
    ("counts/4096/s", "ticks/s counts/s"),
    ("rad/s2", "rad/s2"),
    ("deg/s2", "deg/s2"),
    ("A", "a"),
    ("mA", "ma"),
    ("uA", "ua µa"),
    ("Nm", "nm n·m"),
    ("mNm", "mnm nmm n·mm"),
    ("cNm", "ncm cnm n·cm"),
    ("kgf·cm", "kgcm kg·cm kgf·cm"),
    ("V", "v"),
    ("mV", "mv"),
    ("degC", "c °c degc"),
    ("%", "%"),
    ("s", "s sec"),
    ("ms", "ms"),
    ("us", "us µs"),
    ("ns", "ns"),
];

/// What a map calls the unit that is called `word`, in lower case.
pub(super) fn unit_word(word: &str) -> Option<&'static str> {
    let found = UNIT_WORDS.iter().find(|(_, words)| words.split(' ').any(|w| w == word));
    found.map(|(unit, _)| *unit)
}

/// A unit of hinges as a slide has it, at the `joint` of a signal.
pub(super) fn unit_at(
    robot: &RobotModel,
    joint: Option<usize>,
    unit: &'static str,
) -> &'static str {
    match unit {
        "rad" if joint.is_some_and(|joint| robot.per_radian(joint) != 1.0) => "m",
        "rad/s" if joint.is_some_and(|joint| robot.per_radian(joint) != 1.0) => "m/s",
        _ => unit,
    }
}
