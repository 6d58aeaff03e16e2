//! What loads the joints of one lane: servos, springs, friction, stops.

use caudata_model::{JointKind, JointMotion, RobotModel};

use super::contacts::ContactImpulses;
use super::lane::Shared;
use super::robot::{JointState, Robot};
use crate::delay::CommandHistory;
use crate::joint::{self, PassiveParams, StopParams};
use crate::params::backlash_joints;
use crate::servo::{self, Envelope, Gains};
use crate::{LaneParams, State};

/// A slide's end stop in N/m per N·m/rad of a hinge's: the same stop met at a lever of 0.1 m.
const SLIDE_STOP_FACTOR: f32 = 100.0;

/// Joint loads of one lane, and what they did within the current control period.
pub(super) struct Drive {
    /// `[A]`
    servos: Vec<(Envelope, Gains)>,
    /// `[J]`
    passive: Vec<PassiveParams>,
    /// `[J]`
    stops: Vec<StopParams>,
    /// Start of the current physics step. `[J]`
    started: Vec<Started>,
    /// ∫τ dt per motor, N·m·s. `[A]`
    torque_sum: Vec<f64>,
    /// Work per motor, J. `[A]`
    work_sum: Vec<f64>,
    /// Contacts so far.
    pub contacts: ContactImpulses,
}

/// A joint at the start of a physics step, and the motor torque it gets.
#[derive(Clone, Copy, Default)]
struct Started {
    at: JointState,
    motor_nm: f32,
}

impl Drive {
    pub fn new(shared: &Shared, params: &LaneParams) -> Self {
        let model = &*shared.model;
        let servo = |a: usize| {
            let envelope = Envelope::new(model.servo(a), params.torque_scale[a], params.supply_v);
            let gains = Gains {
                kp_nm_per_rad: params.kp_nm_per_rad[a],
                kd_nms_per_rad: params.kd_nms_per_rad[a],
            };
            (envelope, gains)
        };
        let stop = StopParams {
            stiffness_nm_per_rad: shared.config.stop_stiffness_nm_per_rad as f32,
            damping_nms_per_rad: shared.config.stop_damping_nms_per_rad as f32,
        };
        let stops = model.joints().iter().map(|j| match j.motion {
            JointMotion::Hinge => stop,
            JointMotion::Slide => stop.times(SLIDE_STOP_FACTOR),
        });
        Self {
            servos: (0..model.actuated().len()).map(servo).collect(),
            passive: passive_params(model, params),
            stops: stops.collect(),
            started: vec![Started::default(); model.joints().len()],
            torque_sum: Vec::new(),
            work_sum: Vec::new(),
            contacts: ContactImpulses::default(),
        }
    }

    /// Starts a control period.
    pub fn clear(&mut self, feet: usize) {
        for sum in [&mut self.torque_sum, &mut self.work_sum] {
            sum.clear();
            sum.resize(self.servos.len(), 0.0);
        }
        self.contacts.clear(feet);
    }

    /// Loads every joint for the physics step that starts `since_command_s` into the control period.
    pub fn load(
        &mut self,
        shared: &Shared,
        robot: &mut Robot,
        history: &CommandHistory,
        delay_s: f64,
        since_command_s: f64,
        bristle_rad: &[f32],
    ) {
        let config = &shared.config;
        let (dt_s, period_s) = (config.dt_s, config.control_period_s());
        for (j, model_joint) in shared.model.joints().iter().enumerate() {
            let Some(at) = robot.joint(j) else { continue };
            let motor_nm = match model_joint.kind {
                JointKind::Actuated { index } => {
                    let target = history.delayed(index, delay_s, period_s, since_command_s, dt_s);
                    let (envelope, gains) = &self.servos[index];
                    servo::torque_nm(envelope, *gains, at.pos, at.vel, target)
                }
                JointKind::Passive | JointKind::Backlash => 0.0,
            };
            let passive = joint::passive_torque(
                &self.passive[j],
                self.stops[j],
                at.pos,
                at.vel,
                bristle_rad[j],
                dt_s as f32,
            );
            robot.load_joint(j, &passive, motor_nm);
            self.started[j] = Started { at, motor_nm };
        }
    }

    /// After the step: drags the friction bristles, sums motor torque, work and contacts.
    pub fn account(&mut self, shared: &Shared, robot: &Robot, bristle_rad: &mut [f32]) {
        for (j, model_joint) in shared.model.joints().iter().enumerate() {
            let Some(now) = robot.joint(j) else { continue };
            let Started { at, motor_nm } = self.started[j];
            bristle_rad[j] = joint::drag_bristle(bristle_rad[j], now.pos - at.pos);
            if let JointKind::Actuated { index } = model_joint.kind {
                let impulse = f64::from(motor_nm) * shared.config.dt_s;
                self.torque_sum[index] += impulse;
                // Mean speed, not way moved: an Euler step moves by its final speed, which would add τ²·dt²/2I.
                self.work_sum[index] += impulse * 0.5 * f64::from(at.vel + now.vel);
            }
        }
        self.contacts.add(&robot.world);
    }

    /// Writes the means over the period.
    pub fn write(&self, out: &mut State, period_s: f64) {
        let mean = |to: &mut [f32], from: &[f64]| {
            for (slot, sum) in to.iter_mut().zip(from) {
                *slot = (sum / period_s) as f32;
            }
        };
        mean(&mut out.motor_torque_nm, &self.torque_sum);
        mean(&mut out.mech_power_w, &self.work_sum);
        mean(&mut out.foot_force_n, &self.contacts.feet_ns);
        mean(&mut out.trunk_force_n, &[self.contacts.trunk_ns]);
        mean(&mut out.tail_force_n, &[self.contacts.tail_ns]);
    }
}

fn passive_params(model: &RobotModel, params: &LaneParams) -> Vec<PassiveParams> {
    let endless = (f32::NEG_INFINITY, f32::INFINITY);
    let mut all: Vec<PassiveParams> = model
        .joints()
        .iter()
        .map(|j| {
            let (damping, friction) = match j.kind {
                JointKind::Actuated { index } => (
                    params.joint_damping_nms_per_rad[index],
                    params.joint_friction_nm[index],
                ),
                JointKind::Passive | JointKind::Backlash => {
                    (j.damping_nm_s_per_rad as f32, j.friction_loss_nm as f32)
                }
            };
            PassiveParams {
                stiffness_nm_per_rad: j.stiffness_nm_per_rad as f32,
                spring_ref_rad: j.spring_ref_rad as f32,
                damping_nms_per_rad: damping,
                friction_nm: friction,
                range_rad: j
                    .range_rad
                    .map_or(endless, |(low, high)| (low as f32, high as f32)),
            }
        })
        .collect();
    for (j, &half) in backlash_joints(model).zip(&params.backlash_half_width_rad) {
        all[j].range_rad = (-half, half);
    }
    all
}
