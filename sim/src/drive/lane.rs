//! What loads the joints of one lane, for engines that step lane by lane: drive-lines, springs, friction, stops.

use caudata_model::{JointKind, RobotModel};
use serde::{Deserialize, Serialize};

use crate::drive::command::Scheduled;
use crate::drive::loss::LossMemory;
use crate::drive::passive::{self, StopAt};
use crate::drive::step::{self, Driven, Step};
use crate::drive::supply::{self, Supply};
use crate::drive::{
    CommandHistory, DriveFeatures, ImplicitTorque, JointMemory, JointPassive, ServoDrive,
    WantedTorques, friction, loop_memory_steps,
};
use crate::per_lane::PerLane;
use crate::stop::Stop;
use crate::{CommandLoss, EngineConfig, InitialState, LaneParams, State};

/// A hinge's position and velocity, rad and rad/s (a slide's in m and m/s).
#[derive(Clone, Copy, Default)]
pub(crate) struct JointState {
    pub pos: f32,
    pub vel: f32,
}

/// The joints of one robot, as an engine holds them.
pub(crate) trait Joints {
    /// State of joint `j` (model order); `None` where it is locked.
    fn joint(&self, j: usize) -> Option<JointState>;

    /// Loads joint `j` for the coming step (N·m, or N of a slide). `torque` is everything that acts on it;
    /// `motor_nm` the servo's part, for an engine that has friction, springs and stops of its own.
    fn load_joint(&mut self, j: usize, torque: &ImplicitTorque<f32>, motor_nm: f32);
}

/// What the drive-lines of one lane remember.
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct DriveMemory {
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
    pub fn new(
        model: &RobotModel,
        config: &EngineConfig,
        params: &LaneParams,
        init: &InitialState,
    ) -> Self {
        let moving = init.joint_pos_rad.iter().zip(&init.joint_vel_radps);
        let mut new = Self {
            history: CommandHistory::new(config.control_period_s(), &init.joint_pos_rad),
            loss: LossMemory::default(),
            servos: moving
                .map(|(&q, &qd)| PerLane::splat(&JointMemory::rest(f64::from(q), f64::from(qd))))
                .collect(),
            wanted: WantedTorques::new(model.actuated().len()),
            bristle_rad: vec![0.0; model.joints().len()],
            free_radps2: vec![0.0; model.joints().len()],
            bus_v: params.supply_v,
        };
        new.fit(config, params);
        new
    }

    /// Remembers from now on what a lane with parameters `params` needs.
    pub fn fit(&mut self, config: &EngineConfig, params: &LaneParams) {
        let steps = loop_memory_steps(params, config.dt_s);
        self.wanted.set_steps(0, steps);
    }
}

/// Joint loads of one lane, and what they did within the current control period.
pub(crate) struct LaneDrive {
    /// Stages that some servo of the lane needs.
    pub features: DriveFeatures,
    dt_s: f64,
    period_s: f64,
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
}

/// A joint at the start of a physics step, and the drive it gets.
#[derive(Clone, Copy, Default)]
struct Started {
    at: JointState,
    driven: Option<Driven<f32>>,
}

impl LaneDrive {
    /// `servos`: one per actuated joint of this lane; `stops`: one per joint, model order.
    pub fn new(
        model: &RobotModel,
        config: &EngineConfig,
        params: &LaneParams,
        servos: &[ServoDrive<f64>],
        stops: &[Stop],
    ) -> Self {
        let dt_s = config.dt_s;
        Self {
            dt_s,
            period_s: config.control_period_s(),
            features: servos
                .iter()
                .map(DriveFeatures::of)
                .fold(DriveFeatures::default(), DriveFeatures::or),
            loss: params.command_loss,
            step: Step::new(dt_s, false),
            supply: PerLane::splat(&Supply::new(params, dt_s)),
            servos: servos.iter().map(PerLane::splat).collect(),
            passive: (JointPassive::all(model, params).iter())
                .zip(model.joints().iter().zip(stops))
                .map(|(own, (joint, stop))| own.stepped(joint, stop, servos, dt_s))
                .map(|own| PerLane::splat(&own))
                .collect(),
            scheduled: Vec::new(),
            started: vec![Started::default(); model.joints().len()],
            torque_sum: Vec::new(),
            work_sum: Vec::new(),
        }
    }

    /// Starts a control period with new commands.
    pub fn begin(&mut self, memory: &mut DriveMemory, targets_rad: &[f32]) {
        let lost = memory.loss.next(&self.loss);
        memory.history.push(targets_rad, lost);
        let period_s = self.period_s;
        self.scheduled.clear();
        self.scheduled.extend(
            (self.servos.iter().enumerate())
                .map(|(a, servo)| memory.history.schedule(a, servo.delay_s, period_s)),
        );
        for sum in [&mut self.torque_sum, &mut self.work_sum] {
            sum.clear();
            sum.resize(self.servos.len(), 0.0);
        }
    }

    /// Loads every joint for the physics step that starts `since_command_s` into the control period.
    pub fn load(
        &mut self,
        model: &RobotModel,
        stops: &[Stop],
        robot: &mut dyn Joints,
        memory: &mut DriveMemory,
        since_command_s: f64,
    ) {
        let bus_v = memory.bus_v;
        let mut drawn_a = 0.0;
        let sags = self.supply.sags();
        memory.wanted.begin_step();
        for (j, model_joint) in model.joints().iter().enumerate() {
            let Some(at) = robot.joint(j) else { continue };
            let hinge = &self.passive[j];
            let stop = StopAt { law: &stops[j], free_radps2: memory.free_radps2[j] };
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
                        bus_v,
                        command,
                        at.pos,
                        at.vel,
                        0.0,
                        stop,
                    );
                    if sags {
                        drawn_a +=
                            driven.drawn_a(&self.servos[index], &memory.servos[index], bus_v);
                    }
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
            robot.load_joint(j, &torque, driven.map_or(0.0, |d| d.motor_nm));
            self.started[j] = Started { at, driven };
        }
        memory.wanted.end_step();
        memory.bus_v = supply::settle_v(&self.supply, memory.bus_v, drawn_a);
    }

    /// After the step: takes it into memory, sums motor torque and work.
    pub fn account(
        &mut self,
        model: &RobotModel,
        stops: &[Stop],
        robot: &dyn Joints,
        memory: &mut DriveMemory,
    ) {
        for (j, model_joint) in model.joints().iter().enumerate() {
            let Some(now) = robot.joint(j) else { continue };
            let Started { at, driven } = self.started[j];
            let hinge = &self.passive[j];
            let moved = now.pos - at.pos;
            let stop = StopAt { law: &stops[j], free_radps2: memory.free_radps2[j] };
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
            let impulse = f64::from(driven.motor_nm) * self.dt_s;
            self.torque_sum[index] += impulse;
            // Mean speed, not way moved: an Euler step moves by its final speed, which would add τ²·dt²/2I.
            self.work_sum[index] += impulse * 0.5 * f64::from(driven.motor_radps + motor_radps);
        }
    }

    /// Writes the means over the period, and how far encoders are ahead.
    pub fn write(&self, memory: &DriveMemory, model: &RobotModel, out: &mut State) {
        let mean = |to: &mut [f32], from: &[f64]| {
            for (slot, sum) in to.iter_mut().zip(from) {
                *slot = (sum / self.period_s) as f32;
            }
        };
        mean(&mut out.motor_torque_nm, &self.torque_sum);
        mean(&mut out.mech_power_w, &self.work_sum);
        for (a, &j) in model.actuated().iter().enumerate() {
            (out.encoder_ahead_rad[a], out.encoder_ahead_radps[a]) =
                memory.servos[a].encoder_ahead(&self.servos[a], out.joint_vel_radps[j]);
        }
    }
}
