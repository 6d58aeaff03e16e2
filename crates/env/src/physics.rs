//! From the task's random draws to the engine's parameters of one lane.

use caudata_model::RobotModel;
use caudata_sim::{InitialState, LaneParams, MAX_COMMAND_DELAY_S};
use caudata_task::randomise::{Failure, RandomDraw};
use caudata_task::reset::ResetDraw;

/// Dry friction of a servo that is stuck, N·m: ten times what servos of such robots give.
const STUCK_FRICTION_NM: f32 = 20.0;

/// Buffers that turn draws into what the engine takes, made once.
#[derive(Debug)]
pub(crate) struct PhysicsDraws {
    /// The nominal robot.
    nominal: LaneParams,
    /// The robot of the episode that is being started.
    pub params: LaneParams,
    /// Its start.
    pub init: InitialState,
    /// Its draw.
    pub draw: RandomDraw,
}

impl PhysicsDraws {
    pub fn new(model: &RobotModel) -> Self {
        let nominal = LaneParams::nominal(model);
        Self {
            params: nominal.clone(),
            init: InitialState::nominal(model),
            draw: RandomDraw::nominal(
                nominal.link_mass_scale.len(),
                nominal.kp_nm_per_rad.len(),
                nominal.backlash_half_width_rad.len(),
            ),
            nominal,
        }
    }

    /// Sets `params` to the nominal robot changed by `draw`, with these factors on the torques. `[A]`
    pub fn apply_draw(&mut self, strengths: &[f32]) {
        let Self { nominal, params, draw, .. } = self;
        params.gravity_mps2 = nominal.gravity_mps2;
        params.foot_friction = nominal.foot_friction * draw.foot_friction_scale;
        params.body_friction = nominal.body_friction * draw.body_friction_scale;
        for link in 0..nominal.link_mass_scale.len() {
            params.link_mass_scale[link] =
                nominal.link_mass_scale[link] * draw.link_mass_scale[link];
            for axis in 0..3 {
                params.com_offset_m[link][axis] =
                    nominal.com_offset_m[link][axis] + draw.com_offset_m[link][axis];
            }
        }
        for i in 0..nominal.kp_nm_per_rad.len() {
            params.joint_friction_nm[i] =
                nominal.joint_friction_nm[i] * draw.joint_friction_scale[i];
            params.joint_armature_kgm2[i] = nominal.joint_armature_kgm2[i] * draw.armature_scale[i];
            params.joint_damping_nms_per_rad[i] =
                nominal.joint_damping_nms_per_rad[i] * draw.damping_scale[i];
            params.kp_nm_per_rad[i] = nominal.kp_nm_per_rad[i] * draw.kp_scale[i];
            params.kd_nms_per_rad[i] = nominal.kd_nms_per_rad[i] * draw.kd_scale[i];
            params.torque_scale[i] = nominal.torque_scale[i] * draw.torque_scale * strengths[i];
        }
        match draw.failure {
            Some(Failure::Limp(joint)) => params.torque_scale[joint] = 0.0,
            Some(Failure::Stuck(joint)) => params.joint_friction_nm[joint] = STUCK_FRICTION_NM,
            None => {}
        }
        params.payload_kg = nominal.payload_kg + draw.payload_kg;
        params.supply_v = nominal.supply_v * draw.supply_scale;
        params.command_delay_s =
            (nominal.command_delay_s + draw.command_delay_s).min(MAX_COMMAND_DELAY_S);
        for (i, scale) in draw.backlash_scale.iter().enumerate() {
            params.backlash_half_width_rad[i] = nominal.backlash_half_width_rad[i] * scale;
        }
    }

    /// Sets `init` to the drawn start.
    pub fn apply_start(&mut self, start: &ResetDraw) {
        self.init.base_xy_m = start.base_xy_m;
        let [roll, pitch] = start.roll_pitch_rad;
        self.init.base_rpy_rad = [roll, pitch, start.yaw_rad];
        self.init.base_vel_mps = [start.base_vel_mps[0], start.base_vel_mps[1], 0.0];
        self.init.joint_pos_rad.copy_from_slice(&start.joint_pos_rad);
        self.init.joint_vel_radps.copy_from_slice(&start.joint_vel_radps);
    }
}
