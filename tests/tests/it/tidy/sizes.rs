//! How large programs may be. What is shipped has no symbols (`docker/images/collect.sh`), so none count here.

use std::process::Command;

use super::exceptions::{Offence, hold};

const MOST_BYTES: u64 = 40 << 20;
/// The same for a program that goes to a robot.
const MOST_BYTES_ON_A_ROBOT: u64 = 20 << 20;
/// Whether each goes to a robot.
const PROGRAMS: [(&str, bool); 6] = [
    ("caudata", false),
    ("caudata-actor", false),
    ("caudata-learner", false),
    ("caudata-policy-server", false),
    ("caudata-robot", true),
    ("caudata-ros2", true),
];

#[test]
fn programs_are_small() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut offences = Vec::new();
    for (name, on_a_robot) in PROGRAMS {
        let stripped = folder.path().join(name);
        let program = caudata_tests::binary(name).expect("built");
        let done = Command::new("strip").arg("-o").arg(&stripped).arg(program).status();
        assert!(done.expect("strip comes with the compiler").success(), "{name}");
        let bytes = std::fs::metadata(&stripped).expect("stripped").len();
        let most = if on_a_robot { MOST_BYTES_ON_A_ROBOT } else { MOST_BYTES };
        if bytes > most {
            offences.push(Offence::new(name, format!("{bytes} bytes, at most {most}")));
        }
    }
    hold("program size", offences);
}
