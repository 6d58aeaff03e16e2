//! What units are called in headers and in maps.

use caudata_model::RobotModel;

/// Numbers up to this are radians.
pub(super) const MOST_RAD: f64 = 7.0;

/// What a map calls a unit, and last words of a header that are it, with spaces between.
const UNIT_WORDS: &[(&str, &str)] = &[
    ("rad", "rad rads radians"),
    ("deg", "deg degrees °"),
    ("turn", "turns rev"),
    ("mrad", "mrad"),
    ("rad/s", "rad/s rad/sec radps"),
    ("mrad/s", "mrad/s"),
    ("deg/s", "deg/s deg/sec °/s dps degps"),
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
    ("m", "m"),
    ("mm", "mm"),
    ("m/s", "m/s m/sec"),
    ("mm/s", "mm/s mm/sec"),
    ("N", "n"),
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
        "rad" if is_slide(robot, joint) => "m",
        "rad/s" if is_slide(robot, joint) => "m/s",
        "Nm" if is_slide(robot, joint) => "N",
        _ => unit,
    }
}

/// Whether a signal is one of a slide.
pub(super) fn is_slide(robot: &RobotModel, joint: Option<usize>) -> bool {
    joint.is_some_and(|joint| robot.per_radian(joint) != 1.0)
}

/// The unit that a signal of a hinge of this kind is taken for, by the size of its numbers.
pub(super) fn unit_by_size(kind: &str, values: &[f64]) -> &'static str {
    let most = values.iter().fold(0.0f64, |most, v| most.max(v.abs()));
    match kind {
        "cmd" | "pos" if most > 720.0 => "counts/4096",
        "cmd" | "pos" if most > MOST_RAD => "deg",
        "cmd" | "pos" => "rad",
        "vel" if most > 100.0 => "deg/s",
        "vel" => "rad/s",
        "cur" if most > 30.0 => "mA",
        "cur" => "A",
        "tau" | "cmd_tau" => "Nm",
        "volt" if most > 1000.0 => "mV",
        "volt" => "V",
        "temp" => "degC",
        _ if most > 1.0 => "%",
        _ => "1",
    }
}

/// The same of a slide, which moves by less than 3 m and slower than 10 m/s.
pub(super) fn unit_of_slide(kind: &str, values: &[f64]) -> &'static str {
    let most = values.iter().fold(0.0f64, |most, v| most.max(v.abs()));
    match kind {
        "cmd" | "pos" if most > 3.0 => "mm",
        "cmd" | "pos" => "m",
        "vel" if most > 10.0 => "mm/s",
        "vel" => "m/s",
        "tau" | "cmd_tau" => "N",
        _ => unit_by_size(kind, values),
    }
}
