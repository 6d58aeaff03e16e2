//! Replays: what a candidate predicts of a run.

use std::fmt::Write;
use std::sync::Arc;

use caudata_gap::effects::{self, Place};
use caudata_gap::replay::{Data, Replayer, SegmentOptions, Term};
use caudata_gap::trial::{Kind, Trial};
use caudata_gap::{Role, Run};
use caudata_model::RobotModel;
use caudata_runlog::{BaseHold, LogMeta, RunLog, Table};
use caudata_sim::LaneParams;

/// Rows per second.
const ROWS_HZ: f64 = 100.0;

/// A run of `rows` rows in which every command is `command_rad`, every joint at `pos_rad`, and each of
/// `others` reads nothing.
fn run(
    model: &RobotModel,
    base: BaseHold,
    rows: usize,
    command_rad: &[f64],
    pos_rad: &[f64],
    others: &[&str],
) -> Trial {
    let mut text = String::from("t");
    for kind in ["cmd", "pos"] {
        for name in model.actuated_names() {
            write!(text, ",{kind}.{name}").unwrap();
        }
    }
    for other in others {
        write!(text, ",{other}").unwrap();
    }
    for k in 0..rows {
        write!(text, "\n{}", k as f64 / ROWS_HZ).unwrap();
        for x in command_rad.iter().chain(pos_rad) {
            write!(text, ",{x}").unwrap();
        }
        for _ in others {
            text.push_str(",0");
        }
    }
    text.push('\n');
    let run = Run {
        name: "run".to_owned(),
        log: RunLog::new(
            LogMeta::new(model.name(), base, ROWS_HZ),
            Table::parse("log.csv", text.as_bytes()).unwrap(),
        ),
        role: Role::Fit,
        sha256: String::new(),
    };
    caudata_gap::reading::trial(model, &run).unwrap()
}

#[test]
fn runs_with_other_channels_share_an_engine_and_change_nothing() {
    let model = Arc::new(crate::common::robot("polymander"));
    let nominal: Vec<f64> = model.nominal_pos_rad().to_vec();
    let gyro = ["imu.gyro.x", "imu.gyro.y", "imu.gyro.z"];
    let with = run(&model, BaseHold::Free, 150, &nominal, &nominal, &gyro);
    let without = run(&model, BaseHold::Free, 150, &nominal, &nominal, &[]);
    let predicted = |trials: Vec<Trial>| -> Vec<u32> {
        let data = Data::new(&model, trials, SegmentOptions::default());
        let replayer = Replayer::new(Arc::clone(&model), 1).unwrap();
        let of = replayer.predict(&data, &[Vec::new()]).unwrap().remove(0);
        assert!(of.iter().all(|x| x.is_finite()));
        of.iter().map(|x| x.to_bits()).collect()
    };
    let alone = [predicted(vec![without.clone()]), predicted(vec![with.clone()])];
    assert!(alone[1].len() > alone[0].len() && !alone[0].is_empty());
    assert_eq!(predicted(vec![without, with]), alone.concat());
}

/// A joint of gain kp that holds a load at an error of e settles, with an integral part of kᵢ, as
/// e·exp(−kᵢ/kp·t): the integral part takes the load over.
#[test]
fn a_held_robot_with_an_integral_part_stands_for_a_second_before_its_recording() {
    let model = Arc::new(crate::common::robot("xl330_pendulum"));
    let kp = f64::from(LaneParams::nominal(&model).kp_nm_per_rad[0]);
    let replayer = Replayer::new(Arc::clone(&model), 1).unwrap();
    // where the lever is about level its load hardly changes with the angle
    let command_rad = 1.45;
    let effect = effects::find("integral_action").unwrap();
    let share_per_s = 0.1;
    let integral = vec![Term {
        effect,
        place: Place::named(&model, effect.domain, &["swing".to_owned()]).unwrap(),
        values: vec![share_per_s * kp],
    }];
    // where it is after `t_s`, beginning from `pos_rad`
    let after = |t_s: f64, pos_rad: f64, terms: &[Term]| -> f64 {
        let rows = (t_s * ROWS_HZ) as usize + 1;
        let trial = run(&model, BaseHold::Fixed, rows, &[command_rad], &[pos_rad], &[]);
        let data = Data::new(&model, vec![trial], SegmentOptions::default());
        let last = (data.segments.iter().flat_map(|s| &s.pieces))
            .filter(|p| p.kind == Kind::Position)
            .map(|p| p.range.end - 1)
            .max()
            .unwrap();
        f64::from(replayer.predict(&data, &[terms.to_vec()]).unwrap()[0][last])
    };
    let droops_to = after(6.0, command_rad, &[]);
    let error_rad = command_rad - droops_to;
    assert!(error_rad > 0.01, "{error_rad}");
    // without an integral part it stays there
    assert!((after(2.0, droops_to, &[]) - droops_to).abs() < 0.02 * error_rad);
    // with one it has stood for a second when the recording begins, which lasts two
    let left = (command_rad - after(2.0, droops_to, &integral)) / error_rad;
    let expected = (-share_per_s * 3.0_f64).exp();
    assert!((left - expected).abs() < 0.02, "{left} of {expected}");
}

/// Where a pendulum rests after 4 s of a log with `columns` beside command and position (both 0), under `meta`; by
/// all of its channels, rad.
fn rests_at(columns: &[(&str, f64)], meta: &str, terms: &[Term]) -> Vec<f64> {
    let model = Arc::new(crate::common::robot("xl330_pendulum"));
    let mut text = String::from("t,cmd.swing,pos.swing");
    for (name, _) in columns {
        write!(text, ",{name}").unwrap();
    }
    for k in 0..400 {
        write!(text, "\n{},0,0", k as f64 / ROWS_HZ).unwrap();
        for (_, value) in columns {
            write!(text, ",{value}").unwrap();
        }
    }
    text.push('\n');
    let head = "robot = \"xl330_pendulum\"\nbase = \"fixed\"\nrate_hz = 100\n";
    let log = RunLog::new(
        LogMeta::parse("log.toml", &format!("{head}{meta}")).unwrap(),
        Table::parse("log.csv", text.as_bytes()).unwrap(),
    );
    let run = Run { name: "run".to_owned(), log, role: Role::Fit, sha256: String::new() };
    let trial = caudata_gap::reading::trial(&model, &run).unwrap();
    let data = Data::new(&model, vec![trial], SegmentOptions::default());
    let replayer = Replayer::new(Arc::clone(&model), 1).unwrap();
    let predicted = replayer.predict(&data, &[terms.to_vec()]).unwrap().remove(0);
    data.pieces().map(|p| f64::from(predicted[p.range.end - 1])).collect()
}

/// 0.2 N·m turn it to where 0.886·q + 0.49·9.81·0.1·sin q = 0.2: q = 0.14652.
#[test]
fn what_is_commanded_beside_positions_and_pushes_from_outside_is_replayed() {
    const RESTS_RAD: f64 = 0.146_52;
    let turned = |columns: &[(&str, f64)], meta: &str| {
        let q = rests_at(columns, meta, &[])[0];
        assert!((q - RESTS_RAD).abs() < 2e-4, "{columns:?}: {q}");
    };
    turned(&[("cmd_tau.swing", 0.2)], "");
    turned(&[("cmd_vel.swing", 4.0)], "kd = 0.05\n");
    // at the centre of mass, 0.1 m below the axis: 0.1·F·cos q and, upwards, 0.1·F·sin q less weight
    let along = |q: f64| -0.2 / (0.1 * q.cos());
    turned(&[("force.arm.x", along(RESTS_RAD))], "");
    // half as far
    let near = "[[outer_force]]\nlink = \"arm\"\nat_m = [0, 0, -0.05]\n";
    turned(&[("force.arm.x", 2.0 * along(RESTS_RAD))], near);
    assert!(rests_at(&[], "", &[])[0].abs() < 1e-6);
}

/// A torque of 0.4 N·m, half of which is applied, and such a force turn it as 0.2 N·m do.
#[test]
fn of_what_is_fed_a_share_may_act() {
    let model = crate::common::robot("xl330_pendulum");
    let half = |id: &str, joints: &[String]| {
        let effect = effects::find(id).unwrap();
        let place = Place::named(&model, effect.domain, joints).unwrap();
        [Term { effect, place, values: vec![0.5] }]
    };
    let swing = ["swing".to_owned()];
    let turned =
        |column: (&str, f64), meta: &str, term: &[Term]| rests_at(&[column], meta, term)[0];
    for (noted, applied, meta, id, joints) in [
        (("cmd_tau.swing", 0.4), ("cmd_tau.swing", 0.2), "", "fed_torque", &swing[..]),
        (("cmd_vel.swing", 4.0), ("cmd_vel.swing", 2.0), "kd = 0.05\n", "fed_speed", &swing),
        (("force.arm.x", -3.0), ("force.arm.x", -1.5), "", "outer_force", &[]),
    ] {
        let (noted, applied) = (turned(noted, meta, &half(id, joints)), turned(applied, meta, &[]));
        assert_eq!(noted, applied, "{id}");
        assert!(noted.abs() > 0.05, "{id}: {noted}");
    }
}

/// A drive that takes 0.5 N·m for what is 0.4 gives less of what it is fed as well.
#[test]
fn a_torque_that_is_fed_forward_goes_through_the_drive() {
    let model = crate::common::robot("xl330_pendulum");
    let effect = effects::find("torque_constant").unwrap();
    let place = Place::named(&model, effect.domain, &["swing".to_owned()]).unwrap();
    let weak = [Term { effect, place, values: vec![0.8] }];
    // 0.8·0.886·q + 0.48069·sin q = 0.8·0.2
    let q = rests_at(&[("cmd_tau.swing", 0.2)], "", &weak)[0];
    assert!((q - 0.134_67).abs() < 2e-4, "{q}");
}

/// Between encoders on either side of a gear that gives 0.1 rad per N·m lie 0.1 times what the weight asks for.
#[test]
fn a_second_encoder_is_on_the_other_side_of_the_gear() {
    let model = crate::common::robot("xl330_pendulum");
    let effect = effects::find("gear_compliance").unwrap();
    let place = Place::named(&model, effect.domain, &["swing".to_owned()]).unwrap();
    let soft = [Term { effect, place, values: vec![0.1, 0.3] }];
    let rests = rests_at(&[("cmd_tau.swing", 0.2), ("pos2.swing", 0.0)], "", &soft);
    let carried_nm = 0.49 * 9.81 * 0.1 * rests[0].sin();
    assert!(carried_nm > 0.05, "{rests:?}");
    assert!((rests[1] - rests[0] - 0.1 * carried_nm).abs() < 2e-4, "{rests:?}");
    let rigid = rests_at(&[("cmd_tau.swing", 0.2), ("pos2.swing", 0.0)], "", &[]);
    assert_eq!(rigid[0], rigid[1]);
}

/// A push on a leg of a robot that is held turns its joints by what it does along their way (virtual work), and no
/// others.
#[test]
fn a_push_on_a_link_turns_the_joints_that_carry_it() {
    const FORCE_N: [f64; 3] = [0.6, -0.8, 1.0];
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    let text = |end: &str| std::fs::read_to_string(folder.join(end)).unwrap();
    let toml =
        text("quadruped.robot.toml").replace("friction_loss_nm = 0.2 ", "friction_loss_nm = 0.0 ");
    let mjcf = text("quadruped.xml").replace("frictionloss=\"0.2\"", "frictionloss=\"0\"");
    let model = RobotModel::from_bytes("dog", toml.as_bytes(), mjcf.as_bytes()).unwrap();
    let model = Arc::new(model);
    let nominal = model.nominal_pos_rad().to_vec();
    let predicted = |pushed: bool| -> Vec<f64> {
        let axes = ["force.FL_calf.x", "force.FL_calf.y", "force.FL_calf.z"];
        let mut trial = run(&model, BaseHold::Fixed, 300, &nominal, &nominal, &axes);
        for (axis, (_, value)) in trial.forces[0].axes.iter_mut().enumerate() {
            value.fill(if pushed { FORCE_N[axis] } else { 0.0 });
        }
        let data = Data::new(&model, vec![trial], SegmentOptions::default());
        let replayer = Replayer::new(Arc::clone(&model), 1).unwrap();
        let all = replayer.predict(&data, &[Vec::new()]).unwrap().remove(0);
        let positions = data.pieces().filter(|p| p.kind == Kind::Position);
        positions.map(|p| f64::from(all[p.range.end - 1])).collect()
    };
    let (still, pushed) = (predicted(false), predicted(true));
    let calf = model.link_index("FL_calf").unwrap();
    let centre_m = |pos: &[f64]| {
        let full = model.full_pos_rad(pos).unwrap();
        let places = model.kinematics(&caudata_model::Pose::IDENTITY, &full).unwrap();
        places.links[calf].point(model.links()[calf].com_m)
    };
    for a in 0..nominal.len() {
        let moved = [1e-4, -1e-4].map(|step| {
            let mut pos = still.clone();
            pos[a] += step;
            centre_m(&pos)
        });
        let along: f64 = (0..3).map(|i| FORCE_N[i] * (moved[0][i] - moved[1][i]) / 2e-4).sum();
        let want_rad = along / model.kp_nm_per_rad(a);
        let got_rad = pushed[a] - still[a];
        let off = (got_rad - want_rad).abs();
        assert!(off < 0.08 * want_rad.abs() + 2e-5, "joint {a}: {got_rad} rad, not {want_rad}");
    }
    assert!((0..3).any(|a| (pushed[a] - still[a]).abs() > 2e-3), "{pushed:?} {still:?}");
}
