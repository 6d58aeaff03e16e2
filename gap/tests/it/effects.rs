//! Every effect of the catalogue: nothing at nothing, to the bit; and a change of a signal at some size.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_gap::effects::{self, Effect, Place};
use caudata_gap::excitation::Excitation;
use caudata_gap::replay::{Data, Replayer, SegmentOptions, Term};
use caudata_gap::trial::{Role, Run};
use caudata_model::RobotModel;
use caudata_runlog::{RunLog, Table};

fn robot(name: &str) -> Arc<RobotModel> {
    let path: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots").join(name);
    Arc::new(RobotModel::load(&path).unwrap())
}

/// A bench rig whose servo rubs a little.
fn bench() -> Arc<RobotModel> {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    let text = std::fs::read_to_string(dir.join("xl330_pendulum.robot.toml")).unwrap();
    let mjcf = std::fs::read(dir.join("xl330_pendulum.xml")).unwrap();
    let text = text.replacen("friction_loss_nm = 0.0 ", "friction_loss_nm = 0.03 ", 1);
    let text = text.replacen("kd_nm_s_per_rad = 0.0 ", "kd_nm_s_per_rad = 0.02 ", 1);
    // a servo that nobody knows: its encoder may be on either side
    let text = text.replace("xl330_m288", "own");
    Arc::new(RobotModel::from_bytes("bench", text.as_bytes(), &mjcf).unwrap())
}

/// The same servo on a rail.
fn rail() -> Arc<RobotModel> {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    let toml = std::fs::read(dir.join("xl330_pendulum.robot.toml")).unwrap();
    let mjcf = std::fs::read_to_string(dir.join("xl330_pendulum.xml")).unwrap();
    let mjcf = mjcf.replacen("name=\"swing\"", "name=\"swing\" type=\"slide\"", 1);
    Arc::new(RobotModel::from_bytes("rail", &toml, mjcf.as_bytes()).unwrap())
}

/// What is an angle on a hinge is a tenth of that in metres on a slide, friction springs over 0.1 mm where a
/// hinge's does over 2 mrad, and a stop that is not there is farther than any rail.
#[test]
fn sizes_at_a_slide_are_lengths() {
    let (hinge, slide) = (bench(), rail());
    let at = |model: &RobotModel, id: &str| {
        let effect = effects::find(id).unwrap();
        let place = effect.places(model).swap_remove(0);
        (effect.neutral(model, &place), effect.sizes(model, &place, 0))
    };
    let near = |got: &[f64], want: &[f64]| {
        let off = got.iter().zip(want).any(|(g, w)| (g - w).abs() > 1e-12);
        assert!(got.len() == want.len() && !off, "{got:?}, not {want:?}");
    };
    near(&at(&hinge, "gear_backlash").1, &[0.003]);
    near(&at(&slide, "gear_backlash").1, &[0.0003]);
    near(&at(&hinge, "pre_sliding").0, &[0.002]);
    near(&at(&slide, "pre_sliding").0, &[0.0001]);
    near(&at(&hinge, "hard_stop").0, &[-4.0, 4.0]);
    near(&at(&slide, "hard_stop").0, &[-4.0, 4.0]);
}

/// What was weighed to ± 2 g of 490 g is no heavier link, and its weight, ± 50 g, is off by no more than 100 g.
#[test]
fn what_was_measured_bounds_what_it_may_be() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    let text = std::fs::read_to_string(dir.join("xl330_pendulum.robot.toml")).unwrap();
    let mjcf = std::fs::read(dir.join("xl330_pendulum.xml")).unwrap();
    let weighed = |marks: &str| {
        let text = format!("{text}\n[measured.arm]\n{marks}\n");
        RobotModel::from_bytes("bench", text.as_bytes(), &mjcf)
    };
    let places = |model: &RobotModel, id: &str| effects::find(id).unwrap().places(model).len();
    let exactly = weighed("mass_kg = 0.002").unwrap();
    for id in ["link_mass", "point_mass"] {
        assert_eq!(places(&exactly, id), 0, "{id}");
    }
    assert_eq!(places(&exactly, "link_com"), 1);
    let roughly = weighed("mass_kg = 0.05\ncom_m = 0.0002").unwrap();
    assert_eq!(places(&roughly, "link_com"), 0);
    let bounds = |id: &str, index: usize| {
        let effect = effects::find(id).unwrap();
        let place = effect.places(&roughly).swap_remove(0);
        effect.bounds(&roughly, &place, index)
    };
    let near = |got: (f64, f64), want: (f64, f64)| {
        assert!((got.0 - want.0).abs() + (got.1 - want.1).abs() < 1e-9, "{got:?}");
    };
    near(bounds("link_mass", 0), (1.0 - 0.1 / 0.49, 1.0 + 0.1 / 0.49));
    near(bounds("point_mass", 0), (-0.1, 0.1));
    // where on the link a weight may be nobody said
    assert!(bounds("point_mass", 1).1 > 0.1);
    let unknown = weighed("mass_g = 1").unwrap_err().to_string();
    assert!(unknown.contains("unknown field `mass_g`"), "{unknown}");
    let stranger = text.clone() + "\n[measured.leg]\nmass_kg = 0.001\n";
    let error = RobotModel::from_bytes("bench", stranger.as_bytes(), &mjcf).unwrap_err();
    assert!(error.to_string().contains("there is no body `leg`"), "{error}");
}

/// A run of `joints`, in which every joint steps and swings, and what is `fed` with them; measured values are zeros,
/// since only predictions are compared.
fn run(model: &RobotModel, base: &str, body: bool, seconds: f64, fed: &[&str]) -> Run {
    let joints = model.actuated_names();
    let mut text = String::from("t");
    for j in &joints {
        text += &format!(",cmd.{j},pos.{j},vel.{j},cur.{j}");
    }
    text += ",volt";
    for signal in fed {
        text += &format!(",{signal}");
    }
    if body {
        text += ",imu.gyro.x,imu.gyro.y,imu.gyro.z,imu.acc.x,imu.acc.y,imu.acc.z,base.pos.x,base.pos.y,base.pos.z";
        text += ",base.quat.w,base.quat.x,base.quat.y,base.quat.z";
        text += ",foot.FL.x,foot.FL.y,foot.FL.z";
    }
    text.push('\n');
    let rows = (seconds * 100.0) as usize;
    for k in 0..=rows {
        let t = k as f64 * 0.01;
        text += &format!("{t}");
        for (a, q0) in model.nominal_pos_rad().iter().enumerate() {
            let step = if (t * 0.7).fract() < 0.5 { 0.9 } else { -0.9 };
            let swing = 0.5 * (6.0 * t + a as f64).sin();
            text += &format!(",{},{q0},0,0", q0 + step + swing);
        }
        text += ",12";
        for _ in fed {
            text += &format!(",{}", 0.2 * (4.0 * t).cos());
        }
        if body {
            let z = if base == "water" { 1.98 } else { 0.16 };
            text += &format!(",0,0,0,0,0,9.81,0,0,{z},1,0,0,0,0,0,0");
        }
        text.push('\n');
    }
    let meta = format!("robot = \"{}\"\nbase = \"{base}\"\nrate_hz = 100\n", model.name());
    Run {
        name: base.to_owned(),
        log: RunLog::new(
            caudata_runlog::LogMeta::parse("log.toml", &meta).unwrap(),
            Table::parse("log.csv", text.as_bytes()).unwrap(),
        ),
        role: Role::Fit,
        sha256: String::new(),
    }
}

fn data(model: &RobotModel, base: &str, body: bool, seconds: f64) -> Data {
    of_run(model, &run(model, base, body, seconds, &[]))
}

fn of_run(model: &RobotModel, run: &Run) -> Data {
    let mut trial = caudata_gap::reading::trial(model, run).unwrap();
    trial.session = 1.0;
    Data::new(model, vec![trial], SegmentOptions::default())
}

fn term(model: &RobotModel, effect: &'static Effect, place: &Place, values: Vec<f64>) -> Vec<Term> {
    let _ = model;
    vec![Term { effect, place: place.clone(), values }]
}

/// Checks one effect on data in which it can show: neutral values give the same bits, at least one grid size
/// changes a signal.
fn check(replayer: &Replayer, data: &Data, effect: &'static Effect) {
    let model = replayer.model();
    let Some(place) = effect.places(model).into_iter().last() else {
        panic!("{}: no place on {}", effect.id, model.name());
    };
    let mut variants = vec![Vec::new()];
    variants.push(term(model, effect, &place, effect.neutral(model, &place)));
    for k in 0..effect.grid.len() {
        variants.push(term(model, effect, &place, effect.sizes(model, &place, k)));
    }
    let predictions = replayer.predict(data, &variants).unwrap();
    // a profile, a torque limit and a soft gear have no neutral value but a far one
    let far = [
        "profile_limit",
        "torque_limit",
        "voltage_limit",
        "gear_compliance",
        "hard_stop",
        "cogging",
    ];
    if !far.contains(&effect.id) {
        assert!(
            predictions[0].iter().zip(&predictions[1]).all(|(a, b)| a.to_bits() == b.to_bits()),
            "{}: at nothing something changes",
            effect.id
        );
    }
    let mut changed = false;
    for (k, with) in predictions[2..].iter().enumerate() {
        assert!(with.iter().all(|x| x.is_finite()), "{} size {k} breaks down", effect.id);
        for piece in data.segments.iter().flat_map(|s| &s.pieces) {
            let mut samples = piece.range.clone();
            changed |= samples.any(|i| (with[i] - predictions[0][i]).abs() > 1e-4);
        }
    }
    assert!(changed, "{}: no size changes anything", effect.id);
}

#[test]
fn effects_of_a_joint_show_on_a_bench_rig() {
    let model = bench();
    let replayer = Replayer::new(Arc::clone(&model), 2).unwrap();
    let data = data(&model, "fixed", false, 6.0);
    for effect in effects::ALL {
        let joint = matches!(
            effect.layer,
            effects::Layer::Actuation
                | effects::Layer::Transmission
                | effects::Layer::Timing
                | effects::Layer::Inertia
        ) || [
            "encoder_offset",
            "encoder_gain",
            "velocity_lag",
            "current_bias",
            "current_lag",
            "parallel_spring",
            "hard_stop",
        ]
        .contains(&effect.id);
        // one joint has no pattern along the bus; a drift needs the end of a session, which this run is
        let elsewhere = ["bus_skew", "payload", "fed_torque", "fed_speed"];
        if joint && !elsewhere.contains(&effect.id) {
            check(&replayer, &data, effect);
        }
    }
}

/// What is commanded beside positions, and what pushes, may be other than noted where a run has it, and only there.
#[test]
fn what_is_fed_may_be_other_than_noted() {
    let model = bench();
    let replayer = Replayer::new(Arc::clone(&model), 2).unwrap();
    let signals = ["cmd_tau.swing", "cmd_vel.swing", "force.arm.x"];
    let fed = of_run(&model, &run(&model, "fixed", false, 3.0, &signals));
    let bare = data(&model, "fixed", false, 3.0);
    let has = |effect: &Effect, data: &Data| {
        let trials: Vec<_> = data.trials.iter().collect();
        (effect.of_runs)(&Excitation::of(&model, &trials))
    };
    for id in ["fed_torque", "fed_speed", "outer_force"] {
        let effect = effects::find(id).unwrap();
        check(&replayer, &fed, effect);
        assert!(has(effect, &fed) && !has(effect, &bare), "{id}");
    }
}

#[test]
fn effects_of_body_and_ground_show_on_the_ground() {
    let model = robot("polymander.robot.toml");
    let replayer = Replayer::new(Arc::clone(&model), 2).unwrap();
    let data = data(&model, "free", true, 3.0);
    for id in [
        "imu_tilt",
        "gyro_bias",
        "imu_delay",
        "mocap_frame",
        "bus_skew",
        "girdle_play",
        "payload",
        "floor_slope",
        "contact_friction",
        "belly_friction",
    ] {
        check(&replayer, &data, effects::find(id).unwrap());
    }
}

#[test]
fn effects_of_water_show_in_water() {
    let model = robot("polymander.robot.toml");
    let replayer = Replayer::new(Arc::clone(&model), 2).unwrap();
    let data = data(&model, "water", true, 3.0);
    for effect in effects::ALL.iter().filter(|e| e.layer == effects::Layer::Water) {
        check(&replayer, &data, effect);
    }
}

#[test]
fn predictions_do_not_depend_on_threads() {
    let model = bench();
    let data = data(&model, "fixed", false, 3.0);
    let effect = effects::find("kp_error").unwrap();
    let place = effect.places(&model).remove(0);
    let variants: Vec<_> =
        (0..40).map(|k| term(&model, effect, &place, vec![0.5 + 0.02 * f64::from(k)])).collect();
    let of = |threads: usize| {
        Replayer::new(Arc::clone(&model), threads).unwrap().predict(&data, &variants).unwrap()
    };
    assert_eq!(of(1), of(2));
}

#[test]
fn the_catalogue_is_whole() {
    assert!(effects::ALL.len() >= 40, "{}", effects::ALL.len());
    for (i, e) in effects::ALL.iter().enumerate() {
        assert!(effects::ALL[..i].iter().all(|o| o.id != e.id), "{} stands twice", e.id);
        assert!(
            !e.grid.is_empty() && e.grid.iter().all(|g| g.len() == e.parameters.len()),
            "{}",
            e.id
        );
        for other in e.look_alikes() {
            assert!(effects::find(other).is_some(), "{}: look-alike {other} does not exist", e.id);
        }
        for (i, p) in e.parameters.iter().enumerate() {
            assert!(p.low < p.high && p.scale > 0.0, "{}.{}", e.id, p.name);
            // screening tries parts and multiples of a size, of what is smooth the other way round too
            let tried = |way: f64| e.grid.iter().any(|g| way * g[i] > 0.0);
            let either_way = p.low == -p.high && p.neutral == 0.0;
            let enough = match e.hinge {
                true => tried(1.0) == tried(-1.0),
                false => tried(1.0) || tried(-1.0),
            };
            assert!(!either_way || enough, "{}.{}", e.id, p.name);
        }
        assert!(!e.id.is_empty() && !e.trial.is_empty() && !e.signature.is_empty());
    }
}
