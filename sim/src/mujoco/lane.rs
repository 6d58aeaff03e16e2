//! One lane: its parameters, what it remembers, what it reports.

use super::mjcf;
use super::process::{Process, Request};
use super::robot::Robot;
use super::shared::{Shared, cannot};
use crate::drive::lane::{DriveMemory, LaneDrive};
use crate::drive::{DriveFeatures, ServoDrive};
use crate::observe::{Coordinates, Motion, Observer};
use crate::water::{self, LinkMotion, Surface, WaterLink};
use crate::{InitialState, LaneParams, SimError, State};

/// Everything of a lane that changes while it runs.
#[derive(Clone)]
pub(super) struct Memory {
    drive: DriveMemory,
    pub robot: Robot,
    /// Where a held base is; else of no use.
    held: ([f64; 3], [f64; 4]),
    /// Velocity of the IMU point at the end of the last period, world, m/s.
    imu_vel_mps: [f64; 3],
    /// What was last reported.
    pub out: State,
}

/// One lane.
pub(super) struct Lane {
    pub params: LaneParams,
    pub memory: Memory,
    drive: LaneDrive,
    water: Option<Water>,
    seen: Observer,
    /// ∫F dt of contacts in the current period, N·s.
    contacts_ns: Vec<f64>,
    /// What was pushed on the torso in the current period, world, N and N·m.
    wrench: [f64; 6],
}

/// Water around one lane's robot.
struct Water {
    links: Vec<WaterLink<f64>>,
    surface: Surface<f64>,
}

impl Lane {
    /// A lane in `init`; MuJoCo's lane `number` becomes it.
    pub fn new(
        shared: &Shared,
        process: &mut Process,
        number: usize,
        params: LaneParams,
        init: &InitialState,
    ) -> Result<Self, SimError> {
        let (model, config) = (&*shared.rig.model, &shared.rig.config);
        let at = Coordinates::start(&shared.rig, init)?;
        let mut robot = Robot::new(model, config);
        robot.place(&at);
        let memory = Memory {
            drive: DriveMemory::new(model, config, &params, init),
            robot,
            held: (at.world_from_base.pos_m, at.world_from_base.quat_wxyz),
            imu_vel_mps: [0.0; 3],
            out: State::of(model, 1),
        };
        let mut lane = Self::from_memory(shared, process, number, params, memory)?;
        lane.report(shared, None)?;
        Ok(lane)
    }

    /// A lane that goes on from `memory`.
    pub fn from_memory(
        shared: &Shared,
        process: &mut Process,
        number: usize,
        params: LaneParams,
        mut memory: Memory,
    ) -> Result<Self, SimError> {
        let (model, config) = (&*shared.rig.model, &shared.rig.config);
        memory.drive.fit(config, &params);
        let nominal = InitialState::nominal(model);
        let mut at = Coordinates::start(&shared.rig, &nominal)?;
        (at.world_from_base.pos_m, at.world_from_base.quat_wxyz) = memory.held;
        memory.robot.read(&mut at);
        let seen = Observer::new(model, &params, at);
        let servos = ServoDrive::all(model, &params, config.dt_s);
        let drive = LaneDrive::new(model, config, &params, &servos, &shared.stops);
        let water = Water::new(shared, &params);
        check(drive.features, water.as_ref())?;
        let mjcf = mjcf::Robot {
            model,
            config,
            params: &params,
            masses: &seen.masses,
            servos: &servos,
            world_from_base: &seen.at.world_from_base,
        };
        let mut request = Request::new(b'M');
        request.u32(number);
        request.text(&mjcf.mjcf());
        process.ask(&request)?;
        let mut request = Request::new(b'P');
        request.u32(number);
        request.numbers(memory.robot.state());
        process.ask(&request)?;
        Ok(Self {
            contacts_ns: vec![0.0; memory.robot.contact_len()],
            params,
            memory,
            drive,
            water,
            seen,
            wrench: [0.0; 6],
        })
    }

    /// Starts a control period.
    pub fn begin(&mut self, targets_rad: &[f32], wrench: &[f32]) {
        if !targets_rad.iter().chain(wrench).all(|v| v.is_finite()) {
            self.memory.out.diverged[0] = true;
        }
        if self.stands_still() {
            return;
        }
        for (own, given) in self.wrench.iter_mut().zip(wrench) {
            *own = f64::from(*given);
        }
        self.contacts_ns.fill(0.0);
        self.drive.begin(&mut self.memory.drive, targets_rad);
    }

    /// Whether the lane has broken down and waits for its reset.
    pub fn stands_still(&self) -> bool {
        self.memory.out.diverged[0]
    }

    /// Loads joints and links for the step that starts `since_s` into the period.
    pub fn load(&mut self, shared: &Shared, since_s: f64) -> Result<(), SimError> {
        if self.stands_still() {
            return Ok(());
        }
        let model = &*shared.rig.model;
        let Memory { drive, robot, .. } = &mut self.memory;
        robot.clear_loads();
        robot.push_link(model.torso_link(), self.wrench);
        self.drive.load(model, &shared.stops, robot, drive, since_s);
        if let Some(water) = &self.water {
            robot.read(&mut self.seen.at);
            self.seen.follow(model)?;
            for (l, link) in water.links.iter().enumerate() {
                let at = link_motion(&self.seen.motion, l, self.seen.masses[l].com_m);
                let f = water::forces(link, &at, &water.surface);
                let ([fx, fy, fz], [tx, ty, tz]) = (f.force_n, f.torque_nm);
                robot.push_link(l, [fx, fy, fz, tx, ty, tz]);
            }
        }
        Ok(())
    }

    /// Takes the step just taken into account. A lane that broke down keeps what it last reported.
    pub fn account(&mut self, shared: &Shared) {
        if self.stands_still() {
            return;
        }
        let Memory { drive, robot, .. } = &mut self.memory;
        if !robot.is_sound(&shared.rig.config) {
            self.memory.out.diverged[0] = true;
            return;
        }
        self.drive.account(&shared.rig.model, &shared.stops, robot, drive);
        robot.add_contacts(&mut self.contacts_ns);
    }

    /// Reports the period.
    pub fn end(&mut self, shared: &Shared) -> Result<(), SimError> {
        if self.stands_still() {
            return Ok(());
        }
        let before = self.memory.out.clone();
        self.memory.robot.read(&mut self.seen.at);
        self.report(shared, Some(self.memory.imu_vel_mps))?;
        let Memory { drive, out, .. } = &mut self.memory;
        self.drive.write(drive, &shared.rig.model, out);
        let mean = |sum: f64| (sum / f64::from(shared.rig.config.substeps)) as f32;
        let (parts, _) = self.contacts_ns.as_chunks::<4>();
        let (feet, body) = parts.split_at(shared.rig.model.feet().len());
        for (slot, foot) in out.foot_force_n.chunks_exact_mut(3).zip(feet) {
            slot.copy_from_slice(&[mean(foot[0]), mean(foot[1]), mean(foot[2])]);
        }
        out.trunk_force_n[0] = mean(body[0][3]);
        out.tail_force_n[0] = mean(body[1][3]);
        if !self.memory.out.is_finite() {
            self.memory.out = before;
            self.memory.out.diverged[0] = true;
        }
        Ok(())
    }

    /// Writes what is seen of the robot where it is, as [`Observer::report`].
    fn report(&mut self, shared: &Shared, before_mps: Option<[f64; 3]>) -> Result<(), SimError> {
        let (out, gravity) = (&mut self.memory.out, self.params.gravity_mps2);
        self.memory.imu_vel_mps = self.seen.report(out, &shared.rig, gravity, before_mps)?;
        Ok(())
    }
}

impl Water {
    /// `None` on dry ground, and for a robot whose file knows no water.
    fn new(shared: &Shared, params: &LaneParams) -> Option<Self> {
        let level = shared.rig.terrain.water_level_m?;
        Some(Self {
            links: WaterLink::all(&shared.rig.model, params)?,
            surface: Surface {
                level_m: f64::from(level + params.water_level_offset_m),
                current_mps: params.water_current_mps.map(f64::from),
                gravity_mps2: params.gravity_mps2.map(f64::from),
            },
        })
    }
}

fn link_motion(motion: &Motion, link: usize, com_m: [f64; 3]) -> LinkMotion<f64> {
    let pose = &motion.places.links[link];
    LinkMotion {
        rotation: pose.rotation(),
        origin_z_m: pose.pos_m[2],
        com_vel_mps: motion.point(link, com_m).1,
        angvel_radps: motion.angvel_radps[link],
    }
}

/// Refuses what MuJoCo's friction, joints and bodies have no place for.
fn check(f: DriveFeatures, water: Option<&Water>) -> Result<(), SimError> {
    let added = |l: &WaterLink<f64>| {
        (l.added_mass_kg.iter().chain(&l.added_inertia_kgm2)).any(|&a| a > 0.0)
    };
    let beyond = [
        (f.gear, "play or compliance in gears"),
        (f.stribeck, "Stribeck friction"),
        (f.load_friction, "friction that grows with the load"),
        (f.asymmetry, "friction that depends on the direction"),
        (f.ripple, "torque ripple"),
        (water.is_some_and(|w| w.links.iter().any(added)), "added mass of water"),
    ];
    match beyond.iter().find(|(has, _)| *has) {
        Some((_, what)) => Err(cannot(what)),
        None => Ok(()),
    }
}
