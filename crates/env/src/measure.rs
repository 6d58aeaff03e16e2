//! One lane out of the engine's state: the truth that rewards look at, and what sensors make of it.

use caudata_model::{ImuParams, ModelError, Pose, RobotModel, ServoParams, Site, pose};
use caudata_random::Stream;
use caudata_sim::{Engine, State, sensors};
use caudata_task::noise::Readings;
use caudata_task::{PerFoot, PerJoint, TaskConfig};

/// The true state of one lane after a control step, in the task's order and frames. World frame where nothing
/// else is said.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Truth {
    /// Actuated joints, policy order.
    pub joint_pos_rad: PerJoint,
    /// Actuated joints, policy order.
    pub joint_vel_radps: PerJoint,
    /// Mean over the control period.
    pub motor_torque_nm: PerJoint,
    /// Mean over the control period, signed.
    pub mech_power_w: PerJoint,
    /// Heading of the whole body, rad.
    pub heading_rad: f32,
    /// Whole body, heading frame.
    pub com_vel_mps: [f32; 3],
    /// Whole body.
    pub yaw_rate_radps: f32,
    /// Above the ground under the feet.
    pub com_height_m: f32,
    /// IMU frame.
    pub gyro_radps: [f32; 3],
    /// Unit vector of gravity, IMU frame.
    pub gravity: [f32; 3],
    /// Lowest point of each foot above the ground.
    pub foot_height_m: PerFoot,
    /// Centre of each foot.
    pub foot_vel_mps: PerFoot<[f32; 3]>,
    /// Contact force on each foot, mean over the control period.
    pub foot_force_n: PerFoot<[f32; 3]>,
    /// Contact force on trunk and legs but not the feet, mean over the control period.
    pub trunk_force_n: f32,
    /// Height of the whole body's centre of mass above the water's surface; infinite where there is no water.
    pub com_above_water_m: f32,
    /// 1 while that is below 0, 0 otherwise.
    pub submerged: f32,
    /// 1 while it is that and farther above the highest ground under a foot or a girdle than
    /// `afloat_above_m`, 0 otherwise.
    pub afloat: f32,
    /// Which feet can be asked to walk, 1 or 0: all of them out of the water, and in it those whose girdle
    /// has the ground within `feet_reach_m`.
    pub on_ground: PerFoot,
}

/// What reading a lane needs to know of the robot.
#[derive(Clone, Debug)]
pub(crate) struct Reader {
    /// Model index of each actuated joint.
    pub actuated: PerJoint<usize>,
    pub foot_radius_m: PerFoot,
    /// Which feet are balls.
    pub foot_is_ball: PerFoot<bool>,
    /// Which girdle each foot's leg hangs nearer to: 0 the front one, 1 the hind one.
    pub girdle_of: PerFoot<usize>,
    /// How far ahead of the centre of mass the two girdles are, along the heading.
    pub girdles_ahead_m: [f32; 2],
    /// The task's `afloat_above_m`, m.
    pub afloat_above_m: f32,
    /// The task's `feet_reach_m`, m.
    pub feet_reach_m: f32,
}

impl Reader {
    /// What `model` and `task` say.
    pub fn new(model: &RobotModel, task: &TaskConfig) -> Result<Self, ModelError> {
        let (actuated, feet) = (model.actuated(), model.feet());
        Ok(Self {
            actuated: PerJoint::of(actuated),
            foot_radius_m: PerFoot::from_fn(feet.len(), |i| feet[i].radius_m() as f32),
            foot_is_ball: PerFoot::from_fn(feet.len(), |i| feet[i].is_ball()),
            girdle_of: girdle_of(model)?,
            girdles_ahead_m: girdles_ahead_m(model)?,
            afloat_above_m: task.afloat_above_m,
            feet_reach_m: task.feet_reach_m,
        })
    }
}

/// For each foot which girdle its leg hangs nearer to, by the place of the leg's first link in the nominal
/// pose; 0 for a robot whose file names no girdles.
fn girdle_of(model: &RobotModel) -> Result<PerFoot<usize>, ModelError> {
    let feet = model.feet();
    let Some((hind, front)) = model.heading_sites() else {
        return Ok(PerFoot::filled(feet.len(), 0));
    };
    let pos = model.full_pos_rad(model.nominal_pos_rad())?;
    let places = model.kinematics(&Pose::IDENTITY, &pos)?;
    let site = |s: &Site| places.links[s.link].point(s.link_from_site.pos_m);
    let [hind, front] = [site(hind), site(front)];
    let girdle = |foot: usize| {
        let up = |&link: &usize| model.links()[link].parent;
        let leg = std::iter::successors(Some(feet[foot].link), up)
            .take_while(|&link| model.leg_of(link) == Some(foot));
        let hip = leg.last().unwrap_or(feet[foot].link);
        let from = |girdle| pose::norm(pose::sub(places.links[hip].pos_m, girdle));
        usize::from(from(hind) < from(front))
    };
    Ok(PerFoot::from_fn(feet.len(), girdle))
}

/// How far ahead of the centre of mass the front and the hind girdle are, along the line that they make, in
/// the nominal pose, m. Both 0 for a robot whose file names no girdles, or both in one place.
fn girdles_ahead_m(model: &RobotModel) -> Result<[f32; 2], ModelError> {
    let Some((hind, front)) = model.heading_sites() else {
        return Ok([0.0; 2]);
    };
    let pos = model.full_pos_rad(model.nominal_pos_rad())?;
    let places = model.kinematics(&Pose::IDENTITY, &pos)?;
    let com_m = model.centre_of_mass_m(&places);
    let at = |site: &Site| places.links[site.link].point(site.link_from_site.pos_m);
    let [hind, front] = [at(hind), at(front)];
    let (along_x, along_y) = (front[0] - hind[0], front[1] - hind[1]);
    let length = along_x.hypot(along_y);
    if length < 1e-6 {
        return Ok([0.0; 2]);
    }
    Ok([front, hind].map(|site| {
        (((site[0] - com_m[0]) * along_x + (site[1] - com_m[1]) * along_y) / length) as f32
    }))
}

/// The water round a lane.
#[derive(Clone, Copy)]
struct Water {
    surface_m: f32,
    /// Under the front and under the hind girdle.
    girdle_ground_m: [f32; 2],
}

impl Reader {
    /// Reads lane `lane` into `truth`.
    pub fn read(&self, engine: &dyn Engine, lane: usize, truth: &mut Truth) {
        let terrain = engine.terrain();
        let state = engine.state();
        let water = terrain.water_level_m.map(|level_m| {
            let [x, y, _]: [f32; 3] = row(&state.com_pos_m, lane);
            let (sin, cos) = state.heading_rad[lane].sin_cos();
            let ground = |ahead| terrain.height_m(x + ahead * cos, y + ahead * sin);
            Water {
                surface_m: level_m + engine.params(lane).water_level_offset_m,
                girdle_ground_m: self.girdles_ahead_m.map(ground),
            }
        });
        let ground_m = |[x, y, _]: [f32; 3]| terrain.height_m(x, y);
        self.read_state(state, water, &ground_m, lane, truth);
    }

    /// `ground_m`: height of the ground under a place.
    fn read_state(
        &self,
        state: &State,
        water: Option<Water>,
        ground_m: &dyn Fn([f32; 3]) -> f32,
        lane: usize,
        truth: &mut Truth,
    ) {
        let feet = state.feet;
        let foot_pos = vectors(&state.foot_pos_m, lane, feet);
        let foot_height_m = values(&state.foot_height_m, lane, feet);
        let com: [f32; 3] = row(&state.com_pos_m, lane);
        let body_ground_m = if feet == 0 { ground_m(com) } else { 0.0 };
        let ground_m = PerFoot::from_fn(feet, |j| match self.foot_is_ball[j] {
            true => foot_pos[j][2] - self.foot_radius_m[j] - foot_height_m[j],
            false => ground_m(foot_pos[j]),
        });
        let mean_ground_m = match feet {
            0 => body_ground_m,
            feet => ground_m.iter().sum::<f32>() / feet as f32,
        };
        let com_above_water_m = water.map_or(f32::INFINITY, |water| com[2] - water.surface_m);
        let submerged = com_above_water_m < 0.0;
        // The girdles, too: legs that are folded back have their feet over deeper ground than they would
        // stand on.
        let highest_ground_m = water
            .into_iter()
            .flat_map(|water| water.girdle_ground_m)
            .chain(ground_m)
            .fold(if feet == 0 { body_ground_m } else { f32::MIN }, f32::max);
        let gravity: [f32; 3] = row(&state.imu_gravity, lane);
        let afloat = submerged && com[2] - highest_ground_m > self.afloat_above_m;
        let on_ground = |foot: usize| {
            let Some(water) = water.filter(|_| submerged) else { return 1.0 };
            if afloat {
                return 0.0;
            }
            // Gravity leans back in the body where the nose is up.
            let girdle = self.girdle_of[foot];
            let girdle_m = com[2] - self.girdles_ahead_m[girdle] * gravity[0];
            f32::from(girdle_m - water.girdle_ground_m[girdle] <= self.feet_reach_m)
        };
        let joints = &self.actuated;
        truth.joint_pos_rad.refill(joints.len(), |a| state.encoder_pos_rad(lane, joints[a], a));
        truth.joint_vel_radps.refill(joints.len(), |a| state.encoder_vel_radps(lane, joints[a], a));
        let torque_nm = values(&state.motor_torque_nm, lane, state.actuated);
        truth.motor_torque_nm.set(torque_nm);
        let power_w = values(&state.mech_power_w, lane, state.actuated);
        truth.mech_power_w.set(power_w);
        truth.heading_rad = state.heading_rad[lane];
        truth.com_vel_mps = into_heading(row(&state.com_vel_mps, lane), truth.heading_rad);
        truth.yaw_rate_radps = state.com_angvel_radps[3 * lane + 2];
        truth.com_height_m = com[2] - mean_ground_m;
        truth.gyro_radps = row(&state.imu_gyro_radps, lane);
        truth.gravity = gravity;
        truth.foot_height_m.set(foot_height_m);
        let foot_vel_mps = vectors(&state.foot_vel_mps, lane, feet);
        truth.foot_vel_mps.set(foot_vel_mps);
        let foot_force_n = vectors(&state.foot_force_n, lane, feet);
        truth.foot_force_n.set(foot_force_n);
        truth.trunk_force_n = state.trunk_force_n[lane];
        truth.com_above_water_m = com_above_water_m;
        truth.submerged = f32::from(submerged);
        truth.afloat = f32::from(afloat);
        truth.on_ground.refill(feet, on_ground);
    }
}

/// What tells a robot whether it swims: the medium bit of a task, outside of an environment.
#[derive(Clone, Debug)]
pub struct WaterSensor(Reader);

impl WaterSensor {
    /// The sensor of a robot that is to swim where the task says so (`task.afloat_above_m`).
    ///
    /// # Errors
    /// [`ModelError`] where the robot's own pose is not one of it.
    pub fn new(model: &RobotModel, task: &TaskConfig) -> Result<Self, ModelError> {
        Reader::new(model, task).map(Self)
    }

    /// Whether lane `lane` of `engine` swims.
    pub fn in_water(&self, engine: &dyn Engine, lane: usize) -> bool {
        let mut truth = Truth::default();
        self.0.read(engine, lane, &mut truth);
        truth.afloat > 0.0
    }
}

impl Truth {
    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        // Without short cuts, so that the comparisons run side by side.
        let bad = |values: &[f32]| values.iter().fold(false, |bad, v| bad | !v.is_finite());
        let any_bad = bad(&self.joint_pos_rad)
            | bad(&self.joint_vel_radps)
            | bad(&self.motor_torque_nm)
            | bad(&self.mech_power_w)
            | bad(&self.com_vel_mps)
            | bad(&[self.yaw_rate_radps, self.com_height_m, self.trunk_force_n])
            | bad(&self.gyro_radps)
            | bad(&self.gravity)
            | bad(&self.foot_height_m)
            | bad(self.foot_vel_mps.as_flattened())
            | bad(self.foot_force_n.as_flattened());
        !any_bad
    }

    /// What perfect sensors would read.
    pub fn readings(&self, readings: &mut Readings) {
        readings.joint_vel_radps.set(&self.joint_vel_radps);
        readings.joint_pos_rad.set(&self.joint_pos_rad);
        (readings.gyro_radps, readings.gravity) = (self.gyro_radps, self.gravity);
    }
}

/// The robot's encoders and IMU, as its file describes them.
#[derive(Clone, Debug)]
pub(crate) struct Sensors {
    servos: Vec<ServoParams>,
    imu: Option<ImuParams>,
    control_period_s: f64,
}

impl Sensors {
    pub fn new(model: &RobotModel, control_period_s: f64) -> Self {
        Self {
            servos: (0..model.actuated().len()).map(|i| model.servo(i).clone()).collect(),
            imu: model.sensors().imu.clone(),
            control_period_s,
        }
    }

    /// Offsets of the IMU in one episode.
    pub fn draw_bias(&self, stream: &mut Stream) -> sensors::ImuBias {
        self.imu.as_ref().map(|imu| sensors::ImuBias::draw(imu, stream)).unwrap_or_default()
    }

    /// Turns true values into readings, in place. (Gravity comes from an attitude estimate, not from a
    /// sensor.)
    pub fn measure(&self, readings: &mut Readings, bias: &sensors::ImuBias, stream: &mut Stream) {
        for (i, servo) in self.servos.iter().enumerate() {
            let pos = &mut readings.joint_pos_rad[i];
            *pos = sensors::encoder_pos_rad(servo, *pos, 0.0);
            let vel = &mut readings.joint_vel_radps[i];
            *vel = sensors::encoder_vel_radps(servo, *vel);
        }
        if let Some(imu) = &self.imu {
            let gyro = &mut readings.gyro_radps;
            let noise = imu.gyro_noise_radps_per_sqrt_hz;
            let period_s = self.control_period_s;
            *gyro = sensors::reading(*gyro, bias.gyro_radps, noise, period_s, stream);
        }
    }
}

/// A world vector in the heading frame: turned by −heading about z.
fn into_heading(v: [f32; 3], heading_rad: f32) -> [f32; 3] {
    let (sin, cos) = heading_rad.sin_cos();
    [cos * v[0] + sin * v[1], cos * v[1] - sin * v[0], v[2]]
}

/// Row `lane` of a `[N, count]` array.
fn values(all: &[f32], lane: usize, count: usize) -> &[f32] {
    &all[lane * count..][..count]
}

/// Row `lane` of a `[N, K]` array.
fn row<const K: usize>(values: &[f32], lane: usize) -> [f32; K] {
    let mut out = [0.0; K];
    out.copy_from_slice(&values[lane * K..][..K]);
    out
}

/// Row `lane` of a `[N, count, 3]` array.
fn vectors(all: &[f32], lane: usize, count: usize) -> &[[f32; 3]] {
    all[lane * count * 3..][..count * 3].as_chunks::<3>().0
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::FRAC_PI_2;

    const ACT_DIM: usize = 16;
    const FEET: usize = 4;

    fn reader() -> Reader {
        Reader {
            actuated: [0, 1, 2, 3, 4, 6, 7, 8, 10, 11, 12, 13, 14, 15, 16, 17].into(),
            foot_radius_m: [0.02; FEET].into(),
            foot_is_ball: [true; FEET].into(),
            girdle_of: [0, 0, 1, 1].into(),
            girdles_ahead_m: [0.0; 2],
            afloat_above_m: 0.09,
            feet_reach_m: 0.09,
        }
    }

    fn read_lane(reader: &Reader, state: &State, water: Option<Water>, lane: usize) -> Truth {
        let mut truth = Truth::default();
        reader.read_state(state, water, &|_| 0.0, lane, &mut truth);
        truth
    }

    fn state() -> State {
        State::zeros(2, 18, ACT_DIM, FEET)
    }

    #[test]
    fn velocity_is_turned_into_the_heading() {
        // Heading +y (90°), moving at 0.3 along world y and 0.1 along world x: forward 0.3, to the right 0.1.
        let mut state = state();
        state.heading_rad[1] = FRAC_PI_2;
        state.com_vel_mps[3..].copy_from_slice(&[0.1, 0.3, 0.05]);
        state.com_angvel_radps[3..].copy_from_slice(&[7.0, 8.0, 0.4]);
        let truth = read_lane(&reader(), &state, None, 1);
        for (found, expected) in truth.com_vel_mps.iter().zip([0.3, -0.1, 0.05]) {
            assert!((found - expected).abs() < 1e-6, "{:?}", truth.com_vel_mps);
        }
        assert_eq!(truth.yaw_rate_radps, 0.4);
        assert_eq!(read_lane(&reader(), &state, None, 0).com_vel_mps, [0.0; 3]);
    }

    #[test]
    fn joints_come_in_policy_order() {
        let mut state = state();
        for j in 0..18 {
            state.joint_pos_rad[18 + j] = j as f32;
            state.joint_vel_radps[18 + j] = -(j as f32);
        }
        let truth = read_lane(&reader(), &state, None, 1);
        assert_eq!(truth.joint_pos_rad[5], 6.0);
        assert_eq!(truth.joint_vel_radps[15], -17.0);
        let mut readings = Readings::default();
        truth.readings(&mut readings);
        assert_eq!(readings.joint_pos_rad, truth.joint_pos_rad);
    }

    #[test]
    fn height_is_above_the_ground_under_the_feet() {
        // Feet centres at 0.52, balls of 0.02, the lowest points 0.10, 0.10, 0 and 0 above the ground: ground
        // at 0.40, 0.40, 0.50, 0.50, mean 0.45. Centre of mass at 0.57: 0.12 above.
        let mut state = state();
        for foot in 0..FEET {
            state.foot_pos_m[3 * foot + 2] = 0.52;
        }
        state.foot_height_m[..4].copy_from_slice(&[0.1, 0.1, 0.0, 0.0]);
        state.com_pos_m[2] = 0.57;
        let truth = read_lane(&reader(), &state, None, 0);
        assert!((truth.com_height_m - 0.12).abs() < 1e-6);
    }

    #[test]
    fn any_value_that_is_not_finite_is_noticed() {
        type Part = fn(&mut State) -> &mut f32;
        let parts: [Part; 8] = [
            |s| &mut s.joint_pos_rad[17],
            |s| &mut s.joint_vel_radps[0],
            |s| &mut s.mech_power_w[15],
            |s| &mut s.com_vel_mps[2],
            |s| &mut s.heading_rad[0],
            |s| &mut s.imu_gravity[1],
            |s| &mut s.foot_force_n[11],
            |s| &mut s.trunk_force_n[0],
        ];
        assert!(read_lane(&reader(), &state(), None, 0).is_finite());
        for (i, part) in parts.iter().enumerate() {
            for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                let mut state = state();
                *part(&mut state) = bad;
                assert!(!read_lane(&reader(), &state, None, 0).is_finite(), "part {i} {bad}");
                assert!(read_lane(&reader(), &state, None, 1).is_finite());
            }
        }
    }

    #[test]
    fn girdles_lie_before_and_behind_the_centre_of_mass() {
        // Of polymander.xml, straight: sites at x = -0.204114 and -0.532614, so 0.3285 m apart.
        let robot = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../robots/polymander.robot.toml");
        let model = RobotModel::load(&robot).unwrap();
        let [front, hind] = girdles_ahead_m(&model).unwrap();
        assert!((front - hind - 0.3285).abs() < 1e-4, "{front} {hind}");
        assert!(front > 0.1 && hind < -0.1, "{front} {hind}");
    }

    #[test]
    fn afloat_is_below_the_surface_with_the_ground_out_of_reach() {
        // Feet on ground at 0.3 but for one, under which it is `shallow`.
        let read_near = |girdle_ground_m, com_m: f32, shallow_m: f32, surface_m: Option<f32>| {
            let mut state = state();
            state.com_pos_m[2] = com_m;
            for foot in 0..FEET {
                state.foot_pos_m[3 * foot + 2] = 0.38;
                state.foot_height_m[foot] = 0.06;
            }
            state.foot_height_m[2] = 0.36 - shallow_m;
            let water = surface_m
                .map(|surface_m| Water { surface_m, girdle_ground_m: [girdle_ground_m, 0.0] });
            let truth = read_lane(&reader(), &state, water, 0);
            (truth.submerged, truth.afloat)
        };
        let read = |com_m, shallow_m, surface_m| read_near(0.3, com_m, shallow_m, surface_m);
        assert_eq!(read(0.38, 0.2, Some(0.4)), (1.0, 0.0)); // 0.08 over the ground at 0.3
        assert_eq!(read(0.42, 0.3, Some(0.5)), (1.0, 1.0)); // 0.12 over it
        assert_eq!(read(0.42, 0.34, Some(0.5)), (1.0, 0.0)); // 0.08 over the ground of one foot
        assert_eq!(read_near(0.34, 0.42, 0.3, Some(0.5)), (1.0, 0.0)); // 0.08 over the ground of a girdle: folded legs hide nothing
        assert_eq!(read(0.42, 0.3, Some(0.4)), (0.0, 0.0)); // above the surface
        assert_eq!(read(0.42, 0.3, None), (0.0, 0.0)); // dry
    }

    #[test]
    fn feet_walk_in_water_where_their_girdle_has_the_ground_in_reach() {
        let reader = Reader { girdles_ahead_m: [0.16, -0.16], ..reader() };
        let read = |front_ground_m, nose_up_rad: f32, surface_m| {
            let mut state = state();
            state.com_pos_m[2] = 0.4;
            state.foot_height_m.fill(0.3);
            state.imu_gravity[..3].copy_from_slice(&[-nose_up_rad.sin(), 0.0, -nose_up_rad.cos()]);
            let water = Water { surface_m, girdle_ground_m: [front_ground_m, 0.2] };
            read_lane(&reader, &state, Some(water), 0).on_ground
        };
        // The ground 0.08 under the fore girdle and 0.2 under the hind one.
        assert_eq!(read(0.32, 0.0, 0.45), [1.0, 1.0, 0.0, 0.0]);
        // The same with the nose up by 0.1 rad: 0.4 + 0.16·sin(0.1) − 0.32 = 0.096, out of reach.
        assert_eq!(read(0.32, 0.1, 0.45), [0.0; FEET]);
        // 0.2 under both: afloat. Above the surface all feet walk.
        assert_eq!(read(0.2, 0.0, 0.45), [0.0; FEET]);
        assert_eq!(read(0.2, 0.0, 0.35), [1.0; FEET]);
    }
}
