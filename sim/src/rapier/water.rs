//! Water on the links of one lane.
//!
//! Rapier takes forces on bodies as they are at the start of a step. Drag therefore is explicit, and limited
//! to what stops the link alone in one step (it is far below that at walking and swimming speeds). Added mass
//! goes into the bodies: the mean of the largest and the smallest of its three axes into the mass (its weight
//! taken off again), what the axes differ as a force by the last step's acceleration, added inertia into the
//! inertia. That force lags by a step and a half, which damps a motion of frequency ω by about (M_i −
//! M̄)·1.5·dt·ω² too much (0.4 N·s/m for a buoy of 2.8 kg that carries as much only along the vertical, at 4
//! ms).

use serde::{Deserialize, Serialize};

use super::convert;
use super::robot::Robot;
use super::shared::Shared;
use crate::LaneParams;
use crate::batch::vec3::sub;
use crate::observe::LinkMass;
use crate::per_lane::PerLane;
use crate::water::{self, LinkForces, LinkMotion, Surface, WaterLink, cross, into_world};

/// A change of added mass by less than this share of a link's mass is not worth telling Rapier.
const ADDED_STEP: f32 = 0.002;

/// What the water of one lane remembers: nothing without added mass.
#[derive(Clone, Default, Serialize, Deserialize)]
pub(super) struct WaterMemory {
    /// Velocity of each link's centre of mass at the start of the last step, world, m/s. `[L]`
    vel_mps: Vec<[f32; 3]>,
    /// Share of its added mass that each link's body holds. `[L]`
    held: Vec<f32>,
}

/// Water around one lane's robot.
pub(super) struct Water {
    links: Vec<WaterLink<f32>>,
    surface: Surface<f32>,
    masses: Vec<LinkMass>,
    has_added_mass: bool,
    dt_s: f32,
}

impl Water {
    /// `None` on dry ground, and for a robot whose file knows no water.
    pub fn new(shared: &Shared, params: &LaneParams, masses: &[LinkMass]) -> Option<Self> {
        let level = shared.rig.terrain.water_level_m?;
        let links = WaterLink::all(&shared.rig.model, params)?;
        let wet = |l: &WaterLink<f64>| {
            (l.added_mass_kg.iter().chain(&l.added_inertia_kgm2)).any(|&a| a > 0.0)
        };
        Some(Self {
            has_added_mass: links.iter().any(wet),
            links: links.iter().map(PerLane::splat).collect(),
            surface: Surface {
                level_m: level + params.water_level_offset_m,
                current_mps: params.water_current_mps,
                gravity_mps2: params.gravity_mps2,
            },
            masses: masses.to_vec(),
            dt_s: shared.rig.config.dt_s as f32,
        })
    }

    /// Loads every link for the coming step.
    pub fn load(&self, robot: &mut Robot, memory: &mut WaterMemory) {
        let before = std::mem::take(&mut memory.vel_mps);
        for (l, link) in self.links.iter().enumerate() {
            let Some(at) = robot.link_motion(l, link.com_m) else { continue };
            let mass = &self.masses[l];
            let mut f = water::forces(link, &at, &self.surface);
            self.limit_drag(&mut f, &at, mass);
            if self.has_added_mass {
                let last = before.get(l).copied().unwrap_or(at.com_vel_mps);
                self.carry(robot, memory, l, &at, last, &mut f);
                memory.vel_mps.push(at.com_vel_mps);
            }
            let [fx, fy, fz] = f.force_n;
            let [tx, ty, tz] = f.torque_nm;
            robot.push_link(l, &[fx, fy, fz, tx, ty, tz]);
        }
    }

    /// Takes off the part of the drag that would turn the link round within the step.
    fn limit_drag(&self, f: &mut LinkForces<f32>, at: &LinkMotion<f32>, mass: &LinkMass) {
        let most = mass.mass_kg as f32 / self.dt_s;
        let too_much = f.damping_ns_per_m.map(|d| (d - most).max(0.0));
        let too_much_turn = [0, 1, 2].map(|i| {
            (f.damping_nms_per_rad[i] - mass.inertia_kgm2[(i, i)] as f32 / self.dt_s).max(0.0)
        });
        if too_much.iter().chain(&too_much_turn).all(|&d| d <= 0.0) {
            return;
        }
        let through = sub(at.com_vel_mps, self.surface.current_mps);
        let v = into_link(at, through);
        let w = into_link(at, at.angvel_radps);
        let back = into_world(&at.rotation, [0, 1, 2].map(|i| too_much[i] * v[i]));
        let turn_back = into_world(&at.rotation, [0, 1, 2].map(|i| too_much_turn[i] * w[i]));
        for i in 0..3 {
            f.force_n[i] += back[i];
            f.torque_nm[i] += turn_back[i];
        }
    }

    /// Gives link `l` the inertia of the water it carries, and what Rapier cannot know of it as a force.
    fn carry(
        &self,
        robot: &mut Robot,
        memory: &mut WaterMemory,
        l: usize,
        at: &LinkMotion<f32>,
        last_vel_mps: [f32; 3],
        f: &mut LinkForces<f32>,
    ) {
        let mass = &self.masses[l];
        memory.held.resize(self.links.len(), 0.0);
        let full = self.links[l].added_mass_kg;
        let middle = 0.5
            * (full.iter().copied().fold(f32::MAX, f32::min)
                + full.iter().copied().fold(0.0, f32::max));
        let step = (f.immersed - memory.held[l]).abs();
        if step * middle > ADDED_STEP * mass.mass_kg as f32 || (step > 0.0 && middle == 0.0) {
            memory.held[l] = f.immersed;
            let mut inertia = mass.inertia_kgm2;
            for i in 0..3 {
                inertia[(i, i)] += f64::from(f.added_inertia_kgm2[i]);
            }
            let carried = f64::from(f.immersed * middle);
            robot.set_mass(l, convert::mass_properties(mass.mass_kg + carried, &inertia));
        }
        let held = memory.held[l];
        let in_body = held * middle;
        let acc =
            into_link(at, [0, 1, 2].map(|i| (at.com_vel_mps[i] - last_vel_mps[i]) / self.dt_s));
        let v = into_link(at, at.com_vel_mps);
        let w = into_link(at, at.angvel_radps);
        // −M_a·(a − ω × v), of which the body's own mass does −in_body·a
        let turning = cross(w, v);
        let rest = [0, 1, 2].map(|i| in_body * acc[i] - f.added_mass_kg[i] * (acc[i] - turning[i]));
        // Rapier knows the gyroscopic torque of what is in its inertia.
        let spin = [0, 1, 2].map(|i| held * self.links[l].added_inertia_kgm2[i] * w[i]);
        let force = into_world(&at.rotation, rest);
        let torque = into_world(&at.rotation, cross(w, spin));
        for i in 0..3 {
            f.force_n[i] += force[i] - in_body * self.surface.gravity_mps2[i];
            f.torque_nm[i] += torque[i];
        }
    }
}

fn into_link(at: &LinkMotion<f32>, v: [f32; 3]) -> [f32; 3] {
    [0, 1, 2].map(|i| (0..3).map(|r| at.rotation[r][i] * v[r]).sum())
}
