//! Robots of other sizes than the salamander: they load, step, and give what their contract says.

use std::fmt::Write as _;
use std::sync::Arc;

use caudata_env::VecEnv;
use caudata_model::RobotModel;
use caudata_sim::{EngineConfig, InitialState, TerrainConfig};
use caudata_task::termination::TerminationReason;
use caudata_task::{Mirror, TaskConfig};

const SERVO: &str = "tau_max_nm = 1.94\nqd_tau_max_radps = 0.8\nqd_max_radps = 7.6\ntau_qd_max_nm = 0.4\n\
    tau_brake_max_nm = 2.2\nkd_min_nm_s_per_rad = 0.1\nback_drive_kp_ratio = 1.0\nfriction_loss_nm = 0.03\n\
    damping_nm_s_per_rad = 0.006\narmature_kgm2 = 0.002\nreference_supply_v = 12.0\nencoder_counts_per_turn = 4096\n\
    velocity_lsb_radps = 0.024\ncurrent_lsb_a = 0.0027\ntorque_per_current_nm_per_a = 1.1\ncurrent_dead_band_a = 0.1\n\
    gear_backlash_rad = 0.0\n";

/// A trunk with legs of three joints at the given places, or, without legs, a chain of `spine` joints behind
/// it.
struct Body {
    name: &'static str,
    hips: &'static [(&'static str, f64, f64)],
    spine: usize,
}

const QUADRUPED: Body = Body {
    name: "quadruped",
    hips: &[("FL", 0.15, 0.08), ("FR", 0.15, -0.08), ("HL", -0.15, 0.08), ("HR", -0.15, -0.08)],
    spine: 0,
};
const BIPED: Body = Body { name: "biped", hips: &[("L", 0.0, 0.06), ("R", 0.0, -0.06)], spine: 0 };
const HEXAPOD: Body = Body {
    name: "hexapod",
    hips: &[
        ("FL", 0.15, 0.1),
        ("FR", 0.15, -0.1),
        ("ML", 0.0, 0.1),
        ("MR", 0.0, -0.1),
        ("HL", -0.15, 0.1),
        ("HR", -0.15, -0.1),
    ],
    spine: 0,
};
const SNAKE: Body = Body { name: "snake", hips: &[], spine: 9 };

const INERTIA: &str = "diaginertia=\"2e-4 2e-4 2e-4\"";

impl Body {
    fn model(&self) -> Arc<RobotModel> {
        let (robot, mjcf) = self.files();
        Arc::new(RobotModel::from_bytes(self.name, robot.as_bytes(), mjcf.as_bytes()).unwrap())
    }

    /// Robot file and MJCF.
    fn files(&self) -> (String, String) {
        let mut joints = Vec::new();
        let mut bodies = String::new();
        for (leg, x, y) in self.hips {
            for (part, axis, at) in [
                ("hip", "1 0 0", format!("{x} {y} 0")),
                ("thigh", "0 1 0", "0 0 -0.02".to_owned()),
                ("shank", "0 1 0", "0 0 -0.08".to_owned()),
            ] {
                let joint = format!("{leg}_{part}");
                let _ = write!(
                    bodies,
                    "<body name=\"{joint}_link\" pos=\"{at}\"><inertial pos=\"0 0 -0.03\" mass=\"0.08\" {INERTIA}/>\
                     <joint name=\"{joint}\" axis=\"{axis}\" range=\"-1.2 1.2\"/>"
                );
                joints.push(joint);
            }
            let _ = write!(
                bodies,
                "<geom name=\"{leg}_foot\" type=\"sphere\" size=\"0.015\" pos=\"0 0 -0.08\"/></body></body></body>"
            );
        }
        for i in 0..self.spine {
            let _ = write!(
                bodies,
                "<body name=\"link_{i}\" pos=\"-0.07 0 0\"><inertial pos=\"-0.03 0 0\" mass=\"0.1\" {INERTIA}/>\
                 <joint name=\"spine_{i}\" axis=\"0 0 1\" range=\"-1.2 1.2\"/><geom type=\"sphere\" size=\"0.02\"/>"
            );
            joints.push(format!("spine_{i}"));
        }
        bodies.push_str(&"</body>".repeat(self.spine));
        let actuators: String =
            joints.iter().map(|j| format!("<position name=\"{j}\" joint=\"{j}\"/>")).collect();
        let mjcf = format!(
            "<mujoco><compiler angle=\"radian\"/><worldbody><body name=\"trunk\"><freejoint/>\
             <inertial pos=\"0 0 0\" mass=\"1.0\" diaginertia=\"4e-3 6e-3 8e-3\"/>\
             <geom type=\"box\" size=\"0.1 0.05 0.02\"/>{bodies}</body></worldbody><actuator>{actuators}</actuator></mujoco>"
        );
        let names: Vec<String> = joints.iter().map(|j| format!("\"{j}\"")).collect();
        let pose: String = joints.iter().map(|j| format!("{j} = 0.0\n")).collect();
        let feet: String = (self.hips.iter())
            .map(|(leg, ..)| format!("[[feet]]\nname = \"{leg}\"\ngeom = \"{leg}_foot\"\n"))
            .collect();
        let robot = format!(
            "format = \"caudata.robot.v1\"\nname = \"{}\"\nmjcf = \"robot.xml\"\nbase = \"free\"\n\
             [joints]\nactuated = [{}]\n[pose.nominal_rad]\n{pose}[control]\nkp_nm_per_rad = 15.0\nkd_nm_s_per_rad = 0.15\n\
             [servo]\ndefault = \"one\"\n[servo.preset.one]\n{SERVO}\
             [supply]\ndefault_v = 12.0\nbench_v = 12.0\nbattery_full_v = 12.6\nbattery_nominal_v = 11.1\n\
             [contact]\nfoot_friction = 0.8\nbody_friction = 0.3\n\
             [water]\ndensity_kg_per_m3 = 1000.0\nviscosity_pa_s = 0.001\nbuoyancy_ratio = 1.0\n\
             heave_damping_ns_per_m = 1.0\n{feet}",
            self.name,
            names.join(", "),
        );
        (robot, mjcf)
    }
}

/// Steps two lanes for two seconds on every kind of ground that asks something else of feet.
fn runs(body: &Body, joints: usize, feet: usize) -> VecEnv {
    let model = body.model();
    assert_eq!((model.actuated().len(), model.feet().len()), (joints, feet));
    let task = TaskConfig::default();
    let terrain = TerrainConfig { water_level_m: 0.05, ..TerrainConfig::default() };
    let engine =
        caudata_sim::build(Arc::clone(&model), 2, &EngineConfig::default(), &terrain, 1, 1)
            .unwrap();
    let mut env = VecEnv::new(model, task, engine, 1, 0).unwrap();
    // joint velocities and positions, gyro, gravity, phases, command, three actions
    let dim = 2 * joints + 6 + 2 * feet.max(1) + 3 + 3 * joints;
    assert_eq!((env.obs_dim(), env.act_dim()), (dim, joints));
    assert!(env.contract().validate().is_ok());
    for step in 0..100 {
        let actions: Vec<f32> =
            (0..2 * joints).map(|i| 0.4 * (0.2 * step as f32 + i as f32).sin()).collect();
        let output = env.step(&actions).unwrap();
        assert!(output.rewards.iter().all(|r| r.is_finite()));
        assert!(env.observations().iter().all(|x| x.is_finite()));
    }
    let snapshot = env.snapshot().unwrap();
    env.restore(&snapshot).unwrap();
    env
}

#[test]
fn a_quadruped_of_twelve_joints() {
    let env = runs(&QUADRUPED, 12, 4);
    let mirror = Mirror::new(env.engine().model(), &env.contract().observation).unwrap();
    // left and right legs change places; hips roll the other way
    assert_eq!(mirror.action.source[..6], [3, 4, 5, 0, 1, 2]);
    assert_eq!(mirror.action.sign[..3], [-1.0, 1.0, 1.0]);
}

/// A foot of a heel and a toe: both are the foot's, whose height is that of the lower one.
#[test]
fn a_foot_of_two_shapes() {
    let (mut robot, mut mjcf) = QUADRUPED.files();
    for leg in ["FL", "FR", "HL", "HR"] {
        let foot =
            format!("<geom name=\"{leg}_foot\" type=\"sphere\" size=\"0.015\" pos=\"0 0 -0.08\"/>");
        let two = format!(
            "<geom name=\"{leg}_heel\" type=\"sphere\" size=\"0.01\" pos=\"-0.02 0 -0.085\"/>\
             <geom name=\"{leg}_toe\" type=\"box\" size=\"0.01 0.01 0.005\" pos=\"0.02 0 -0.09\"/>"
        );
        assert!(mjcf.contains(&foot));
        mjcf = mjcf.replace(&foot, &two);
        let (one, both) =
            (format!("geom = \"{leg}_foot\""), format!("geoms = [\"{leg}_heel\", \"{leg}_toe\"]"));
        robot = robot.replace(&one, &both);
    }
    let read = |robot: &str| RobotModel::from_bytes("t", robot.as_bytes(), mjcf.as_bytes());
    let model = Arc::new(read(&robot).unwrap());
    let foot = &model.feet()[0];
    assert_eq!((foot.geoms.len(), foot.balls.len()), (2, 9));
    assert_eq!(foot.centre_m, [0.0, 0.0, -0.0875]);
    assert_eq!(model.foot_of(foot.link, foot.geoms[1]), Some(0));
    let (config, ground) = (EngineConfig::default(), TerrainConfig::default());
    let mut engine = caudata_sim::build(Arc::clone(&model), 1, &config, &ground, 1, 1).unwrap();
    engine.reset(0, &InitialState::nominal(&model)).unwrap();
    for _ in 0..100 {
        engine.step(&[0.0; 12], &[0.0; 6]).unwrap();
    }
    let state = engine.state();
    let force_n: f32 = (0..4).map(|foot| state.foot_force_n[3 * foot + 2]).sum();
    let weight_n = 9.81 * model.total_mass_kg() as f32;
    assert!((force_n / weight_n - 1.0).abs() < 0.02, "{force_n} {weight_n}");
    assert!(state.foot_height_m.iter().all(|h| h.abs() < 2e-3), "{:?}", state.foot_height_m);
    for (wrong, says) in [("[]", "needs `geom`"), ("[\"FL_heel\", \"FR_toe\"]", "another link")] {
        let robot = robot.replace("[\"FL_heel\", \"FL_toe\"]", wrong);
        let refused = read(&robot).unwrap_err().to_string();
        assert!(refused.contains("feet.FL") && refused.contains(says), "{refused}");
    }
}

#[test]
fn a_biped() {
    let env = runs(&BIPED, 6, 2);
    assert_eq!(env.contract().phase.offsets_rad, [0.0, std::f32::consts::PI]);
}

#[test]
fn a_hexapod() {
    let env = runs(&HEXAPOD, 18, 6);
    let pi = std::f32::consts::PI;
    assert_eq!(env.contract().phase.offsets_rad, [0.0, pi, pi, 0.0, 0.0, pi]);
}

#[test]
fn a_snake_without_feet() {
    let env = runs(&SNAKE, 9, 0);
    assert!(env.contract().phase.feet.is_empty());
    assert_eq!(env.phases_rad(0).len(), 1);
}

const OWN_TASK: &str = r#"
    observation.term = [
        { name = "gyro", history = 2 },
        { name = "reach", value = "foot_height.FL + 0.5 * height", noise_std = 0.01 },
        { name = "torque", value = "torque", history = 2 },
        { name = "actions", history = 1 },
    ]
    reward.term = [{ name = "upright", value = "-gravity.z", weight = 2.0 }]
    termination.when = [{ name = "fast", value = "most(abs(joint_vel)) > 5" }]
    termination.max_tilt_rad = 3.1
    phase.pattern = "none"
"#;

/// Observation, reward and an end that the task file brings along, on a robot that it names parts of.
#[test]
fn a_task_of_ones_own() {
    let model = QUADRUPED.model();
    let task: TaskConfig = toml::from_str(OWN_TASK).unwrap();
    task.validate().unwrap();
    let (config, ground) = (EngineConfig::default(), TerrainConfig::default());
    let build = || caudata_sim::build(Arc::clone(&model), 1, &config, &ground, 1, 1).unwrap();
    let mut env = VecEnv::new(Arc::clone(&model), task.clone(), build(), 1, 0).unwrap();
    // gyro twice, one, twelve twice, twelve
    assert_eq!(env.obs_dim(), 6 + 1 + 24 + 12);
    env.contract().validate().unwrap();
    assert_eq!(env.phases_rad(0), [std::f32::consts::PI; 4]);
    let names = task.reward.term_names();
    let upright = names.iter().position(|name| name == "upright").unwrap();
    let (mut ended, mut before) = (false, env.observations().to_vec());
    for step in 0..200 {
        let swing = if step % 2 == 0 { 3.0 } else { -3.0 };
        let output = env.step(&[swing; 12]).unwrap();
        if let Some(episode) = output.episodes.first() {
            assert_eq!(episode.reason, Some(TerminationReason::Condition));
            assert!(episode.terms[upright] > 0.0 && episode.terms.len() == names.len());
            ended = true;
            break;
        }
        let now = env.observations();
        // what was newest is now a step old
        assert_eq!((&now[3..6], &now[19..31]), (&before[..3], &before[7..19]));
        before = now.to_vec();
    }
    assert!(ended, "no joint was fast");
    let unknown = OWN_TASK.replace("foot_height.FL", "foot_height.XL");
    let error = VecEnv::new(model.clone(), toml::from_str(&unknown).unwrap(), build(), 1, 0);
    let error = error.err().unwrap().to_string();
    assert!(error.contains("no such foot; it has: FL, FR, HL, HR"), "{error}");
}
