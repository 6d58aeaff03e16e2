//! What follows from a robot file.

use std::path::Path;

use caudata_config::{Config, PRESETS, Source, can_walk};
use caudata_model::RobotModel;

fn load(source: Source) -> Config {
    Config::load(&source).unwrap_or_else(|error| panic!("{error}"))
}

/// Every preset for a robot of its own is whole, and these robots are their own mirror images.
#[test]
fn robots_that_ship_are_trained_alike_on_both_sides() {
    for preset in PRESETS.iter().filter(|p| p.derived && p.robot.is_some()) {
        let config = load(Source::preset(preset.name));
        assert!(config.learner.network.symmetric, "{}", preset.name);
    }
    // What is not known to be the same in the mirror is not assumed to be; the user may say otherwise.
    let own = Source::preset("quadruped").set("task.observation.term=[{name=\"gyro\"}]");
    assert!(!load(own).learner.network.symmetric);
    let off = Source::preset("hexapod").set("learner.network.symmetric=false");
    assert!(!load(off).learner.network.symmetric);
}

/// A biped must act faster than it falls; what stands on four or six feet steps slowly through a slow filter.
#[test]
fn filters_follow_from_how_a_robot_falls() {
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
    let alpha = |robot: &str| {
        let robot = robots.join(format!("{robot}.robot.toml"));
        load(Source::preset("walk").set(format!("robot={}", robot.display())))
            .task
            .action
            .filter_alpha
    };
    // √(9.81 m/s² / 0.15 m)/2π = 1.3 Hz; 11 times that are 14 Hz: 1 − e^(−2π·14·0.02) = 0.83
    assert!((0.78..0.88).contains(&alpha("biped")), "{}", alpha("biped"));
    assert!(alpha("quadruped") < 0.2 && alpha("hexapod") < 0.12);
}

#[test]
fn a_robot_that_is_held_cannot_walk() {
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
    let rig = robots.join("xl330_pendulum.robot.toml");
    let model = RobotModel::load(&rig).unwrap();
    let check = can_walk(&model).unwrap_err().to_string();
    let walk = Source::preset("walk").set(format!("robot={}", rig.display()));
    assert_eq!(Config::load(&walk).unwrap_err().to_string(), check);
    assert!(check.contains("xl330_pendulum") && check.contains("held"), "{check}");
}

/// The quadruped with `change` made in both of its files.
fn changed_quadruped(change: impl Fn(&str) -> String) -> RobotModel {
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
    let folder = tempfile::tempdir().unwrap();
    for file in ["quadruped.robot.toml", "quadruped.xml"] {
        let text = std::fs::read_to_string(robots.join(file)).unwrap();
        std::fs::write(folder.path().join(file), change(&text)).unwrap();
    }
    RobotModel::load(&folder.path().join("quadruped.robot.toml")).unwrap()
}

fn footless(text: &str) -> String {
    let foot = |leg| format!("[[feet]]\nname = \"{leg}\"\ngeom = \"{leg}_foot\"\n");
    ["FL", "FR", "HL", "HR"].iter().fold(text.to_owned(), |text, leg| text.replace(&foot(leg), ""))
}

/// Shanks that turn without end, the lower ends of which are 0.2 m below their axes.
#[test]
fn a_robot_on_wheels_is_asked_to_roll() {
    let range = "range=\"-2.7227 -0.83776\"";
    let model = changed_quadruped(|text| footless(text).replace(range, "range=\"-1e5 1e5\""));
    let layer = Config::derived(&model).unwrap();
    for said in ["0 feet, 4 wheels", "command_mps = 0.4", "vy_mps = [-0, 0]", "symmetric = true"] {
        assert!(layer.contains(said), "{said} in {layer}");
    }
}

#[test]
fn a_robot_that_falls_through_the_ground_or_has_no_name_for_a_joint_cannot_walk() {
    assert!(can_walk(&changed_quadruped(str::to_owned)).is_ok());
    let ghost = |text: &str| footless(text).replace("conaffinity=\"1\"", "conaffinity=\"0\"");
    let why = can_walk(&changed_quadruped(ghost)).unwrap_err().to_string();
    assert!(why.contains("no shape that touches the ground"), "{why}");
    let long = |text: &str| text.replace("FL_thigh", "the_upper_joint_of_the_left_fore_leg");
    let why = can_walk(&changed_quadruped(long)).unwrap_err().to_string();
    assert!(why.contains("a name is 1 to 32"), "{why}");
    let site = "<site name=\"imu\"";
    let turned = |text: &str| text.replace(site, &format!("{site} quat=\"0 1 0 0\""));
    let why = can_walk(&changed_quadruped(turned)).unwrap_err().to_string();
    assert!(why.contains("mounted tilted by 180°"), "{why}");
}
