//! The wiring file that ships, and what is refused.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::f64::consts::FRAC_PI_2;

use caudata_hardware::WiringError;
use caudata_hardware::wiring::{JointWiring, ServoModel, Wiring};

const SHIPPED: &str = include_str!("../../../robots/polymander.wiring.toml");

#[test]
fn the_shipped_file_is_taken() {
    let wiring = Wiring::parse(SHIPPED).unwrap();
    assert_eq!((wiring.joint.len(), wiring.bus.baud), (16, 1_000_000));
    assert_eq!(wiring.joint["FR_hip"].direction, -1);
}

#[test]
fn every_shipped_wiring_has_the_joints_of_its_robot() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
    let mut found = 0;
    for entry in std::fs::read_dir(&folder).unwrap().flatten() {
        let path = entry.path();
        let name = entry.file_name().to_string_lossy().into_owned();
        let Some(robot) = name.strip_suffix(".wiring.toml") else {
            continue;
        };
        let wiring = Wiring::read(&path).unwrap();
        assert_eq!(wiring.robot, robot);
        let file = std::fs::read_to_string(folder.join(format!("{robot}.robot.toml"))).unwrap();
        let file: toml::Table = file.parse().unwrap();
        let names = file["joints"]["actuated"].as_array().unwrap();
        let names: Vec<&str> = names.iter().map(|n| n.as_str().unwrap()).collect();
        assert_eq!(wiring.joints(&names).unwrap().len(), names.len(), "{robot}");
        found += 1;
    }
    assert!(found >= 5);
}

#[test]
fn a_file_that_is_no_text_or_has_no_end_is_wrong_and_not_absent() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot.wiring.toml");
    std::fs::write(&path, b"format = \"caudata.wiring.v1\"\n\xff").unwrap();
    for path in [path.as_path(), std::path::Path::new("/dev/zero")] {
        let error = Wiring::read(path).unwrap_err();
        assert!(matches!(error, WiringError::Wrong { .. }), "{error}");
    }
    let error = Wiring::read(&folder.path().join("absent")).unwrap_err();
    assert!(matches!(error, WiringError::Read { .. }), "{error}");
}

#[test]
fn angles_by_hand() {
    // Reversed, zero at a quarter turn: at 3072 counts (a quarter) the joint is at 0, at 4096 (half a turn)
    // at −π/2.
    let joint =
        JointWiring { id: 1, model: ServoModel::Xm430W210, direction: -1, zero_rad: FRAC_PI_2 };
    assert!(joint.joint_rad(3072).abs() < 1e-12);
    assert!((joint.joint_rad(4096) + FRAC_PI_2).abs() < 1e-12);
    assert_eq!((joint.counts(0.0), joint.counts(-FRAC_PI_2)), (3072, 4096));
    for counts in 0..4096 {
        assert_eq!(joint.counts(joint.joint_rad(counts)), counts);
    }
}

#[test]
fn what_cannot_be_is_refused_with_its_place() {
    for (good, bad, expected) in [
        ("caudata.wiring.v1", "caudata.wiring.v9", "format"),
        ("baud = 1000000", "baud = 250000", "bus.baud"),
        ("watchdog_ms = 100", "watchdog_ms = 0", "bus.watchdog_ms"),
        ("id = 2\n", "id = 1\n", "joint.spine_2: id 1 is taken"),
        ("[\"+x\", \"+y\", \"+z\"]", "[\"+x\", \"-y\", \"+z\"]", "imu.axes"),
        ("[\"+x\", \"+y\", \"+z\"]", "[\"+x\", \"+x\", \"+z\"]", "imu.axes"),
        ("operating_mode = 3", "operating_mode = 1", "operating_mode"),
        ("current_limit_a = 2.3", "current_limit_a = 9.0", "current_limit_a"),
        ("fast_sync_read = true", "fast = true", "unknown field"),
        ("direction = 1\n", "direction = 0\n", "direction must be"),
    ] {
        let text = SHIPPED.replacen(good, bad, 1);
        assert_ne!(text, SHIPPED, "{good}");
        let error = Wiring::parse(&text).unwrap_err();
        assert!(error.contains(expected), "{error}");
    }
    let missing = Wiring::parse(SHIPPED).unwrap().joints(&["spine_1", "wing"]);
    assert!(missing.is_err());
}
