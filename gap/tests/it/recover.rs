//! Whole diagnoses of a bench rig whose truth is known: the engine in double precision with a quarter of the
//! step, counts and noise on top.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use caudata_gap::repeats;
use caudata_gap::replay::{Data, Replayer, SegmentOptions};
use caudata_gap::report::{Cause, DataFault, Verdict};
use caudata_gap::trial::Trial;
use caudata_gap::{Diagnosis, GapError, GoOn, Options, Request, Role, Run, diagnose, extension};
use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::{Axis, BaseHold, LogMeta, QuatPart, RunLog, Signal, Table};
use caudata_sim::batch::BatchEngine;
use caudata_sim::{
    Engine, EngineConfig, InitialState, LaneParams, Precision, Terrain, TerrainConfig,
};

use crate::common;

const ROWS_HZ: f64 = 100.0;

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots").join(name)
}

fn bytes() -> (Vec<u8>, Vec<u8>) {
    let read = |name: &str| std::fs::read(path(name)).unwrap();
    (read("xl330_pendulum.robot.toml"), read("xl330_pendulum.xml"))
}

/// Command of trial `kind` at time `t`, rad.
fn command(kind: usize, t: f64) -> f64 {
    match kind {
        0 => 0.8 * (std::f64::consts::TAU * (0.3 * t + 0.12 * t * t)).sin(),
        1 => [0.0, 0.5, -0.4, 0.9, 0.2, -0.9, 0.7, 0.0][(t / 1.1) as usize % 8],
        3 => 0.02 * (0.5 * t).sin(),
        _ => 0.6 * (2.1 * t).sin() + 0.35 * (5.3 * t).sin(),
    }
}

/// A recording of `kind` by a robot with `change`; the command arrives `late` rows late.
fn record(kind: usize, repeat: u64, late: usize, change: &dyn Fn(&mut LaneParams)) -> RunLog {
    let model = Arc::new(RobotModel::load(&path("xl330_pendulum.robot.toml")).unwrap());
    let mut params = LaneParams::nominal(&model);
    let key = Key { env: kind as u64, episode: repeat, ..Key::for_run(11) };
    let mut noise = Stream::new(key, Purpose::Sensor);
    // no two runs are the same
    params.joint_friction_nm[0] = 0.01 * (1.0 + 0.05 * noise.normal());
    change(&mut params);
    // a loop takes the rate of its error over 1 ms
    let substeps = if params.joints[0].kd_on_command > 0.0 { 10 } else { 20 };
    let config = EngineConfig {
        dt_s: 1.0 / ROWS_HZ / f64::from(substeps),
        substeps,
        precision: Precision::Double,
        fixed_base: true,
        centred: true,
        ..EngineConfig::default()
    };
    let terrain = Arc::new(Terrain::generate(&TerrainConfig::default(), 1).unwrap());
    let mut engine = BatchEngine::new(Arc::clone(&model), 1, config, terrain, 1).unwrap();
    engine.set_params(0, &params).unwrap();
    let mut init = InitialState::nominal(&model);
    init.joint_pos_rad[0] = command(kind, 0.0) as f32;
    engine.reset(0, &init).unwrap();
    let round = |x: f64, lsb: f64| (x / lsb).round() * lsb;
    let mut text = String::from("t,cmd.swing,pos.swing,vel.swing,tau.swing\n");
    for k in 0..800_usize {
        let t = k as f64 / ROWS_HZ;
        let state = engine.state();
        let q = f64::from(state.joint_pos_rad[0]) + 0.0002 * f64::from(noise.normal());
        let v = f64::from(state.joint_vel_radps[0]) + 0.01 * f64::from(noise.normal());
        let torque = f64::from(state.motor_torque_nm[0]) + 0.003 * f64::from(noise.normal());
        let u = command(kind, t);
        text += &format!(
            "{t},{u},{},{},{torque}\n",
            round(q, std::f64::consts::TAU / 4096.0),
            round(v, 0.02398)
        );
        let heard = command(kind, (k.saturating_sub(late)) as f64 / ROWS_HZ);
        engine.step(&[heard as f32], &[0.0; 6]).unwrap();
    }
    let mut meta = LogMeta::new("xl330_pendulum", BaseHold::Fixed, ROWS_HZ);
    meta.supply_v = Some(7.4);
    RunLog::new(meta, Table::parse("log.csv", text.as_bytes()).unwrap())
}

/// The nominal robot of these tests has a little friction.
fn robot() -> (Vec<u8>, Vec<u8>) {
    let (toml, mjcf) = bytes();
    let text = String::from_utf8(toml).unwrap();
    let text = text.replacen("friction_loss_nm = 0.0 ", "friction_loss_nm = 0.01 ", 1);
    (text.into_bytes(), mjcf)
}

fn request(late: usize, change: &dyn Fn(&mut LaneParams)) -> Request {
    let (robot_toml, mjcf) = robot();
    let mut runs = Vec::new();
    for (kind, role) in [(0, Role::Fit), (1, Role::Fit), (2, Role::Holdout)] {
        for repeat in 0..2 {
            runs.push(Run {
                name: format!("{kind}_{repeat}"),
                log: record(kind, repeat, late, change),
                role,
                sha256: String::new(),
            });
        }
    }
    Request {
        robot_toml,
        mjcf,
        label: "xl330_pendulum.robot.toml".to_owned(),
        runs,
        data_faults: Vec::new(),
        options: Options::default(),
    }
}

fn run(late: usize, change: &dyn Fn(&mut LaneParams)) -> (Request, Diagnosis) {
    let request = request(late, change);
    let diagnosis = diagnose(&request, &mut |_| {}).unwrap();
    (request, diagnosis)
}

fn names(d: &Diagnosis) -> Vec<&str> {
    d.report.causes.iter().map(|c| c.effect.as_str()).collect()
}

#[test]
fn nothing_is_found_where_nothing_is_wrong() {
    let (_, d) = run(0, &|_| {});
    assert_eq!(d.report.verdict, Verdict::NoGap, "{} {:?}", d.report.summary, names(&d));
    // what is carried is small and has no name, and is nearer to held-out runs all the same
    let carried = &d.report.model;
    assert!(carried.iter().all(|c| !c.named), "{carried:?}");
    for (name, value) in carried.iter().flat_map(|c| &c.parameters) {
        let small = match name.as_str() {
            "scale" => (value - 1.0).abs() < 0.02,
            // of the load that the gear passes on
            "share" => value.abs() < 0.02,
            _ => value.abs() < 0.003,
        };
        assert!(small, "{name} {value}");
    }
    let errors = &d.report.position_errors;
    let of = |model: &str| errors.iter().find(|e| e.model == model).unwrap().mean_rad;
    assert!(of("extended") < 0.9 * of("as given"), "{errors:?}");
    let floor = &d.report.detection_floor["kp_error@swing"];
    assert!(floor.excited && (floor.value - 1.0).abs() < 0.25, "{floor:?}");
}

#[test]
fn nothing_is_found_where_nothing_is_repeated_and_one_run_is_slow() {
    // speeds are differences of counts of the angle, and the slow one's is zero in most rows
    let once = |change: &dyn Fn(&mut LaneParams)| {
        let mut asked = request(0, change);
        asked.runs.retain(|run| run.name.ends_with("_0"));
        let log = record(3, 0, 0, change);
        asked.runs.push(Run {
            name: "3_0".to_owned(),
            log,
            role: Role::Fit,
            sha256: String::new(),
        });
        for run in &mut asked.runs {
            let table = run.log.table.clone();
            let angles = table.signals().iter().position(|s| matches!(s, Signal::Position(_)));
            let angle = |k: usize| table.row(k).unwrap()[angles.unwrap()].unwrap();
            run.log = common::changed(&run.log, |s, k, _, value| match s {
                Signal::Velocity(_) => {
                    let (before, after) = (k.saturating_sub(1), (k + 1).min(table.len() - 1));
                    Some((angle(after) - angle(before)) * ROWS_HZ / (after - before) as f64)
                }
                _ => value,
            });
        }
        asked
    };
    let d = diagnose(&once(&|_| {}), &mut |_| {}).unwrap();
    assert_eq!(d.report.verdict, Verdict::NoGap, "{} {:?}", d.report.summary, names(&d));

    let mut rubs = once(&|p| p.joint_friction_nm[0] += 0.05);
    rubs.options.only = vec!["cogging".to_owned()];
    let d = diagnose(&rubs, &mut |_| {}).unwrap();
    assert_eq!(d.report.verdict, Verdict::Unexplained, "{} {:?}", d.report.summary, names(&d));
    assert!(d.report.summary.contains("No run has a repeat"), "{}", d.report.summary);
}

#[test]
fn a_stop_that_angles_pass_is_told_and_simulated_nowhere() {
    let mut asked = request(0, &|_| {});
    let wide = String::from_utf8(asked.mjcf.clone()).unwrap();
    let logs = asked.runs.iter().map(|run| &run.log.table);
    let angles = logs.flat_map(|t| {
        let at = t.signals().iter().position(|s| matches!(s, Signal::Position(_))).unwrap();
        (0..t.len()).filter_map(move |k| t.row(k).unwrap()[at])
    });
    let farthest = angles.fold(0.0, f64::max);
    // far beyond both, and by less than a hundredth of the range beyond one
    for range in [[-0.5, 0.6], [-6.0, farthest - 0.05]] {
        let narrow = format!("range=\"{} {}\"", range[0], range[1]);
        asked.mjcf = wide.replacen("range=\"-3.14159 3.14159\"", &narrow, 1).into_bytes();
        let d = diagnose(&asked, &mut |_| {}).unwrap();
        assert_eq!(d.report.verdict, Verdict::NoGap, "{} {:?}", d.report.summary, names(&d));
        let told = |f: &&DataFault| f.kind == "range" && f.location == "swing" && !f.fatal;
        assert_eq!(d.report.data_faults.iter().filter(told).count(), 1);
        assert!(d.report.summary.contains("past the end stop"), "{}", d.report.summary);
        assert_eq!(d.extension.effect[0].id, "passed_stop");
        assert!(d.extension.lane["joints.swing.high_rad"] > farthest - 1e-3);
    }

    // where there is another one behind it, that is found
    let stop = 0.4 * farthest;
    let mut asked = request(0, &|p| p.joints[0].high_rad = stop as f32);
    let narrow = format!("range=\"-3.14159 {}\"", stop - 0.03);
    asked.mjcf = wide.replacen("range=\"-3.14159 3.14159\"", &narrow, 1).into_bytes();
    let d = diagnose(&asked, &mut |_| {}).unwrap();
    assert_eq!(names(&d), ["hard_stop"], "{}", d.report.summary);
    let found = d.extension.lane["joints.swing.high_rad"];
    assert!((found - stop).abs() < 0.005, "{found} {stop}");
    // and its interval goes by how far the joint would get, not by the 4 rad at which no stop is
    let high = &d.report.causes[0].parameters["high_rad"];
    assert!((high.ci_low..=high.ci_high).contains(&stop), "{high:?} {stop}");
    assert!(high.ci_high - high.ci_low < 0.4 * (farthest - stop), "{high:?} {farthest}");
    assert!(d.report.summary.contains("past the end stop"), "{}", d.report.summary);
}

/// The joint as given comes to its stop, with a larger rotor it is thrown beyond: the stop is right.
#[test]
fn a_stop_into_which_a_cause_throws_the_joint_is_none() {
    const STOP_RAD: f64 = 0.5;
    let mut asked = request(0, &|p| {
        p.joints[0].high_rad = STOP_RAD as f32;
        p.joint_armature_kgm2[0] += 0.006;
    });
    let narrow = format!("range=\"-3.14159 {STOP_RAD}\"");
    let wide = String::from_utf8(asked.mjcf.clone()).unwrap();
    asked.mjcf = wide.replacen("range=\"-3.14159 3.14159\"", &narrow, 1).into_bytes();
    let d = diagnose(&asked, &mut |_| {}).unwrap();
    assert_eq!(names(&d), ["armature"], "{}", d.report.summary);
    assert!(!d.report.summary.contains("past the end stop"), "{}", d.report.summary);
}

/// A joint that works far from zero, as a calf does: only where it came to tells of the stop.
#[test]
fn a_stop_is_found_wherever_it_is() {
    const ZERO_RAD: f64 = -2.0;
    let stop = ZERO_RAD + 0.37;
    let mut asked = request(0, &|p| p.joints[0].high_rad = (stop - ZERO_RAD) as f32);
    let text = String::from_utf8(asked.mjcf.clone()).unwrap();
    let turned = format!("pos=\"0 0 0.5\" euler=\"0 {} 0\"", -ZERO_RAD);
    asked.mjcf = text.replacen("pos=\"0 0 0.5\"", &turned, 1).into_bytes();
    for run in &mut asked.runs {
        run.log = common::changed(&run.log, |s, _, _, value| match s {
            Signal::Command(_) | Signal::Position(_) => value.map(|q| q + ZERO_RAD),
            _ => value,
        });
    }
    let d = diagnose(&asked, &mut |_| {}).unwrap();
    assert_eq!(names(&d), ["hard_stop"], "{}", d.report.summary);
    let [low, high] = ["low_rad", "high_rad"].map(|end| &d.report.causes[0].parameters[end]);
    assert!((high.value - stop).abs() < 0.005 && !high.at_bound, "{high:?}");
    assert!((high.ci_low..=high.ci_high).contains(&stop), "{high:?}");
    // the other end may be anywhere that the joint did not come to
    assert!(low.ci_high < ZERO_RAD - 0.7 && low.ci_low < low.ci_high, "{low:?}");
}

#[test]
fn what_held_out_runs_do_not_have_is_no_finding_and_is_not_carried() {
    let mut asked = request(0, &|_| {});
    let rubs = |p: &mut LaneParams| p.joint_friction_nm[0] += 0.06;
    for (kind, of_kind) in asked.runs.chunks_mut(2).enumerate().take(2) {
        for (repeat, run) in of_kind.iter_mut().enumerate() {
            run.log = record(kind, repeat as u64, 0, &rubs);
        }
    }
    let d = diagnose(&asked, &mut |_| {}).unwrap();
    let told = &d.report.summary;
    assert!(names(&d).is_empty(), "{told}");
    assert!(d.report.model.is_empty() && d.extension.effect.is_empty());
    assert_eq!(d.report.verdict, Verdict::InsufficientData, "{told}");
    assert!(told.contains("held-out runs are no nearer"), "{told}");
}

#[test]
fn a_weight_at_the_tip_is_told_with_its_place_where_torque_was_measured() {
    let model = RobotModel::load(&path("xl330_pendulum.robot.toml")).unwrap();
    let l = model.joints()[model.actuated()[0]].child_link;
    let link = &model.links()[l];
    let far_m = link.com_m.iter().map(|x| x * x).sum::<f64>().sqrt();
    let (grows, of_link) = (1.4, link.mass_kg);
    let trace: f64 = (0..3).map(|i| link.inertia_kgm2[i][i]).sum();
    // 0.4 of the link's mass, half as far again as its centre
    let (extra_kg, lever_m) = (0.4 * of_link, 1.5 * far_m);
    let com_m = (far_m + 0.4 * lever_m) / grows;
    let moved = 2.0 * of_link * ((com_m - far_m).powi(2) + 0.4 * (lever_m - com_m).powi(2));
    let (_, d) = run(0, &|p| {
        p.link_mass_scale[l] = grows as f32;
        p.link_inertia_scale[l] = ((trace + moved) / (trace * grows)) as f32;
        for (offset, x) in p.com_offset_m[l].iter_mut().zip(link.com_m) {
            *offset = (x * (com_m / far_m - 1.0)) as f32;
        }
    });
    let first = &d.report.causes[0];
    assert_eq!(first.effect, "point_mass", "{}", d.report.summary);
    let off = |name: &str, want: f64| (first.parameters[name].value / want - 1.0).abs();
    assert!(off("extra_kg", extra_kg) < 0.1, "{:?}", first.parameters);
    assert!(off("lever_m", lever_m) < 0.1, "{:?}", first.parameters);
}

#[test]
fn a_soft_loop_is_named_and_its_score_comes_again_from_the_file() {
    let (request, d) = run(0, &|p| p.kp_nm_per_rad[0] *= 0.75);
    let first = &d.report.causes[0];
    let same = ["kp_error", "stale_gains", "winding_resistance"];
    assert!(same.contains(&first.effect.as_str()), "{:?}", names(&d));
    assert!(d.report.gain["pos"].ratio < 0.3, "{:?}", d.report.gain);
    if first.effect == "kp_error" {
        let p = &first.parameters["scale"];
        assert!((p.value - 0.75).abs() < 0.04, "{p:?}");
    }
    // the extended file, loaded through the ordinary reader, predicts held-out runs to the bit
    let text =
        extension::append(&d.extension, std::str::from_utf8(&request.robot_toml).unwrap()).unwrap();
    let extended =
        Arc::new(RobotModel::from_bytes("extended", text.as_bytes(), &request.mjcf).unwrap());
    let plain =
        Arc::new(RobotModel::from_bytes("plain", &request.robot_toml, &request.mjcf).unwrap());
    let mut trials: Vec<Trial> = (request.runs.iter().filter(|r| r.role == Role::Holdout))
        .map(|r| caudata_gap::reading::trial(&plain, r).unwrap())
        .collect();
    repeats::group(&plain, &mut trials);
    let data = Data::new(&plain, repeats::collapse(&trials), SegmentOptions::default());
    let from_file =
        Replayer::new(Arc::clone(&extended), 2).unwrap().predict(&data, &[Vec::new()]).unwrap();
    let terms = extension::terms(&d.extension, &plain).unwrap();
    let in_memory = Replayer::new(plain, 1).unwrap().predict(&data, &[terms]).unwrap();
    let bits = |x: &[Vec<f32>]| x[0].iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&from_file), bits(&in_memory));
    let square = |x: &[f32]| -> f64 {
        let pos = data.segments.iter().flat_map(|s| &s.pieces).filter(|p| p.kind.name() == "pos");
        let (mut sum, mut n) = (0.0, 0.0);
        for k in pos.flat_map(|p| p.range.clone()) {
            sum += (data.value[k] - f64::from(x[k])).powi(2);
            n += 1.0;
        }
        f64::sqrt(sum / n)
    };
    let reported = d.report.gain["pos"].after;
    assert!(
        (square(&from_file[0]) / reported - 1.0).abs() < 1e-9,
        "{} {reported}",
        square(&from_file[0])
    );
    // and what engines read is what was fitted
    let lane = LaneParams::nominal(&extended);
    assert!(
        (lane.kp_nm_per_rad[0] / 0.886 - 0.75).abs() < 0.05 || first.effect == "winding_resistance"
    );
    // twice the same, to the bit
    assert_eq!(diagnose(&request, &mut |_| {}).unwrap().report, d.report);
}

#[test]
fn gains_of_position_and_of_speed_that_are_off_together_are_named() {
    // alone the nearest is a weaker motor: less stiffness and less damping
    let mut request = request(0, &|p| {
        p.kp_nm_per_rad[0] *= 0.75;
        p.kd_nms_per_rad[0] = 0.02;
    });
    let text = String::from_utf8(request.robot_toml).unwrap();
    let text = text.replacen("kd_nm_s_per_rad = 0.0 ", "kd_nm_s_per_rad = 0.05 ", 1);
    request.robot_toml = text.into_bytes();
    let d = diagnose(&request, &mut |_| {}).unwrap();
    let is =
        |c: &Cause, id: &str| c.effect == id || c.as_good(&str::to_owned).contains(&id.to_owned());
    for id in ["kp_error", "kd_error"] {
        assert!(d.report.causes.iter().any(|c| is(c, id)), "{id}: {:?}", names(&d));
    }
}

/// Kd of these rigs, where they have one, N·m·s/rad.
const KD: f32 = 0.05;

/// A request of runs that note Kd.
fn damped(change: &dyn Fn(&mut LaneParams)) -> Request {
    let mut request = request(0, &|p| {
        p.kd_nms_per_rad[0] = KD;
        change(p);
    });
    for run in &mut request.runs {
        // a torque here is the mean of its row, with all kicks in it
        let torque = |s: &Signal| matches!(s, Signal::Torque(_));
        run.log = common::changed(&run.log, |s, _, _, v| v.filter(|_| !torque(s)));
        run.log.meta.kd = Some(f64::from(KD));
    }
    request
}

#[test]
fn damping_on_the_rate_of_the_error_is_named_and_none_where_the_robot_file_has_it() {
    let mut request = damped(&|p| p.joints[0].kd_on_command = 1.0);
    let found = diagnose(&request, &mut |_| {}).unwrap();
    let cause = &found.report.causes[0];
    assert_eq!(cause.effect, "damping_on_error", "{}", found.report.summary);
    assert!((cause.parameters["share"].value - 1.0).abs() < 0.1, "{:?}", cause.parameters);
    let text = String::from_utf8(request.robot_toml).unwrap();
    let said = "kd_acts_on_error = true\nqd_tau_max_radps = ";
    request.robot_toml = text.replacen("qd_tau_max_radps = ", said, 1).into_bytes();
    let told = diagnose(&request, &mut |_| {}).unwrap();
    assert_eq!(told.report.verdict, Verdict::NoGap, "{}", told.report.summary);
}

/// Whether a diagnosis had `effect` among its candidates.
fn tried(d: &Diagnosis, effect: &str) -> bool {
    d.report.detection_floor.keys().any(|key| key.split('@').next() == Some(effect))
}

#[test]
fn damping_by_an_old_speed_is_named_where_the_loop_damps() {
    const LAG_S: f64 = 0.02;
    let mut request = damped(&|p| p.joints[0].damping_lag_s = LAG_S as f32);
    let cause = |request: &Request| {
        let found = diagnose(request, &mut |_| {}).unwrap();
        let cause = found.report.causes.into_iter().next().unwrap();
        assert_eq!(cause.effect, "damping_lag", "{}", found.report.summary);
        assert!((cause.parameters["time_s"].value - LAG_S).abs() < 0.003, "{:?}", cause.parameters);
        cause
    };
    assert!(cause(&request).parameters["reported"].value < 0.3);
    // a servo that reports the speed that it damps
    for run in &mut request.runs {
        let signals = run.log.table.signals().to_vec();
        let k = signals.iter().position(|s| matches!(s, Signal::Velocity(_))).unwrap();
        let speeds = (0..run.log.table.time_s().len()).map(|i| run.log.table.row(i).unwrap()[k]);
        let share = 1.0 / (1.0 + LAG_S * ROWS_HZ);
        let filtered: Vec<f64> = speeds
            .scan(0.0, |seen, v| {
                *seen += share * (v.unwrap() - *seen);
                Some(*seen)
            })
            .collect();
        run.log = common::changed(&run.log, |s, i, _, v| match s {
            Signal::Velocity(_) => Some(filtered[i]),
            _ => v,
        });
    }
    assert!(cause(&request).parameters["reported"].value > 0.7);
    let (_, undamped) = run(0, &|_| {});
    assert!(tried(&undamped, "servo_loop_delay") && !tried(&undamped, "damping_lag"));
}

#[test]
fn a_torque_that_is_logged_and_not_applied_is_named() {
    let mut request = request(0, &|_| {});
    for run in &mut request.runs {
        let mut signals = run.log.table.signals().to_vec();
        signals.push(Signal::CommandTorque("swing".into()));
        run.log = common::rebuilt(&run.log, &signals, |k, t| {
            let mut row = run.log.table.row(k).unwrap().to_vec();
            row.push(Some(0.1 * (0.9 * t).sin()));
            (t, row)
        });
    }
    let found = diagnose(&request, &mut |_| {}).unwrap();
    let cause = &found.report.causes[0];
    assert_eq!(cause.effect, "fed_torque", "{}", found.report.summary);
    assert!(cause.parameters["share"].value.abs() < 0.05, "{:?}", cause.parameters);
    // what no run has cannot be other than noted
    assert!(tried(&found, "fed_torque") && !tried(&found, "fed_speed"));
}

#[test]
fn a_late_command_is_named() {
    let (_, d) = run(2, &|_| {});
    let first = &d.report.causes[0];
    let late = ["command_delay", "measurement_delay"];
    assert!(late.contains(&first.effect.as_str()), "{:?}", names(&d));
    let p = &first.parameters["delay_s"];
    assert!((p.value - 0.02).abs() < 0.003, "{p:?}");
}

#[test]
fn what_would_have_to_be_larger_than_plausible_is_no_explanation() {
    // 120 ms late, and no delay beyond 100 ms is plausible; what else is tried can only make up for a part of
    // the rest
    let mut request = request(12, &|_| {});
    request.options.only = vec!["command_delay".to_owned(), "viscous_friction".to_owned()];
    let d = diagnose(&request, &mut |_| {}).unwrap();
    let delay = d.report.causes.iter().find(|c| c.effect == "command_delay");
    let delay = delay.expect("a delay is tried");
    assert!(delay.parameters["delay_s"].at_bound, "{delay:?}");
    assert_eq!(d.report.verdict, Verdict::PartlyExplained);
    assert!(
        (d.report.summary).contains("What command_delay would have to be lies at the end"),
        "{}",
        d.report.summary
    );
    for cause in &d.report.causes {
        assert!(cause.confidence <= 0.4, "{cause:?}");
    }
}

#[test]
fn friction_is_named() {
    let (_, d) = run(0, &|p| p.joint_friction_nm[0] += 0.05);
    assert_eq!(names(&d).first(), Some(&"coulomb_friction"), "{}", d.report.summary);
    let p = &d.report.causes[0].parameters["extra_nm"];
    assert!((p.value - 0.05).abs() < 0.008, "{p:?}");
}

#[test]
fn a_ripple_is_found_wherever_it_begins() {
    for quarter in 0..4 {
        let begins_rad = std::f32::consts::FRAC_PI_2 * quarter as f32;
        let mut request = request(0, &|p| {
            p.joints[0].ripple_nm = 0.03;
            p.joints[0].ripple_per_turn = 12.0;
            p.joints[0].ripple_phase_rad = begins_rad;
        });
        request.options.only = vec!["cogging".to_owned()];
        let diagnosis = diagnose(&request, &mut |_| {}).unwrap();
        assert_eq!(names(&diagnosis), ["cogging"], "{quarter} quarters");
        let of = |name: &str| diagnosis.report.causes[0].parameters[name].value;
        // A·sin(n·q + φ) = A·cos φ·sin(n·q) + A·sin φ·cos(n·q)
        let (sin, cos) = begins_rad.sin_cos();
        for (found, truth) in [("sin_nm", 0.03 * cos), ("cos_nm", 0.03 * sin)] {
            let off = of(found) - f64::from(truth);
            assert!(off.abs() < 0.006, "{quarter} quarters: {found} {}", of(found));
        }
    }
}

#[test]
fn where_a_stand_is_says_nothing_about_the_robot() {
    let (mut request, without) = run(0, &|_| {});
    for run in &mut request.runs {
        let mut signals = run.log.table.signals().to_vec();
        signals.extend(Axis::ALL.map(Signal::BasePosition));
        signals.extend(QuatPart::ALL.map(Signal::BaseQuaternion));
        let table = run.log.table.clone();
        run.log = common::rebuilt(&run.log, &signals, |k, t| {
            let mut row = table.row(k).unwrap();
            // in another corner of the hall, turned, half a metre above its floor
            row.extend([1.0, -2.0, 0.5, 0.8, 0.0, 0.0, 0.6].map(Some));
            (t, row)
        });
    }
    let diagnosis = diagnose(&request, &mut |_| {}).unwrap();
    assert_eq!(diagnosis.report.summary, without.report.summary);
    assert_eq!(diagnosis.report.model, without.report.model);
    assert_eq!(diagnosis.report.gain, without.report.gain);
}

/// What is left of a held-out angle, mean absolute error, rad.
fn extended_rad(d: &Diagnosis) -> f64 {
    d.report.position_errors.last().unwrap().mean_rad
}

#[test]
fn a_speed_and_a_torque_that_wander_spoil_nothing() {
    let mut clean = request(0, &|p| p.joint_friction_nm[0] += 0.05);
    clean.options.only = ["coulomb_friction", "kp_error", "velocity_lag", "torque_constant"]
        .map(str::to_owned)
        .to_vec();
    // without repeats, which would show it
    clean.runs.retain(|run| run.name.ends_with("_0"));
    let mut without = clean.clone();
    for run in &mut without.runs {
        let signals: Vec<Signal> = (run.log.table.signals().iter())
            .filter(|s| !matches!(s, Signal::Velocity(_) | Signal::Torque(_)))
            .cloned()
            .collect();
        let table = run.log.table.clone();
        run.log = common::rebuilt(&run.log, &signals, |k, t| {
            let kept = table.signals().iter().zip(table.row(k).unwrap());
            let kept = kept.filter(|(s, _)| signals.contains(s));
            (t, kept.map(|(_, v)| v).collect())
        });
    }
    let mut bad = clean;
    for (number, run) in bad.runs.iter_mut().enumerate() {
        // 0.5 rad/s and 0.1 N·m over 60 ms: next to nothing from row to row
        let mut noise = Stream::new(Key::for_run(number as u64), Purpose::Sensor);
        let keep = (-0.01_f64 / 0.06).exp();
        let mut wander = |x: f64| keep * x + (1.0 - keep * keep).sqrt() * noise.normal_f64();
        let (mut v, mut torque) = (vec![0.0], vec![0.0]);
        for k in 0..run.log.table.len() {
            v.push(wander(v[k]));
            torque.push(wander(torque[k]));
        }
        run.log = common::changed(&run.log, |s, k, _, value| match s {
            Signal::Velocity(_) => value.map(|x| x + 0.5 * v[k + 1]),
            Signal::Torque(_) => value.map(|x| x + 0.1 * torque[k + 1]),
            _ => value,
        });
    }
    let [bad, without] = [bad, without].map(|r| diagnose(&r, &mut |_| {}).unwrap());
    assert_eq!(names(&bad), ["coulomb_friction"], "{}", bad.report.summary);
    assert_eq!(bad.report.verdict, Verdict::Explained, "{}", bad.report.summary);
    let (bad, without) = (extended_rad(&bad), extended_rad(&without));
    assert!(bad <= 1.05 * without, "{bad} rad with them, {without} rad without");
}

#[test]
fn a_diagnosis_that_is_asked_to_stop_tells_what_it_has() {
    let mut request = request(0, &|p| p.joint_friction_nm[0] += 0.05);
    request.options.only = ["coulomb_friction", "kp_error"].map(str::to_owned).to_vec();
    // what it answers once it was asked so often, and how often that was in all
    let mut asked_until = |last: usize| {
        let asked = Arc::new(AtomicUsize::new(0));
        let counter = Arc::clone(&asked);
        let go_on = move || counter.fetch_add(1, Ordering::Relaxed) < last;
        request.options.go_on = GoOn::as_long_as(go_on);
        let ended = diagnose(&request, &mut |_| {}).map(|d| d.report);
        (ended, asked.load(Ordering::Relaxed))
    };
    let (whole, asked) = asked_until(usize::MAX);
    let whole = whole.unwrap();
    assert!(!whole.unfinished && !whole.summary.contains("Unfinished"));
    // before there is anything to tell there is nothing to tell
    for last in [0, 1] {
        let (ended, _) = asked_until(last);
        assert!(matches!(ended, Err(GapError::Stopped)), "{last}: {ended:?}");
    }
    // while it fits, searches and names, the best so far is told, and that it is not all
    for last in [asked / 2, 3 * asked / 4, asked - 1] {
        let (ended, _) = asked_until(last);
        let report = ended.unwrap();
        assert!(report.unfinished, "{last}");
        assert!(report.summary.starts_with("Unfinished"), "{}", report.summary);
    }
    // once the search has found it, a stop while it is named does not lose it: it is in the model
    let (late, _) = asked_until(asked - 1);
    assert!(late.unwrap().model.iter().any(|c| c.effect == "coulomb_friction"));
}

/// `log` with its angle `by_rad` more from `from_s` to `to_s`.
fn shifted(log: &RunLog, (from_s, to_s): (f64, f64), by_rad: f64) -> RunLog {
    let signals = log.table.signals().to_vec();
    common::rebuilt(log, &signals, |k, t| {
        let row = log.table.row(k).unwrap();
        let shifted = row.iter().zip(&signals).map(|(value, signal)| {
            let more = matches!(signal, Signal::Position(_)) && (from_s..to_s).contains(&t);
            value.map(|x| x + if more { by_rad } else { 0.0 })
        });
        (t, shifted.collect())
    })
}

#[test]
fn held_out_runs_have_no_part_in_what_is_found() {
    let mut request = request(0, &|p| p.joint_friction_nm[0] += 0.05);
    request.options.only =
        ["coulomb_friction", "viscous_friction", "kp_error"].map(str::to_owned).to_vec();
    let model = |request: &Request| diagnose(request, &mut |_| {}).unwrap().report.model;
    let found = model(&request);
    assert!(!found.is_empty());
    // whatever they say, even nonsense
    for run in request.runs.iter_mut().filter(|r| r.role == Role::Holdout) {
        run.log = shifted(&run.log, (0.0, 9.0), 0.2);
    }
    assert_eq!(found, model(&request));
}

#[test]
fn what_is_off_in_one_run_for_two_seconds_is_a_gap() {
    let mut request = request(0, &|_| {});
    // both repeats of one trial, so that it is no touch: 20 mrad over a quarter of a run
    for run in request.runs.iter_mut().filter(|r| r.name.starts_with("1_")) {
        run.log = shifted(&run.log, (3.0, 5.0), 0.02);
    }
    let report = diagnose(&request, &mut |_| {}).unwrap().report;
    assert_ne!(report.verdict, Verdict::NoGap, "{}", report.summary);
    let local = &report.local_gaps[0];
    assert!(local.run.starts_with("1_") && local.joint == "swing");
    assert!(local.from_s < 5.0 && local.to_s > 3.0, "{local:?}");
}

#[test]
fn the_best_so_far_is_told_when_time_is_up() {
    let mut request = request(0, &|p| p.joint_friction_nm[0] += 0.05);
    request.options.budget_s = Some(0.0);
    let report = diagnose(&request, &mut |_| {}).unwrap().report;
    assert!(report.unfinished && report.summary.starts_with("Unfinished"));
}

#[test]
fn standard_models_are_fitted_to_the_same_runs_and_reported() {
    // friction that they have, and friction that grows with the load, which one of them has
    let (_, d) = run(0, &|p| {
        p.joint_friction_nm[0] += 0.03;
        p.joints[0].load_friction_driving += 0.15;
        p.joints[0].load_friction_driven += 0.15;
    });
    let errors = &d.report.position_errors;
    let names: Vec<&str> = errors.iter().map(|e| e.model.as_str()).collect();
    assert_eq!((names[0], names[5], names.len()), ("as given", "extended", 6));
    let of = |k: usize| errors[k].mean_rad;
    // Coulomb friction helps, and load friction helps more
    assert!(of(2) < 0.7 * of(0) && of(4) < of(2), "{errors:?}");
    let best = (1..5).map(of).fold(f64::INFINITY, f64::min);
    assert!(of(5) < 1.05 * best, "{errors:?}");
    let joint = &errors[5].joints_rad["swing"];
    assert!((joint - errors[5].mean_rad).abs() < 1e-12);
}

#[test]
fn bad_runs_are_refused_in_one_line() {
    let mut none = request(0, &|_| {});
    none.runs.clear();
    assert!(matches!(diagnose(&none, &mut |_| {}), Err(GapError::NoRuns)));
    let mut short = request(0, &|_| {});
    short.runs[0].log.table =
        Table::parse("log.csv", "t,cmd.swing,pos.swing\n0,0,0\n0.5,0,0\n".as_bytes()).unwrap();
    let message = diagnose(&short, &mut |_| {}).unwrap_err().to_string();
    assert!(message.contains("lasts 0.50 s") && !message.contains('\n'), "{message}");
    let mut foreign = request(0, &|_| {});
    foreign.runs[0].log.table =
        Table::parse("log.csv", "t,cmd.wing,pos.wing\n0,0,0\n5,0,0\n".as_bytes()).unwrap();
    let message = diagnose(&foreign, &mut |_| {}).unwrap_err().to_string();
    assert!(message.contains("no actuated joint `wing`"), "{message}");
}

#[test]
fn an_effect_that_there_is_none_of_is_refused() {
    let mut asked = request(0, &|_| ());
    asked.options.without = vec!["nonsense".to_owned()];
    let refused = diagnose(&asked, &mut |_| ());
    assert!(matches!(refused, Err(GapError::UnknownEffect(id)) if id == "nonsense"));
}
