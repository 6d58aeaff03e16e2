//! What loads the joints of one lane: drive-lines, springs, friction, stops.

use caudata_model::JointKind;
use serde::{Deserialize, Serialize};

use super::contacts::ContactImpulses;
use super::robot::{JointState, Robot};
use super::shared::Shared;
use crate::drive::command::Scheduled;
use crate::drive::loss::LossMemory;
use crate::drive::passive::{self, StopAt};
use crate::drive::step::{self, Driven, Step};
use crate::drive::supply::{self, Bus, Supply};
use crate::drive::{
    CommandHistory, DriveFeatures, JointMemory, JointPassive, ServoDrive, WantedTorques, friction,
    loop_memory_steps,
};
use crate::per_lane::PerLane;
use crate::{CommandLoss, InitialState, LaneParams, State};

/// What the drive-lines of one lane remember.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct DriveMemory {
    /// Commands that may not have reached the servos yet.
    history: CommandHistory<f32>,
    loss: LossMemory,
    /// `[A]`
    servos: Vec<JointMemory<f32>>,
    wanted: WantedTorques<f32>,
    /// Friction bristles; those of actuated joints are in `servos`. `[J]`
    bristle_rad: Vec<f32>,
    /// Accelerations in the last step, without the joints' stops. `[J]`
    free_radps2: Vec<f32>,
    /// Bus voltage, V.
    bus_v: f32,
}

impl DriveMemory {
    /// Nothing on its way, supply unloaded.
    pub fn new(shared: &Shared, params: &LaneParams, init: &InitialState) -> Self {
        let moving = init.joint_pos_rad.iter().zip(&init.joint_vel_radps);
        let mut new = Self {
            history: CommandHistory::new(shared.config.control_period_s(), &init.joint_pos_rad),
            loss: LossMemory::default(),
            servos: moving
                .map(|(&q, &qd)| PerLane::splat(&JointMemory::rest(f64::from(q), f64::from(qd))))
                .collect(),
            wanted: WantedTorques::new(shared.model.actuated().len()),
            bristle_rad: vec![0.0; shared.model.joints().len()],
            free_radps2: vec![0.0; shared.model.joints().len()],
            bus_v: params.supply_v,
        };
        new.fit(shared, params);
        new
    }

    /// Remembers from now on what a lane with parameters `params` needs.
    pub fn fit(&mut self, shared: &Shared, params: &LaneParams) {
        let steps = loop_memory_steps(params, shared.config.dt_s);
        self.wanted.set_steps(0, steps);
    }
}

/// Joint loads of one lane, and what they did within the current control period.
pub(super) struct Drive {
    features: DriveFeatures,
    loss: CommandLoss,
    step: Step<f32>,
    supply: Supply<f32>,
    /// `[A]`
    servos: Vec<ServoDrive<f32>>,
    /// `[J]`
    passive: Vec<JointPassive<f32>>,
    /// What arrives at each servo in the current control period. `[A]`
    scheduled: Vec<Scheduled<f32>>,
    /// Start of the current physics step. `[J]`
    started: Vec<Started>,
    /// ∫τ dt per motor, N·m·s. `[A]`
    torque_sum: Vec<f64>,
    /// Work per motor, J. `[A]`
    work_sum: Vec<f64>,
    /// Contacts so far.
    pub contacts: ContactImpulses,
}

/// A joint at the start of a physics step, and the drive it gets.
#[derive(Clone, Copy, Default)]
struct Started {
    at: JointState,
    driven: Option<Driven<f32>>,
}

impl Drive {
    /// `servos`: one per actuated joint of this lane.
    pub fn new(shared: &Shared, params: &LaneParams, servos: &[ServoDrive<f64>]) -> Self {
        let model = &*shared.model;
        let dt_s = shared.config.dt_s;
        Self {
            features: servos
                .iter()
                .map(DriveFeatures::of)
                .fold(DriveFeatures::default(), DriveFeatures::or),
            loss: params.command_loss,
            step: Step::new(dt_s),
            supply: PerLane::splat(&Supply::new(params, dt_s)),
            servos: servos.iter().map(PerLane::splat).collect(),
            passive: JointPassive::all(model, params)
                .iter()
                .map(PerLane::splat)
                .collect(),
            scheduled: Vec::new(),
            started: vec![Started::default(); model.joints().len()],
            torque_sum: Vec::new(),
            work_sum: Vec::new(),
            contacts: ContactImpulses::default(),
        }
    }

    /// Starts a control period with new commands.
    pub fn begin(&mut self, shared: &Shared, memory: &mut DriveMemory, targets_rad: &[f32]) {
        let lost = memory.loss.next(&self.loss);
        memory.history.push(targets_rad, lost);
        let period_s = shared.config.control_period_s();
        self.scheduled.clear();
        self.scheduled.extend(
            (self.servos.iter().enumerate())
                .map(|(a, servo)| memory.history.schedule(a, servo.delay_s, period_s)),
        );
        for sum in [&mut self.torque_sum, &mut self.work_sum] {
            sum.clear();
            sum.resize(self.servos.len(), 0.0);
        }
        self.contacts.clear(shared.model.feet().len());
    }

    /// Loads every joint for the physics step that starts `since_command_s` into the control period.
    pub fn load(
        &mut self,
        shared: &Shared,
        robot: &mut Robot,
        memory: &mut DriveMemory,
        since_command_s: f64,
    ) {
        let bus = Bus::at(memory.bus_v);
        let mut current_a = 0.0;
        memory.wanted.begin_step();
        for (j, model_joint) in shared.model.joints().iter().enumerate() {
            let Some(at) = robot.joint(j) else { continue };
            let hinge = &self.passive[j];
            let stop = StopAt {
                law: &shared.stops[j],
                free_radps2: memory.free_radps2[j],
            };
            let (torque, driven) = match model_joint.kind {
                JointKind::Actuated { index } => {
                    let command = self.scheduled[index].over_step(
                        since_command_s as f32,
                        self.step.dt_s,
                        self.step.per_dt,
                    );
                    let driven = step::start(
                        self.features,
                        &self.servos[index],
                        hinge,
                        &mut memory.servos[index],
                        memory.wanted.joint(index),
                        &self.step,
                        &bus,
                        command,
                        at.pos,
                        at.vel,
                        stop,
                    );
                    current_a += driven.current_a;
                    (driven.torque, Some(driven))
                }
                JointKind::Passive | JointKind::Backlash => (
                    step::hinge_torque(
                        hinge,
                        &self.step,
                        memory.bristle_rad[j],
                        at.pos,
                        at.vel,
                        stop,
                    ),
                    None,
                ),
            };
            robot.load_joint(j, &torque);
            self.started[j] = Started { at, driven };
        }
        memory.wanted.end_step();
        memory.bus_v = supply::settle_v(&self.supply, memory.bus_v, current_a);
    }

    /// After the step: takes it into memory, sums motor torque, work and contacts.
    pub fn account(&mut self, shared: &Shared, robot: &Robot, memory: &mut DriveMemory) {
        for (j, model_joint) in shared.model.joints().iter().enumerate() {
            let Some(now) = robot.joint(j) else { continue };
            let Started { at, driven } = self.started[j];
            let hinge = &self.passive[j];
            let moved = now.pos - at.pos;
            let stop = StopAt {
                law: &shared.stops[j],
                free_radps2: memory.free_radps2[j],
            };
            let acceleration = (now.vel - at.vel) * self.step.per_dt;
            memory.free_radps2[j] =
                passive::free_radps2(hinge, stop, at.pos, at.vel, moved, now.vel, acceleration);
            let (JointKind::Actuated { index }, Some(driven)) = (model_joint.kind, driven) else {
                memory.bristle_rad[j] =
                    friction::drag_bristle(memory.bristle_rad[j], moved, hinge.presliding_rad);
                continue;
            };
            let motor_radps = step::finish(
                self.features,
                &self.servos[index],
                hinge,
                &mut memory.servos[index],
                &self.step,
                &driven,
                moved,
                at.vel,
                now.vel,
            );
            let impulse = f64::from(driven.motor_nm) * shared.config.dt_s;
            self.torque_sum[index] += impulse;
            // Mean speed, not way moved: an Euler step moves by its final speed, which would add τ²·dt²/2I.
            self.work_sum[index] += impulse * 0.5 * f64::from(driven.motor_radps + motor_radps);
        }
        self.contacts.add(&robot.world, robot.slides());
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
