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
