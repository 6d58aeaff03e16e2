//! Logs with and without faults: every fault that was put in is found, nothing is said of clean ones.

use crate::common::{Touch, changed, rebuilt, record, robot, simulate};
use caudata_gap::check::{CheckVerdict, Checked, check};
use caudata_gap::excite;
use caudata_model::RobotModel;
use caudata_runlog::{Axis, BaseHold, LogMeta, RunLog, Setting, Signal, Table, TableWriter};
use proptest::prelude::*;

/// Logs of a trial, one per seed.
fn logs(robot: &RobotModel, trial: &str, seeds: &[u64]) -> Vec<RunLog> {
    let trial = excite::trial(robot, trial, None, 100.0).unwrap();
    let runs = simulate(robot, &trial, seeds, None);
    runs.iter().zip(seeds).map(|(r, s)| record(robot, &trial, r, *s)).collect()
}

fn one(robot: &RobotModel, log: &RunLog) -> Checked {
    check(&[("run", log)], robot)
}

fn all(robot: &RobotModel, logs: &[RunLog]) -> Checked {
    let names: Vec<String> = (0..logs.len()).map(|i| format!("run_{i}")).collect();
    let named: Vec<(&str, &RunLog)> = names.iter().map(String::as_str).zip(logs).collect();
    check(&named, robot)
}

fn found(checked: &Checked, kind: &str, at: &str) {
    let hit = checked.faults.iter().any(|f| f.kind == kind && f.location.ends_with(at));
    assert!(hit, "no `{kind}` at `{at}` in {:#?}", checked.faults);
    assert!(checked.faults.iter().all(|f| !f.detail.contains('\n')));
}

#[test]
fn nothing_is_said_of_clean_logs() {
    for name in ["polymander", "xl330_pendulum"] {
        let robot = robot(name);
        for trial in excite::battery(&robot, None, 100.0).unwrap() {
            if trial.duration_s > 40.0 {
                continue;
            }
            let seeds: Vec<u64> = (0..4).collect();
            let runs = simulate(&robot, &trial, &seeds, None);
            let logs: Vec<RunLog> =
                runs.iter().zip(&seeds).map(|(r, s)| record(&robot, &trial, r, *s)).collect();
            let checked = all(&robot, &logs);
            assert!(checked.faults.is_empty(), "{name} {}: {:#?}", trial.name, checked.faults);
            assert_eq!(checked.verdict, CheckVerdict::Ok);
            assert_eq!(checked.repeats.len(), 1, "{}: repeats are recognised", trial.name);
        }
    }
}

/// A joint that meets a stop before its range ends, and comes back from it late.
#[test]
fn a_joint_at_its_stop_is_not_stuck() {
    let robot = robot("xl330_pendulum");
    let log = &logs(&robot, "steps_large", &[7])[0];
    let at = Signal::Position("swing".to_owned());
    let most = log.table.column(&at).unwrap().iter().flatten().fold(0.0_f64, |m, q| m.max(*q));
    let stopped = changed(log, |s, _, _, v| match *s == at {
        true => v.map(|q| q.min(0.6 * most)),
        false => v,
    });
    let checked = one(&robot, &stopped);
    assert!(checked.faults.iter().all(|f| f.kind != "stuck"), "{:#?}", checked.faults);
}

/// A signal, and what it is at a time, s.
type Column = (&'static str, fn(f64) -> f64);

/// A log of a pendulum that swings as it is sent, 0.6·sin(3·t) rad, with `columns` beside it; the notes have `meta`.
fn swinging(columns: &[Column], meta: &str) -> RunLog {
    let names: Vec<&str> = columns.iter().map(|c| c.0).collect();
    let mut text = format!("t,pos.swing,{}\n", names.join(","));
    for k in 0..800 {
        let t = f64::from(k) * 0.01;
        let values = columns.iter().map(|c| c.1(t).to_string()).collect::<Vec<_>>();
        text += &format!("{t},{},{}\n", 0.6 * (3.0 * t).sin(), values.join(","));
    }
    let head = "robot = \"xl330_pendulum\"\nbase = \"fixed\"\nrate_hz = 100\n";
    let meta = LogMeta::parse("log.toml", &format!("{head}{meta}")).unwrap();
    RunLog::new(meta, Table::parse("log.csv", text.as_bytes()).unwrap())
}

#[test]
fn what_is_commanded_beside_positions_has_its_units_and_no_position_is_forgotten() {
    let robot = robot("xl330_pendulum");
    let position: Column = ("cmd.swing", |t| 0.6 * (3.0 * t).sin());
    let told = |columns: &[Column], meta: &str, kind: &str, at: &str| {
        found(&one(&robot, &swinging(columns, meta)), kind, at);
    };
    let degrees: Column = ("cmd_vel.swing", |t| 57.3 * 1.8 * (3.0 * t).cos());
    told(&[position, degrees], "", "unit", "cmd_vel.swing");
    told(&[position, ("cmd_tau.swing", |t| 300.0 * t.sin())], "", "unit", "cmd_tau.swing");
    told(&[("cmd_tau.swing", |t| 0.3 * t.sin())], "", "columns", "cmd.swing");
    told(&[position, ("pos2.swing", |t| 0.4 + 0.6 * (3.0 * t).sin())], "", "zero", "pos2.swing");
    // a spring in the gear gives now one way and now the other
    let gives: Column = ("pos2.swing", |t| 0.1 + 0.6 * (3.0 * t).sin() - 0.05 * t.sin());
    let faults = one(&robot, &swinging(&[position, gives], "")).faults;
    assert!(faults.iter().any(|f| f.kind == "zero" && !f.fatal), "{faults:#?}");
    let good = [
        swinging(&[position, ("cmd_vel.swing", |t| 1.8 * (3.0 * t).cos())], ""),
        swinging(&[position, ("pos2.swing", |t| 0.02 + 0.6 * (3.0 * t).sin())], ""),
        swinging(&[("cmd_tau.swing", |t| 0.3 * t.sin())], "[joint.swing]\nkp = 0\n"),
    ];
    for log in &good {
        let faults = one(&robot, log).faults;
        let beside = |at: &str| ["cmd", "pos2"].iter().any(|s| at.contains(s));
        assert!(faults.iter().all(|f| !beside(&f.location)), "{faults:#?}");
    }
}

/// A joint that stands under its load, on one count of its encoder, until the row after that of the next command.
#[test]
fn a_joint_that_stands_until_it_is_sent_elsewhere_is_not_stuck() {
    let robot = robot("xl330_pendulum");
    let mut text = String::from("t,cmd.swing,pos.swing\n");
    for k in 0..600_u32 {
        let way = if k / 100 % 2 == 0 { 0.9 } else { -0.9 };
        let since_s = f64::from(k % 100) * 0.01;
        let droop_rad = way * (0.6 - 1.2 * (-since_s / 0.05).exp());
        text += &format!("{},{way},{:.3}\n", f64::from(k) * 0.01, droop_rad);
    }
    let meta = LogMeta::new("xl330_pendulum", BaseHold::Fixed, 100.0);
    let log = RunLog::new(meta, Table::parse("log.csv", text.as_bytes()).unwrap());
    let checked = one(&robot, &log);
    assert!(checked.faults.iter().all(|f| f.kind != "stuck"), "{:#?}", checked.faults);
}

/// No joint can be where a single reading of 1e300 rad puts it; a glitch just beyond the range is let pass.
#[test]
fn one_absurd_reading_is_a_fault_and_is_said_briefly() {
    let robot = robot("xl330_pendulum");
    let log = &logs(&robot, "steps_large", &[7])[0];
    let at = Signal::Position("swing".to_owned());
    let once = |reading| {
        changed(log, |s, k, _, v| if *s == at && k == 100 { v.map(|_| reading) } else { v })
    };
    found(&one(&robot, &once(1e300)), "unit", "pos.swing");
    let said = &one(&robot, &once(1e300)).faults[0].detail;
    assert!(said.len() < 150, "{said}");
    let glitch = one(&robot, &once(4.0));
    assert!(glitch.faults.iter().all(|f| f.kind != "unit"), "{:#?}", glitch.faults);
}

/// The log with these signals of a joint turned.
fn turned(log: &RunLog, kinds: &[&str], joint: &str) -> RunLog {
    let at: Vec<Signal> = kinds.iter().map(|k| format!("{k}.{joint}").parse().unwrap()).collect();
    changed(log, |s, _, _, v| if at.contains(s) { v.map(|x| -x) } else { v })
}

#[test]
fn turned_signs_are_found_and_said_once() {
    let polymander = robot("polymander");
    let swing = robot("xl330_pendulum");
    let both = "turn the sign of the command, or of both";
    for (robot, trials, joints) in [
        (&polymander, ["chirp_medium", "steps_medium", "holds", "gait"], vec!["FL_hip", "HR_knee"]),
        (&swing, ["triangle_fast", "reversals_fast", "multisine", "sines"], vec!["swing"]),
    ] {
        for (trial, joint) in trials.iter().flat_map(|t| joints.iter().map(move |j| (t, j))) {
            let log = &logs(robot, trial, &[3])[0];
            for (kinds, at, says) in [
                (&["pos"][..], "pos", ": turn its sign"),
                (&["cmd"], "pos", both),
                (&["pos", "vel", "cur"], "pos", both),
                (&["vel"], "vel", "one of them"),
            ] {
                let checked = one(robot, &turned(log, kinds, joint));
                let at = format!("{at}.{joint}");
                found(&checked, "sign", &at);
                let [fault] = checked.faults.as_slice() else {
                    panic!("{trial} {kinds:?}: {:#?}", checked.faults)
                };
                assert!(fault.detail.contains(says), "{trial} {kinds:?}: {}", fault.detail);
            }
        }
    }
}

/// Half a period late, a reading goes against its command as one that is turned does.
#[test]
fn a_late_reading_is_not_a_turned_one() {
    let robot = robot("xl330_pendulum");
    for (trial, rows) in [("triangle_fast", 50), ("reversals_fast", 40)] {
        let log = &logs(&robot, trial, &[3])[0];
        let late = changed(log, |s, k, _, _| {
            let back = if matches!(s, Signal::Command(_)) { 0 } else { rows };
            log.table.column(s).unwrap()[k.saturating_sub(back)]
        });
        let checked = one(&robot, &late);
        found(&checked, "stamps", "pos.swing");
        assert!(checked.faults.iter().all(|f| f.kind != "sign"), "{:#?}", checked.faults);
    }
}

#[test]
fn an_error_within_a_count_says_nothing_of_a_current() {
    // a leg folded back under water: the joint rests a count or none off its command, and the current wanders
    // the other way by what friction holds
    let robot = robot("polymander");
    let log = &logs(&robot, "holds", &[3])[0];
    let [cmd, pos, vel, cur]: [Signal; 4] =
        ["cmd", "pos", "vel", "cur"].map(|kind| format!("{kind}.FL_hip").parse().unwrap());
    let resting = |count_rad: f64| {
        changed(log, |s, _, t, v| {
            let off = if (0.4 * t).sin() > 0.0 { 1.0 } else { 0.0 };
            let folded = if t < 2.0 { 0.0 } else { 0.3 };
            match s {
                s if *s == cmd => Some(folded),
                s if *s == pos => Some(folded - count_rad * off),
                s if *s == vel => Some(0.0),
                s if *s == cur => Some(-0.1 * off),
                _ => v,
            }
        })
    };
    let within = one(&robot, &resting(0.0015));
    assert!(!within.faults.iter().any(|f| f.location.contains("cur.")), "{:#?}", within.faults);
    found(&one(&robot, &resting(0.02)), "sign", "cur.FL_hip");
}

#[test]
fn other_units_are_found() {
    let robot = robot("polymander");
    for trial in ["chirp_medium", "triangle_medium"] {
        let log = &logs(&robot, trial, &[5])[0];
        let scaled = |at: &str, by: f64| {
            let at: Signal = at.parse().unwrap();
            one(&robot, &changed(log, |s, _, _, v| if *s == at { v.map(|x| x * by) } else { v }))
        };
        found(&scaled("pos.FL_knee", 57.29578), "unit", "pos.FL_knee");
        found(&scaled("cmd.FL_knee", 57.29578), "unit", "cmd.FL_knee");
        found(&scaled("vel.FL_knee", 57.29578), "unit", "vel.FL_knee");
        found(&scaled("vel.FL_knee", 9.549_297), "unit", "vel.FL_knee");
        found(&scaled("cur.FL_knee", 1000.0), "unit", "cur.FL_knee");
        let both = changed(log, |s, _, _, v| {
            let angle = matches!(s, Signal::Command(_) | Signal::Position(_) | Signal::Velocity(_));
            if angle { v.map(|x| x * 57.29578) } else { v }
        });
        found(&one(&robot, &both), "unit", "pos.FL_knee");
        let in_g = changed(log, |s, _, _, v| {
            if matches!(s, Signal::Acceleration(_)) { v.map(|x| x / 9.81) } else { v }
        });
        found(&one(&robot, &in_g), "unit", "imu.acc");
    }
}

#[test]
fn a_torque_in_another_unit_is_found() {
    let robot = robot("polymander");
    let log = &logs(&robot, "chirp_medium", &[5])[0];
    let at = |name: &str| -> Signal { name.parse().unwrap() };
    let column = |name: &str| log.table.column(&at(name)).unwrap();
    let (cmd, pos) = (column("cmd.FL_knee"), column("pos.FL_knee"));
    let with_torque = |by: f64| {
        let signals = [log.table.signals(), &[at("tau.FL_knee")]].concat();
        rebuilt(log, &signals, |k, t| {
            let torque = cmd[k].zip(pos[k]).map(|(u, q)| by * 15.0 * (u - q));
            (t, [log.table.row(k).unwrap(), vec![torque]].concat())
        })
    };
    let faults = one(&robot, &with_torque(1.0)).faults;
    assert!(faults.iter().all(|f| f.kind != "unit"), "{faults:#?}");
    for by in [1e-3, 1e3] {
        found(&one(&robot, &with_torque(by)), "unit", "tau.FL_knee");
    }
}

/// The knee's range ends at −1.26 rad; so far off the zero may be right.
#[test]
fn an_angle_past_the_end_stop_is_noted() {
    let robot = robot("polymander");
    let log = &logs(&robot, "chirp_medium", &[5])[0];
    let knee: Signal = "pos.FL_knee".parse().unwrap();
    let past = |s: &Signal, k: usize, _, v| {
        if *s == knee && (200..220).contains(&k) { Some(-1.6) } else { v }
    };
    let checked = one(&robot, &changed(log, past));
    found(&checked, "range", "pos.FL_knee");
    assert!(checked.faults.iter().all(|f| f.kind != "range" || !f.fatal));
}

#[test]
fn exchanged_joints_are_found() {
    let robot = robot("polymander");
    for trial in ["chirp_medium", "holds", "steps_large"] {
        let log = &logs(&robot, trial, &[6])[0];
        for (a, b) in [("FL_hip", "FL_knee"), ("spine_1", "tail_2")] {
            let other = |s: &Signal| -> Signal {
                let name = |j: &String| {
                    if j == a {
                        b.to_owned()
                    } else if j == b {
                        a.to_owned()
                    } else {
                        j.clone()
                    }
                };
                match s {
                    Signal::Position(j) => Signal::Position(name(j)),
                    Signal::Velocity(j) => Signal::Velocity(name(j)),
                    Signal::Current(j) => Signal::Current(name(j)),
                    s => s.clone(),
                }
            };
            let swapped = changed(log, |s, k, _, _| log.table.column(&other(s)).unwrap()[k]);
            let checked = one(&robot, &swapped);
            if a == "FL_hip" {
                found(&checked, "order", "pos.FL_hip");
            } else {
                // commands that are much alike: that something is wrong must show, not what
                assert_eq!(checked.verdict, CheckVerdict::DataFault, "{trial}");
                assert!(
                    checked
                        .faults
                        .iter()
                        .any(|f| f.location.ends_with(a) || f.location.ends_with(b)),
                    "{:?}",
                    checked.faults
                );
            }
        }
        let doubled = changed(log, |s, k, _, v| {
            if *s == Signal::Position("FR_hip".to_owned()) {
                log.table.column(&Signal::Position("FL_hip".to_owned())).unwrap()[k]
            } else {
                v
            }
        });
        found(&one(&robot, &doubled), "duplicate", "pos.FR_hip");
    }
}

#[test]
fn three_joints_in_each_others_place_are_found_and_one_worn_pair_is_not() {
    let robot = robot("polymander");
    let log = &logs(&robot, "steps_large", &[6])[0];
    let position = |joint: &str| Signal::Position(joint.to_owned());
    let read = |joint: &str, k: usize| log.table.column(&position(joint)).unwrap()[k];
    let names = ["FL_hip", "FL_knee", "FR_hip"];
    let round = changed(log, |s, k, _, v| {
        let at = names.iter().position(|j| *s == position(j));
        at.map_or(v, |i| read(names[(i + 1) % 3], k))
    });
    let checked = one(&robot, &round);
    for name in names {
        found(&checked, "order", &format!("pos.{name}"));
    }
    // a joint that is dragged along by its neighbour, which itself gives way: what the neighbour leaves is
    // nobody's
    let worn = changed(log, |s, k, _, v| {
        let hip = read("FL_hip", k);
        if *s == position("FL_knee") {
            hip.map(|x| 0.9 * x)
        } else if *s == position("FL_hip") {
            Some(0.5 * (hip? - read("FR_hip", k)?))
        } else {
            v
        }
    });
    let faults = one(&robot, &worn).faults;
    assert!(faults.iter().all(|f| f.kind != "order"), "{faults:?}");
}

#[test]
fn stuck_channels_are_found() {
    let robot = robot("polymander");
    let log = &logs(&robot, "steps_large", &[7])[0];
    let at = Signal::Position("FL_hip".to_owned());
    let stuck =
        changed(
            log,
            |s, k, _, v| {
                if *s == at && k > 100 { log.table.column(&at).unwrap()[100] } else { v }
            },
        );
    found(&one(&robot, &stuck), "stuck", "pos.FL_hip");
    let at = Signal::Velocity("FL_hip".to_owned());
    let stuck = changed(log, |s, _, _, v| if *s == at { Some(0.0) } else { v });
    found(&one(&robot, &stuck), "parity", "vel.FL_hip");
    // an encoder that is not read, of a joint that is asked to go one way only
    let rig = crate::common::robot("xl330_pendulum");
    let log = &logs(&rig, "steps_large", &[7])[0];
    let dead = changed(log, |s, _, _, v| match s {
        Signal::Position(_) => Some(0.0),
        Signal::Command(_) => v.map(f64::abs),
        _ => v,
    });
    found(&one(&rig, &dead), "stuck", "pos.swing");
}

#[test]
fn a_current_without_its_sign_or_that_nobody_reads_is_found() {
    for robot in ["polymander", "xl330_pendulum"].map(robot) {
        let log = &logs(&robot, "holds", &[3])[0];
        for (kind, put) in [("sign", f64::abs as fn(f64) -> f64), ("stuck", |_| 0.0)] {
            let changed = changed(log, |s, _, _, v| match s {
                Signal::Current(_) => v.map(put),
                _ => v,
            });
            let checked = one(&robot, &changed);
            let hits = checked.faults.iter().filter(|f| f.kind == kind).count();
            assert!(hits > 0, "{kind}: {:#?}", checked.faults);
        }
    }
}

#[test]
fn a_current_that_holds_a_weight_all_the_time_has_its_sign() {
    // 0.5 N·m one way; the error that gives it goes both ways with the damping: e = (0.5 + kd·q̇)/kp
    let robot = robot("polymander");
    let held = |kd: f64| {
        let mut log = logs(&robot, "chirp_medium", &[3]).remove(0);
        (log.meta.kp, log.meta.kd) = (Some(20.0), Some(kd));
        let [cmd, pos, cur]: [Signal; 3] =
            ["cmd", "pos", "cur"].map(|kind| format!("{kind}.FL_hip").parse().unwrap());
        let changed = changed(&log, |s, _, t, v| match s {
            s if *s == cmd => {
                Some(0.3 * (2.0 * t).sin() + (0.5 + 2.0 * 0.6 * (2.0 * t).cos()) / 20.0)
            }
            s if *s == pos => Some(0.3 * (2.0 * t).sin()),
            s if *s == cur => Some(0.3 + 0.02 * (9.0 * t).sin()),
            _ => v,
        });
        let faults = one(&robot, &changed).faults;
        faults.iter().any(|f| f.kind == "sign" && f.location.ends_with("cur.FL_hip"))
    };
    assert!(held(0.0));
    assert!(!held(2.0));
}

#[test]
fn a_motor_that_brakes_itself_leaves_an_error_without_a_current() {
    // kp = 0.886 N·m/rad, back-EMF 0.0482 N·m·s/rad, q = sin 4t, 0.06 N·m held: e = (0.06 + 4·0.0482·cos 4t)/kp goes
    // from 0.285 to −0.150 rad while the motor gives 0.06 N·m all the time; what counts as much is 0.05·0.77 N·m.
    // With twice that in the error it gives 0.06 + 0.193·cos 4t, both ways.
    let robot = robot("xl330_pendulum");
    let held = |braking_nm: f64| {
        let mut log = logs(&robot, "chirp_medium", &[3]).remove(0);
        (log.meta.kp, log.meta.kd) = (Some(0.886), None);
        let [cmd, pos, cur]: [Signal; 3] =
            ["cmd", "pos", "cur"].map(|kind| format!("{kind}.swing").parse().unwrap());
        let changed = changed(&log, |s, _, t, v| match s {
            s if *s == cmd => Some((4.0 * t).sin() + (0.06 + braking_nm * (4.0 * t).cos()) / 0.886),
            s if *s == pos => Some((4.0 * t).sin()),
            s if *s == cur => Some(0.17 + 0.01 * (9.0 * t).sin()),
            _ => v,
        });
        let faults = one(&robot, &changed).faults;
        faults.iter().any(|f| f.kind == "sign" && f.location.ends_with("cur.swing"))
    };
    assert!(!held(0.193));
    assert!(held(0.386));
}

#[test]
fn a_misspelt_key_is_found_and_one_that_nobody_reads_is_named() {
    let robot = robot("xl330_pendulum");
    for (key, fault) in [("Kp", true), ("suply_v", true), ("kp_register", false)] {
        let mut log = logs(&robot, "holds", &[3]).remove(0);
        log.meta_name = "hold.toml".to_owned();
        log.meta.settings.insert(key.to_owned(), Setting::Number(1.0));
        let checked = one(&robot, &log);
        assert_eq!(checked.verdict == CheckVerdict::DataFault, fault, "{key}");
        if fault {
            found(&checked, "meta", "hold.toml");
        }
        assert_eq!(checked.not_used[&format!("setting {key}")], 1);
    }
}

/// The rows of a log that `keep` keeps.
fn thinned(log: &RunLog, keep: impl Fn(usize) -> bool) -> RunLog {
    let mut csv = TableWriter::new(Vec::new(), log.table.signals(), f64::INFINITY).unwrap();
    for k in (0..log.table.len()).filter(|k| keep(*k)) {
        csv.row(log.table.time_s()[k], &log.table.row(k).unwrap()).unwrap();
    }
    RunLog::new(
        log.meta.clone(),
        Table::parse("log.csv", csv.finish().unwrap().as_slice()).unwrap(),
    )
}

#[test]
fn rows_that_are_missing_one_by_one_are_counted() {
    let robot = robot("xl330_pendulum");
    let log = &logs(&robot, "chirp_medium", &[8])[0];
    for (percent, verdict) in [(4, CheckVerdict::Ok), (15, CheckVerdict::DataFault)] {
        // so many of a hundred, in no order
        let checked = one(&robot, &thinned(log, |k| k * 37 % 100 >= percent));
        found(&checked, "gap", "t");
        assert_eq!(checked.verdict, verdict, "{:#?}", checked.faults);
    }
}

#[test]
fn readings_that_are_late_are_found() {
    let robot = robot("xl330_pendulum");
    let log = &logs(&robot, "steps_large", &[8])[0];
    let late = |rows: usize| {
        let signals = log.table.signals().to_vec();
        rebuilt(log, &signals, |k, t| {
            let read = log.table.row(k.saturating_sub(rows)).unwrap();
            let sent = log.table.row(k).unwrap();
            let cells = signals.iter().zip(read.iter().zip(&sent));
            let of = |(s, (read, sent)): (&Signal, (&Option<f64>, &Option<f64>))| match s {
                Signal::Command(_) => *sent,
                _ => *read,
            };
            (t, cells.map(of).collect())
        })
    };
    found(&one(&robot, &late(20)), "stamps", "pos.swing");
    // 60 ms is a delay that a robot may have
    assert!(one(&robot, &late(6)).faults.is_empty());
}

#[test]
fn a_trunk_that_stands_still_while_joints_move_is_asked_about() {
    let robot = robot("polymander");
    let walk = &logs(&robot, "gait", &[9])[0];
    let asked = |log: &RunLog| one(&robot, log).faults.iter().any(|f| f.kind == "base");
    assert!(!asked(walk));
    // an offset does not turn
    let mut log = changed(walk, |s, _, _, v| match s {
        Signal::Gyro(_) => v.map(|_| 0.03),
        _ => v,
    });
    assert!(asked(&log));
    log.meta.base = BaseHold::Fixed;
    assert!(!asked(&log));
    let joints_alone = changed(walk, |s, _, _, v| match s {
        Signal::Command(_) | Signal::Position(_) => v,
        _ => None,
    });
    assert!(asked(&joints_alone));
}

/// A swing that repeats itself fits with a lag of a period as well, and beyond its resonance a servo goes
/// against it.
#[test]
fn nothing_is_said_of_a_quick_swing() {
    let robot = robot("xl330_pendulum");
    let mut trial = excite::trial(&robot, "chirp_small", None, 100.0).unwrap();
    for hz in [1.7, 2.2, 2.6, 3.1, 4.0] {
        let at = |k: i32| 0.3 * (std::f64::consts::TAU * hz * f64::from(k) / 100.0).sin();
        trial.commands_rad = (0..1000).map(|k| vec![at(k)]).collect();
        let runs = simulate(&robot, &trial, &[5], None);
        let checked = one(&robot, &record(&robot, &trial, &runs[0], 5));
        assert!(checked.faults.is_empty(), "{hz} Hz: {:#?}", checked.faults);
    }
}

#[test]
fn wrong_stamps_are_found() {
    let robot = robot("polymander");
    for trial in ["chirp_medium", "steps_medium"] {
        let log = &logs(&robot, trial, &[8])[0];
        let signals = log.table.signals().to_vec();
        let row = |k: usize| log.table.row(k).unwrap();
        // milliseconds for seconds
        found(&one(&robot, &rebuilt(log, &signals, |k, t| (1000.0 * t, row(k)))), "unit", "t");
        // or of a log of 2 kHz
        let quick = rebuilt(log, &signals, |k, _| (0.5 * k as f64, row(k)));
        let checked = one(&robot, &quick);
        found(&checked, "unit", "t");
        assert!(checked.faults[0].detail.contains("is `t` in ms?"), "{:?}", checked.faults);
        // a clock that runs twice too fast, with its rate claimed accordingly
        let mut fast = rebuilt(log, &signals, |k, t| (0.5 * t, row(k)));
        fast.meta.rate_hz = 200.0;
        found(&one(&robot, &fast), "stamps", "t");
        // rows written in batches of ten
        let batched =
            rebuilt(log, &signals, |k, _| (0.1 * (k / 10) as f64 + 2e-4 * (k % 10) as f64, row(k)));
        found(&one(&robot, &batched), "stamps", "t");
        // the clock is set ahead by 0.3 s in the middle; a second and a half are missing
        // (at rest the one looks like the other)
        let set = rebuilt(log, &signals, |k, t| (if t > 5.03 { t + 0.3 } else { t }, row(k)));
        if trial == "chirp_medium" {
            found(&one(&robot, &set), "stamps", "t");
        }
        let checked = one(&robot, &thinned(log, |k| !(500..650).contains(&k)));
        found(&checked, "gap", "t");
        assert_eq!(checked.verdict, CheckVerdict::Ok, "{:#?}", checked.faults);
        // readings 150 ms too early for their commands
        let at = |k: usize, s: &Signal| {
            let k =
                if matches!(s, Signal::Command(_)) { k } else { (k + 15).min(log.table.len() - 1) };
            log.table.column(s).unwrap()[k]
        };
        let early = changed(log, |s, k, _, _| at(k, s));
        found(&one(&robot, &early), "stamps", "");
    }
}

#[test]
fn a_wrong_imu_is_found() {
    let robot = robot("polymander");
    let log = &logs(&robot, "rock_x", &[9])[0];
    let imu = |of: fn(Axis) -> Signal, from: [usize; 3], sign: [f64; 3]| {
        one(
            &robot,
            &changed(log, |s, k, _, v| {
                let Some(i) = Axis::ALL.iter().position(|a| of(*a) == *s) else {
                    return v;
                };
                log.table.column(&of(Axis::ALL[from[i]])).unwrap()[k].map(|x| sign[i] * x)
            }),
        )
    };
    found(&imu(Signal::Gyro, [0, 1, 2], [-1.0; 3]), "sign", "imu.gyro");
    found(&imu(Signal::Gyro, [1, 0, 2], [1.0, 1.0, 1.0]), "order", "imu.gyro");
    found(&imu(Signal::Acceleration, [0, 1, 2], [-1.0; 3]), "sign", "imu.acc");
    found(&imu(Signal::Acceleration, [0, 2, 1], [1.0; 3]), "order", "imu.acc");
    found(&imu(Signal::Gyro, [0, 1, 2], [57.3; 3]), "unit", "imu.gyro");
    // what both others go against
    let checked = imu(Signal::Gravity, [0, 1, 2], [1.0, 1.0, -1.0]);
    found(&checked, "sign", "imu.grav");
    assert_eq!(checked.faults.len(), 1, "{:#?}", checked.faults);
}

#[test]
fn a_touch_shows_between_repeats() {
    let robot = robot("xl330_pendulum");
    for name in ["triangle_medium", "chirp_medium", "holds"] {
        let trial = excite::trial(&robot, name, None, 100.0).unwrap();
        let seeds = [11, 12, 13];
        let touch = Touch { from_s: 4.0, to_s: 5.0, force_n: [3.0, 0.0, 0.0], run: 1 };
        let runs = simulate(&robot, &trial, &seeds, Some(touch));
        let logs: Vec<RunLog> =
            runs.iter().zip(seeds).map(|(r, s)| record(&robot, &trial, r, s)).collect();
        let checked = all(&robot, &logs);
        assert_eq!(checked.odd_spans.len(), 1, "{name}: {:?}", checked.odd_spans);
        let span = &checked.odd_spans[0];
        assert!(
            span.run == "run_1"
                && span.from_s > 3.8
                && span.from_s < 4.4
                && span.to_s > 4.6
                && span.to_s < 5.8,
            "{span:?}"
        );
        found(&checked, "touch", "swing");
        // worth knowing, and no reason to stop
        assert_eq!(checked.verdict, CheckVerdict::Ok);
    }
}

#[test]
fn bad_logs_get_a_clear_line() {
    let robot = robot("polymander");
    let log = logs(&robot, "steps_small", &[1]).remove(0);
    let says = |csv: &str, want: &str| {
        let log = RunLog::new(log.meta.clone(), Table::parse("log.csv", csv.as_bytes()).unwrap());
        let checked = one(&robot, &log);
        assert_eq!(checked.verdict, CheckVerdict::DataFault);
        assert!(
            checked.faults.iter().any(|f| f.fatal && f.detail.contains(want)),
            "{want}: {:#?}",
            checked.faults
        );
    };
    let rows = |header: &str, cells: &str, n: usize| -> String {
        let body: String = (0..n).map(|k| format!("{:.2},{cells}\n", 0.01 * k as f64)).collect();
        format!("{header}\n{body}")
    };
    says(&rows("t,cmd.FL_hip,pos.FL_hip", "0,0", 101), "is 1.00 s long");
    says(&rows("t,cmd.wing,pos.wing", "0,0", 501), "a log of another robot");
    says(
        &rows("t,cmd.FL_hip,pos.FL_hip,pos.wing", "0,0,0", 501),
        "has wing and `polymander` has no such joint",
    );
    says(&rows("t,cmd.FL_hip", "0", 501), "has no column `pos.<joint>`");
    says(&rows("t,pos.FL_hip", "0", 501), "has no column `cmd.<joint>`");
    says(&rows("t,volt", "14", 501), "has no joint column");
    says("t,cmd.FL_hip,pos.FL_hip\n", "0 rows");
    // an empty column is worth a note only
    let log = RunLog::new(
        log.meta.clone(),
        Table::parse("log.csv", rows("t,cmd.FL_hip,pos.FL_hip,vel.FL_hip", "0,0,", 501).as_bytes())
            .unwrap(),
    );
    let checked = one(&robot, &log);
    assert_eq!(checked.verdict, CheckVerdict::Ok);
    found(&checked, "empty", "vel.FL_hip");
}

#[test]
fn what_cannot_be_told_is_listed_with_what_would_tell_it() {
    let robot = robot("polymander");
    let gait = all(&robot, &logs(&robot, "gait_slow", &[1]));
    for effect in ["pre_sliding", "hard_stop", "thermal_derating", "quadratic_drag", "clock_drift"]
    {
        let blind = gait
            .cannot_tell
            .get(effect)
            .unwrap_or_else(|| panic!("{effect} could show: {:#?}", gait.runs[0].excites));
        assert!(
            excite::names(&robot, None).contains(&blind.record.as_str()),
            "{effect}: {}",
            blind.record
        );
    }
    // an IMU was there: play between the girdles can show
    assert!(!gait.cannot_tell.contains_key("girdle_play"));
    let rig = crate::common::robot("xl330_pendulum");
    let both: Vec<RunLog> =
        ["chirp_small", "holds"].iter().flat_map(|t| logs(&rig, t, &[1])).collect();
    let checked = all(&rig, &both);
    for effect in ["command_delay", "kp_error"] {
        assert!(
            !checked.cannot_tell.contains_key(effect),
            "{:?} {:#?}",
            checked.cannot_tell[effect],
            checked.runs
        );
    }
    for (effect, why) in [
        ("contact_friction", "a rig without feet cannot have it"),
        ("fed_torque", "no torque is commanded"),
        ("outer_force", "nothing pushes"),
    ] {
        assert!(!checked.cannot_tell.contains_key(effect), "{why}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever reads as a log is checked without a panic, and every line is one line.
    #[test]
    fn any_log_is_checked(cells in proptest::collection::vec(proptest::option::of(-1e9f64..1e9), 5 * 60..5 * 200), step in 1e-9f64..10.0, scale in -12i32..9) {
        let robot = robot("xl330_pendulum");
        let mut csv = String::from("t,cmd.swing,pos.swing,vel.swing,cur.swing,temp.swing\n");
        for (k, row) in cells.chunks_exact(5).enumerate() {
            let text: Vec<String> = row.iter().map(|c| c.map_or(String::new(), |x| format!("{:?}", x * 10f64.powi(scale)))).collect();
            csv.push_str(&format!("{:?},{}\n", k as f64 * step, text.join(",")));
        }
        if let Ok(table) = Table::parse("log.csv", csv.as_bytes()) {
            let meta = caudata_runlog::LogMeta::new("rig", caudata_runlog::BaseHold::Fixed, 100.0);
            let log = RunLog::new(meta, table);
            let checked = all(&robot, &[log.clone(), log]);
            prop_assert!(checked.faults.iter().all(|f| !f.detail.contains('\n')));
            serde_json::to_string(&checked).unwrap();
        }
    }
}
