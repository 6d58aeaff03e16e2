//! One lane: one robot, its parameters, what it remembers, what it reports.

use serde::{Deserialize, Serialize};

use super::contacts::ContactImpulses;
use super::friction::Owed;
use super::robot::Robot;
use super::shared::Shared;
use super::water::{Water, WaterMemory};
use crate::drive::ServoDrive;
use crate::drive::lane::{DriveMemory, LaneDrive};
use crate::observe::{Coordinates, Observer};
use crate::{InitialState, LaneParams, SimError, State};

/// Everything of a lane that changes while it runs, besides the Rapier world.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct Memory {
    /// Commands under way, friction, gears, supply.
    drive: DriveMemory,
    water: WaterMemory,
    owed_friction: Owed,
    /// Velocity of the IMU point at the end of the last period, world, m/s.
    imu_vel_mps: [f64; 3],
    /// What was last reported.
    pub out: State,
}

/// One lane.
pub(super) struct Lane {
    pub params: LaneParams,
    pub memory: Memory,
    pub robot: Robot,
    drive: LaneDrive,
    /// In the current control period.
    contacts: ContactImpulses,
    water: Option<Water>,
    seen: Observer,
}

impl Lane {
    /// A lane in `init`.
    pub fn new(shared: &Shared, params: LaneParams, init: &InitialState) -> Result<Self, SimError> {
        let at = Coordinates::start(&shared.rig, init)?;
        let memory = DriveMemory::new(&shared.rig.model, &shared.rig.config, &params, init);
        Self::at(shared, params, at, memory)
    }

    /// A lane at rest inside (no contact or friction memory) with the given coordinates.
    fn at(
        shared: &Shared,
        params: LaneParams,
        at: Coordinates,
        drive_memory: DriveMemory,
    ) -> Result<Self, SimError> {
        let model = &*shared.rig.model;
        let seen = Observer::new(model, &params, at);
        let servos = ServoDrive::all(model, &params, shared.rig.config.dt_s);
        let mut lane = Self {
            memory: Memory {
                drive: drive_memory,
                water: WaterMemory::default(),
                owed_friction: Owed::default(),
                imu_vel_mps: [0.0; 3],
                out: State::of(model, 1),
            },
            robot: Robot::new(shared, &params, &servos, &seen.masses)?,
            drive: LaneDrive::new(model, &shared.rig.config, &params, &servos, &shared.stops),
            contacts: ContactImpulses::default(),
            water: Water::new(shared, &params, &seen.masses),
            params,
            seen,
        };
        lane.robot.place(&lane.seen.at);
        lane.report(shared, None)?;
        Ok(lane)
    }

    /// Takes over other parameters where the robot is: positions, velocities, commands under way and friction
    /// bristles stay, contact memory does not.
    pub fn rebuild(&mut self, shared: &Shared, params: LaneParams) -> Result<(), SimError> {
        let memory = self.memory.clone();
        let mut lane = if memory.out.diverged[0] {
            Self::new(shared, params, &InitialState::nominal(&shared.rig.model))? // it only waits for its reset
        } else {
            self.robot.read(&mut self.seen.at);
            Self::at(shared, params, self.seen.at.clone(), memory.drive.clone())?
        };
        lane.memory = Memory {
            imu_vel_mps: lane.memory.imu_vel_mps,
            water: WaterMemory::default(), // the new bodies carry none yet
            owed_friction: Owed::default(),
            ..memory
        };
        lane.memory.drive.fit(&shared.rig.config, &lane.params);
        *self = lane;
        Ok(())
    }

    /// One control period. A lane that breaks down keeps the state it last reported and stops.
    pub fn step(&mut self, shared: &Shared, targets_rad: &[f32], wrench: &[f32]) {
        if self.memory.out.diverged[0] {
            return;
        }
        let before = self.memory.out.clone();
        let finite = targets_rad.iter().chain(wrench).all(|v| v.is_finite());
        if !finite || !self.run_period(shared, targets_rad, wrench) {
            self.memory.out = before;
            self.memory.out.diverged[0] = true;
        }
    }

    /// Runs and reports one period; whether it ended in a sound state.
    fn run_period(&mut self, shared: &Shared, targets_rad: &[f32], wrench: &[f32]) -> bool {
        let (model, config, stops) = (&*shared.rig.model, &shared.rig.config, &shared.stops);
        let memory = &mut self.memory;
        self.drive.begin(&mut memory.drive, targets_rad);
        self.contacts.clear(model.feet().len());
        for substep in 0..config.substeps {
            let since_s = f64::from(substep) * config.dt_s;
            self.robot.clear_loads();
            let (drive, robot) = (&mut self.drive, &mut self.robot);
            robot.push_link(model.torso_link(), wrench);
            drive.load(model, stops, robot, &mut memory.drive, since_s);
            if let Some(water) = &self.water {
                water.load(robot, &mut memory.water);
            }
            robot.step(&shared.grip, &mut memory.owed_friction);
            drive.account(model, stops, robot, &mut memory.drive);
            self.contacts.add(&robot.world, robot.slides());
            if !self.robot.is_sound(config) {
                return false;
            }
        }
        self.robot.read(&mut self.seen.at);
        if self.report(shared, Some(self.memory.imu_vel_mps)).is_err() {
            return false;
        }
        let memory = &mut self.memory;
        self.drive.write(&memory.drive, model, &mut memory.out);
        self.contacts.write(&mut self.memory.out, config.control_period_s());
        self.memory.out.is_finite()
    }

    /// Writes what is seen of the robot where it is, as [`Observer::report`].
    fn report(&mut self, shared: &Shared, before_mps: Option<[f64; 3]>) -> Result<(), SimError> {
        let (out, gravity) = (&mut self.memory.out, self.params.gravity_mps2);
        self.memory.imu_vel_mps = self.seen.report(out, &shared.rig, gravity, before_mps)?;
        Ok(())
    }
}
