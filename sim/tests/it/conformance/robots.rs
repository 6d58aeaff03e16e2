//! Small robots with numbers that can be worked by hand, and the Polymander.

use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;

/// The Polymander of `robots/`.
pub fn polymander() -> Arc<RobotModel> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    Arc::new(RobotModel::load(&file).unwrap())
}

/// A robot file: `actuated` joints with nominal 0, servo without friction, damping, armature or extra
/// damping; gains 0. Torque limits 10 N·m up to 100 rad/s. `tail` may add tables.
pub fn robot_toml(base: &str, actuated: &[&str], tail: &str) -> String {
    let names: Vec<String> = actuated.iter().map(|j| format!("{j:?}")).collect();
    let nominal: String = actuated.iter().map(|j| format!("{j} = 0.0\n")).collect();
    format!(
        r#"
format = "caudata.robot.v1"
name = "test"
mjcf = "test.xml"
base = "{base}"
[joints]
actuated = [{}]
[pose.nominal_rad]
{nominal}
[control]
kp_nm_per_rad = 0.0
kd_nm_s_per_rad = 0.0
[servo]
default = "s"
[servo.preset.s]
tau_max_nm = 10.0
qd_tau_max_radps = 100.0
qd_max_radps = 200.0
tau_qd_max_nm = 5.0
tau_brake_max_nm = 10.0
kd_min_nm_s_per_rad = 0.0
back_drive_kp_ratio = 1.0
friction_loss_nm = 0.0
damping_nm_s_per_rad = 0.0
armature_kgm2 = 0.0
reference_supply_v = 12.0
encoder_counts_per_turn = 4096
velocity_lsb_radps = 0.024
current_lsb_a = 0.0027
torque_per_current_nm_per_a = 1.0
current_dead_band_a = 0.0
gear_backlash_rad = 0.0
[supply]
default_v = 12.0
bench_v = 12.0
battery_full_v = 12.6
battery_nominal_v = 11.1
[contact]
foot_friction = 0.5
body_friction = 0.5
{tail}"#,
        names.join(", "),
    )
}

pub fn load(toml: &str, bodies: &str, actuated: &[&str]) -> Arc<RobotModel> {
    let motors: String = actuated.iter().map(|j| format!("<motor joint={j:?}/>")).collect();
    let mjcf = format!(
        r#"<mujoco><compiler angle="radian" autolimits="true"/><option gravity="0 0 -9.81"/>
        <worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"#
    );
    Arc::new(RobotModel::from_bytes("test.robot.toml", toml.as_bytes(), mjcf.as_bytes()).unwrap())
}

/// A pendulum about y: 0.5 kg, centre of mass 0.2 m below the pivot, inertia 0.005 kg·m² about it, so
/// 0.005 + 0.5·0.2² = 0.025 kg·m² about the pivot and m·g·l = 0.5·9.81·0.2 = 0.981 N·m. Stops at ±2.5 rad.
pub fn pendulum() -> Arc<RobotModel> {
    let joints = ["swing"];
    load(
        &robot_toml("fixed", &joints, ""),
        r#"<body name="rod" pos="0 0 1">
             <inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.005 0.005 0.005"/>
             <joint name="swing" axis="0 1 0" range="-2.5 2.5"/>
           </body>"#,
        &joints,
    )
}

/// Two pendulums in a chain, axes y and x.
pub fn double_pendulum() -> Arc<RobotModel> {
    let joints = ["swing", "sway"];
    load(
        &robot_toml("fixed", &joints, ""),
        r#"<body name="upper" pos="0 0 1">
             <inertial pos="0.01 0 -0.1" mass="0.5" diaginertia="0.002 0.003 0.001"/>
             <joint name="swing" axis="0 1 0" range="-1000 1000"/>
             <body name="lower" pos="0 0 -0.2">
               <inertial pos="0 0.02 -0.1" mass="0.3" diaginertia="0.001 0.001 0.0005"/>
               <joint name="sway" axis="1 0 0" range="-1000 1000"/>
             </body>
           </body>"#,
        &joints,
    )
}

/// A 0.4 kg weight on a vertical slide with stops at −0.5 and 0.5 m.
pub fn slider() -> Arc<RobotModel> {
    let joints = ["lift"];
    load(
        &robot_toml("fixed", &joints, ""),
        r#"<body name="weight" pos="0 0 2">
             <inertial pos="0.05 0 0" mass="0.4" diaginertia="0.001 0.001 0.001"/>
             <joint name="lift" type="slide" axis="0 0 1" range="-0.5 0.5"/>
           </body>"#,
        &joints,
    )
}

/// A table of 2 kg in all on four ball feet (radius 2 cm, 0.1 m from the middle in x and y), centre of mass 1
/// cm above the balls' centres; with a wheel of 0.1 kg about z in its middle. Base frame at the balls'
/// height.
pub fn table() -> Arc<RobotModel> {
    let joints = ["wheel"];
    let feet: String = [("FL", 1, 1), ("FR", 1, -1), ("HL", -1, 1), ("HR", -1, -1)]
        .iter()
        .map(|(name, x, y)| {
            format!(
                r#"<geom name="{name}" type="sphere" size="0.02" pos="{} {} 0"/>"#,
                0.1 * f64::from(*x),
                0.1 * f64::from(*y)
            )
        })
        .collect();
    let tail = r#"
[[feet]]
name = "FL"
geom = "FL"
[[feet]]
name = "FR"
geom = "FR"
[[feet]]
name = "HL"
geom = "HL"
[[feet]]
name = "HR"
geom = "HR"
[frames]
torso = "top"
[imu]
site = "imu"
gyro_noise_radps_per_sqrt_hz = 0.0
acc_noise_mps2_per_sqrt_hz = 0.0
gyro_bias_std_radps = 0.0
acc_bias_std_mps2 = 0.0
"#;
    load(
        &robot_toml("free", &joints, tail),
        &format!(
            r#"<geom type="plane" size="0 0 1"/>
            <body name="top" pos="0 0 0.02"><freejoint/>
              <inertial pos="0 0 0.01" mass="1.9" diaginertia="0.01 0.01 0.02"/>
              {feet}
              <site name="imu" pos="0.05 0 0"/>
              <body name="disc" pos="0 0 0.01">
                <inertial pos="0 0 0" mass="0.1" diaginertia="0.001 0.001 0.002"/>
                <joint name="wheel" axis="0 0 1" range="-1000 1000"/>
              </body>
            </body>"#
        ),
        &joints,
    )
}

/// A cart of 2.4 kg in all on four wheels without drives: discs of 0.1 kg and 5 cm, ½·0.1·0.05² = 1.25e-4 kg·m²
/// about their axles. Base frame and centre of mass at the axles' height.
pub fn cart() -> Arc<RobotModel> {
    let joints = ["fl", "fr", "hl", "hr"];
    let wheel = |(name, x, y): (&str, f64, f64)| {
        format!(
            r#"<body name="{name}_wheel" pos="{x} {y} 0">
                 <inertial pos="0 0 0" mass="0.1" diaginertia="6.6e-5 1.25e-4 6.6e-5"/>
                 <joint name="{name}" axis="0 1 0" range="-100000 100000"/>
                 <geom type="cylinder" size="0.05 0.01" euler="1.5707963 0 0"/>
               </body>"#
        )
    };
    let corners = [("fl", 0.1, 0.08), ("fr", 0.1, -0.08), ("hl", -0.1, 0.08), ("hr", -0.1, -0.08)];
    load(
        &robot_toml("free", &joints, "[frames]\ntorso = \"cart\"\n"),
        &format!(
            r#"<geom type="plane" size="0 0 1"/>
            <body name="cart" pos="0 0 0.05"><freejoint/>
              <inertial pos="0 0 0" mass="2.0" diaginertia="0.01 0.01 0.01"/>
              {}
            </body>"#,
            corners.map(wheel).concat()
        ),
        &joints,
    )
}

/// A trunk of 0.9 kg on six legs of two joints (2 N·m/rad) and 0.13 kg that end in cylinders of 1 cm.
pub fn six_cylinders() -> Arc<RobotModel> {
    let (mut joints, mut legs) = (Vec::new(), String::new());
    for (leg, (x, y)) in
        [(0.12, 0.06), (0.0, 0.06), (-0.12, 0.06), (0.12, -0.06), (0.0, -0.06), (-0.12, -0.06)]
            .into_iter()
            .enumerate()
    {
        joints.extend([format!("swing{leg}"), format!("lift{leg}")]);
        legs += &format!(
            r#"<body name="upper{leg}" pos="{x} {y} 0">
                 <inertial pos="0 0 -0.04" mass="0.08" diaginertia="4.3e-5 4.3e-5 6e-6"/>
                 <joint name="swing{leg}" axis="0 1 0" range="-0.8 0.8"/>
                 <body name="foot{leg}" pos="0 0 -0.08">
                   <inertial pos="0 0 -0.05" mass="0.05" diaginertia="4.2e-5 4.2e-5 2.5e-6"/>
                   <joint name="lift{leg}" axis="1 0 0" range="-1 1"/>
                   <geom type="cylinder" size="0.01 0.05" pos="0 0 -0.05"/>
                 </body>
               </body>"#
        );
    }
    let joints: Vec<&str> = joints.iter().map(String::as_str).collect();
    load(
        &robot_toml("free", &joints, "[frames]\ntorso = \"trunk\"\n")
            .replace("kp_nm_per_rad = 0.0", "kp_nm_per_rad = 2.0")
            .replace("kd_nm_s_per_rad = 0.0", "kd_nm_s_per_rad = 0.05")
            .replace("armature_kgm2 = 0.0", "armature_kgm2 = 0.0012"),
        &format!(
            r#"<geom type="plane" size="0 0 1"/>
            <body name="trunk" pos="0 0 0.18"><freejoint/>
              <inertial pos="0 0 0" mass="0.9" diaginertia="0.002 0.005 0.006"/>
              {legs}
            </body>"#
        ),
        &joints,
    )
}

/// A free chain of two off-centre links without anything to touch the ground.
pub fn tumbler() -> Arc<RobotModel> {
    let joints = ["bend"];
    load(
        &robot_toml("free", &joints, "[frames]\ntorso = \"one\"\n"),
        r#"<body name="one" pos="0 0 1"><freejoint/>
             <inertial pos="0.1 0.02 -0.03" mass="0.8" diaginertia="0.002 0.004 0.005"/>
             <body name="two" pos="0.3 0 0">
               <inertial pos="0.1 0 0.05" mass="0.4" diaginertia="0.001 0.002 0.0015"/>
               <joint name="bend" axis="0 0.6 0.8" range="-1000 1000"/>
             </body>
           </body>"#,
        &joints,
    )
}

/// Two wheels of 0.01 kg·m² about z on a held post.
pub fn wheels() -> Arc<RobotModel> {
    let joints = ["first", "second"];
    let wheel = |name: &str, x: f64| {
        format!(
            r#"<body name="{name}_wheel" pos="{x} 0 0">
                 <inertial pos="0 0 0" mass="0.5" diaginertia="0.006 0.006 0.01"/>
                 <joint name="{name}" axis="0 0 1" range="-1000 1000"/>
               </body>"#
        )
    };
    load(
        &robot_toml("fixed", &joints, ""),
        &format!(
            r#"<body name="post" pos="0 0 1"><inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
            {}{}</body>"#,
            wheel("first", 0.3),
            wheel("second", -0.3)
        ),
        &joints,
    )
}

/// A box of 0.2 × 0.2 × 0.1 m and 2.7 kg, even inside, with a disc of 0.1 kg in its middle. All under water
/// the box displaces 4 kg. Drag of the box as it is, no heave damping, nothing for the disc.
pub fn buoy() -> Arc<RobotModel> {
    let joints = ["spin"];
    let tail = r#"
[frames]
torso = "box"
[water]
density_kg_per_m3 = 1000.0
viscosity_pa_s = 0.001
buoyancy_ratio = 1.4814814814814814
heave_damping_ns_per_m = 0.0
[water.drag.box]
links = ["box"]
[water.drag.box.scale]
linear_force = [1.0, 1.0, 1.0]
quadratic_force = [1.0, 1.0, 1.0]
linear_torque = [1.0, 1.0, 1.0]
quadratic_torque = [1.0, 1.0, 1.0]
[water.drag.disc]
links = ["disc"]
[water.drag.disc.scale]
linear_force = [0.0, 0.0, 0.0]
quadratic_force = [0.0, 0.0, 0.0]
linear_torque = [0.0, 0.0, 0.0]
quadratic_torque = [0.0, 0.0, 0.0]
"#;
    // 2.7/12·(0.04 + 0.01) and 2.7/12·0.08
    load(
        &robot_toml("free", &joints, tail),
        r#"<body name="box" pos="0 0 1"><freejoint/>
             <inertial pos="0 0 0" mass="2.7" diaginertia="0.01125 0.01125 0.018"/>
             <geom type="box" size="0.1 0.1 0.05"/>
             <body name="disc" pos="0 0 0">
               <inertial pos="0 0 0" mass="0.1" diaginertia="0.0001 0.0001 0.0002"/>
               <joint name="spin" axis="0 0 1" range="-1000 1000"/>
             </body>
           </body>"#,
        &joints,
    )
}

/// A held post with two legs side by side, hips 0.2 m apart, each 0.15 m long along x with a ball foot
/// (radius 3 cm) at its end, swinging about z.
pub fn scissors() -> Arc<RobotModel> {
    let joints = ["left", "right"];
    let leg = |name: &str, y: f64| {
        format!(
            r#"<body name="{name}_leg" pos="0 {y} 0">
                 <inertial pos="0.1 0 0" mass="0.1" diaginertia="0.0001 0.0003 0.0003"/>
                 <joint name="{name}" axis="0 0 1" range="-2 2"/>
                 <geom name="{name}_foot" type="sphere" size="0.03" pos="0.15 0 0"/>
               </body>"#
        )
    };
    let tail = "[[feet]]\nname = \"L\"\ngeom = \"left_foot\"\n[[feet]]\nname = \"R\"\ngeom = \"right_foot\"\n";
    load(
        &robot_toml("fixed", &joints, tail),
        &format!(
            r#"<body name="post" pos="0 0 1"><inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
            {}{}</body>"#,
            leg("left", 0.1),
            leg("right", -0.1)
        ),
        &joints,
    )
}
