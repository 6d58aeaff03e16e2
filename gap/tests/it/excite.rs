//! The battery, held to its own limits and to what a simulated robot does with it.

use crate::common::{robot, simulate};
use caudata_gap::excite::{self, HOLD_SHARE, HOT_SHARE, JointLimits};
use caudata_model::RobotModel;

fn commands_hold(robot: &RobotModel) -> usize {
    let limits = JointLimits::all(robot);
    let all = excite::battery(robot, None, 100.0).unwrap();
    for trial in &all {
        assert!(
            trial.duration_s > 1.0 && trial.duration_s < 320.0,
            "{} lasts {} s",
            trial.name,
            trial.duration_s
        );
        assert!(!trial.excites.is_empty());
        for id in &trial.excites {
            assert!(caudata_gap::effects::find(id).is_some(), "{}: {id}", trial.name);
        }
        let share = if trial.name == "hot_hold" { HOT_SHARE } else { HOLD_SHARE };
        assert!(
            trial.effort <= share + 0.01,
            "{} asks for {:.2} of the torque",
            trial.name,
            trial.effort
        );
        for (a, l) in limits.iter().enumerate() {
            let column = || trial.commands_rad.iter().map(|row| row[a]);
            for q in column() {
                assert!(
                    q >= l.range_rad.0 - 1e-9 && q <= l.range_rad.1 + 1e-9,
                    "{} sends {} to {q}",
                    trial.name,
                    l.name
                );
            }
            // a command either jumps (a step, a pseudo-random bit) or keeps to the speed limit
            let rates: Vec<f64> = column()
                .zip(column().skip(1))
                .map(|(p, q)| (q - p).abs() * trial.rate_hz)
                .collect();
            let jumps = rates.iter().filter(|r| **r > 1.001 * l.speed_radps).count();
            assert!(
                jumps * 5 < rates.len(),
                "{}: {} is asked for too fast in {jumps} of {} rows",
                trial.name,
                l.name,
                rates.len()
            );
        }
        // the first and last command are the nominal pose: trials can be strung together
        for row in [&trial.commands_rad[0], trial.commands_rad.last().unwrap()] {
            for (q, l) in row.iter().zip(&limits) {
                assert!((q - l.nominal_rad).abs() < 1e-9, "{}: {}", trial.name, l.name);
            }
        }
    }
    all.len()
}

#[test]
fn commands_respect_ranges_speeds_and_torque() {
    assert!(commands_hold(&robot("polymander")) >= 45);
    assert!(commands_hold(&robot("xl330_pendulum")) >= 25);
}

/// What the simulated robot does: no joint is driven against its stop, no servo works harder for long than it
/// stands.
fn robot_holds(name: &str) {
    let robot = robot(name);
    for trial in excite::battery(&robot, None, 100.0).unwrap() {
        if trial.duration_s > 100.0 {
            continue; // the same motions, longer
        }
        let run = &simulate(&robot, &trial, &[1], None)[0];
        for (a, &(low, high)) in robot.joint_limits_rad().iter().enumerate() {
            let servo = robot.servo(a);
            let joint = &trial.columns[a];
            let most = run
                .pos_rad
                .iter()
                .map(|q| (q[a] - high).max(low - q[a]))
                .fold(f64::NEG_INFINITY, f64::max);
            assert!(most < 0.02, "{}: {joint} is {most:.3} rad beyond its range", trial.name);
            let fastest = run.vel_radps.iter().map(|v| v[a].abs()).fold(0.0, f64::max);
            // where the falling part of the envelope comes to nothing: at `qd_max` there may be torque left
            let (span, fall) = (
                servo.qd_max_radps - servo.qd_tau_max_radps,
                servo.tau_max_nm - servo.tau_qd_max_nm,
            );
            let without_torque = servo.qd_max_radps + servo.tau_qd_max_nm * span / fall;
            let no_load = without_torque * robot.supply_v() / servo.reference_supply_v;
            assert!(fastest < 1.1 * no_load, "{}: {joint} reaches {fastest:.1} rad/s", trial.name);
            let square: f64 = run.torque_nm.iter().map(|t| t[a] * t[a]).sum();
            let share = (square / run.torque_nm.len() as f64).sqrt() / servo.tau_max_nm;
            assert!(
                share < 0.45,
                "{}: {joint} works at {share:.2} of its greatest torque",
                trial.name
            );
        }
    }
}

#[test]
fn a_simulated_salamander_stands_the_battery() {
    robot_holds("polymander");
}

#[test]
fn a_simulated_pendulum_stands_the_battery() {
    robot_holds("xl330_pendulum");
}

#[test]
fn the_next_experiment_is_made_for_what_it_separates() {
    let robot = robot("polymander");
    let check = |separates: &[&str], want: &str| {
        let next = excite::next(&robot, separates, &[]).unwrap();
        assert_eq!(next.trial, want, "{separates:?}: {}", next.reason);
        assert!(excite::names(&robot, None).contains(&want));
    };
    check(&["command_delay", "command_low_pass"], "chirp_small");
    check(&["girdle_play"], "rock_x");
    check(&["thermal_derating"], "hot_hold");
    check(&["linear_drag", "quadratic_drag"], "swim_sizes");
    check(&["hard_stop"], "sweep_full");
    assert!(excite::next(&robot, &["no_such_effect"], &[]).is_none());
    // a rig without legs is not sent for a walk
    let rig = crate::common::robot("xl330_pendulum");
    assert!(excite::next(&rig, &["contact_friction"], &[]).is_none());
    let one = excite::next(&robot, &["hard_stop"], &["FL_hip".to_owned()]).unwrap();
    assert_eq!(one.joints, ["FL_hip"]);
}

#[test]
fn one_joint_moves_alone_and_what_is_not_there_is_said() {
    let robot = robot("polymander");
    let trial = excite::trial(&robot, "chirp_small", Some("HL_knee"), 50.0).unwrap();
    assert_eq!(trial.joints, ["HL_knee"]);
    let csv = String::from_utf8(trial.to_csv().unwrap()).unwrap();
    assert!(csv.starts_with("t,cmd.spine_1,") && csv.lines().nth(2).unwrap().starts_with("0.02,"));
    let error = |e: excite::ExciteError| e.to_string();
    assert!(
        error(excite::battery(&robot, Some("wing"), 50.0).unwrap_err())
            .contains("no actuated joint `wing`")
    );
    assert!(
        error(excite::trial(&robot, "moonwalk", None, 50.0).unwrap_err())
            .contains("no trial `moonwalk`")
    );
    assert!(error(excite::trial(&robot, "rest", None, 0.0).unwrap_err()).contains("0 Hz"));
    // a drop lets go, and says so in its file
    let drop = excite::trial(&robot, "drop_high", Some("HL_knee"), 50.0).unwrap();
    assert!(
        String::from_utf8(drop.to_csv().unwrap())
            .unwrap()
            .lines()
            .next()
            .unwrap()
            .contains("on.HL_knee")
    );
    assert!(drop.on.iter().any(|on| on.contains(&false)));
}

#[test]
fn every_effect_of_the_catalogue_has_a_trial() {
    let robot = robot("polymander");
    for effect in caudata_gap::effects::ALL.iter() {
        let (id, trial) = (effect.id, effect.trial);
        assert!(excite::names(&robot, None).contains(&trial), "{id}: {trial}");
    }
}

#[test]
fn a_run_that_names_a_trial_is_known_for_it() {
    let known = [
        ("holds_long_kp100_2", Some("holds_long")),
        ("3-holds", Some("holds")),
        ("scaffolds", None),
        ("run 7: steps_medium, second day", Some("steps_medium")),
        ("", None),
    ];
    for (text, trial) in known {
        assert_eq!(caudata_gap::excite::names_in(text), trial, "{text}");
    }
}
