//! Accelerations of the robot in the air, without contact, springs, friction or servos: what other dynamics
//! codes can be compared with.

use caudata_model::{Pose, RobotModel};

use super::aba::{self, Hinge, Load};
use super::contact_law::ContactLaw;
use super::frame::Frame;
use super::ground::Ground;
use super::group::{Group, Layout, layout};
use super::kinematics::{self, Push, World};
use super::program::Program;
use super::vec3::{Inertia, V3, add_cross, zero3};
use crate::config::Precision;
use crate::simd::{Kernel, Lanes, Width};
use crate::{EngineConfig, LaneParams, SimError, Terrain};

/// A robot in motion, and the torques on its joints.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// World from base link (for a fixed base: how far the whole robot is shifted).
    pub world_from_base: Pose,
    /// Velocity of the base link's origin, world, m/s. Ignored for a base that does not move.
    pub base_vel_mps: [f64; 3],
    /// Angular velocity of the base link, world, rad/s. Likewise.
    pub base_angvel_radps: [f64; 3],
    /// Model order, rad. `[J]`
    pub joint_pos_rad: Vec<f64>,
    /// Model order, rad/s. `[J]`
    pub joint_vel_radps: Vec<f64>,
    /// Model order, N·m. `[J]`
    pub joint_torque_nm: Vec<f64>,
}

/// What it accelerates with.
#[derive(Debug, Clone, PartialEq)]
pub struct Accelerations {
    /// Acceleration of the base link's origin, world, m/s².
    pub base_mps2: [f64; 3],
    /// World, rad/s².
    pub base_radps2: [f64; 3],
    /// Model order; 0 for locked joints, rad/s². `[J]`
    pub joint_radps2: Vec<f64>,
}

/// Accelerations at `at`, with gravity, masses and rotor inertias of `params`, in the numbers that
/// `config.precision` names; `config` also says whether the base is held and the play locked.
///
/// # Errors
/// When the model cannot be simulated or an array has the wrong length.
pub fn accelerations(
    model: &RobotModel,
    config: &EngineConfig,
    params: &LaneParams,
    at: &Motion,
) -> Result<Accelerations, SimError> {
    params.validate(model, 0)?;
    for (what, values) in [
        ("joint_pos_rad", &at.joint_pos_rad),
        ("joint_vel_radps", &at.joint_vel_radps),
        ("joint_torque_nm", &at.joint_torque_nm),
    ] {
        if values.len() != model.joints().len() {
            return Err(SimError::Shape {
                what,
                got: values.len(),
                expected: model.joints().len(),
            });
        }
    }
    if config.precision == Precision::Double {
        return solve::<f64>(model, config, params, at);
    }
    match Width::best() {
        #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
        Width::Four => solve::<crate::simd::F32x4>(model, config, params, at),
        #[cfg(target_arch = "x86_64")]
        Width::Eight => solve::<crate::simd::F32x8>(model, config, params, at),
        #[cfg(target_arch = "x86_64")]
        Width::Sixteen => solve::<crate::simd::F32x16>(model, config, params, at),
        _ => solve::<f32>(model, config, params, at),
    }
}

fn solve<R: Lanes>(
    model: &RobotModel,
    config: &EngineConfig,
    params: &LaneParams,
    at: &Motion,
) -> Result<Accelerations, SimError> {
    let mut program = Program::<R>::new(model, config, false)?;
    program.points.clear();
    program.pairs.clear();
    program.core_pairs.clear();
    program.points_of.fill(0..0);
    let mut group = Group::new(&program, config.control_period_s());
    for lane in 0..R::LANES {
        group.set_params(lane, &program, model, config, 0.0, params);
    }
    let lay = layout(&program);
    let put = |x: &mut [R], from: usize, values: &[f64]| {
        for (slot, value) in x[from..].iter_mut().zip(values) {
            *slot = R::splat(*value);
        }
    };
    put(&mut group.x, Layout::POS, &at.world_from_base.pos_m);
    put(&mut group.x, Layout::QUAT, &at.world_from_base.quat_wxyz);
    put(&mut group.x, Layout::VEL, &at.base_vel_mps);
    put(&mut group.x, Layout::ANG, &at.base_angvel_radps);
    let mut torques = Vec::new();
    for (i, node) in program.nodes.iter().enumerate() {
        let j = node.joint;
        put(&mut group.x, lay.q() + i, &[at.joint_pos_rad[j]]);
        put(&mut group.x, lay.qd() + i, &[at.joint_vel_radps[j]]);
        torques.push(R::splat(at.joint_torque_nm[j]));
    }
    let solved = R::run(Solve {
        program: &program,
        ground: &Ground::new(&Terrain::flat()),
        law: &ContactLaw::new(config),
        group: &mut group,
        torques: &torques,
    });
    let one = |v: V3<R>| v.map(|x| x.lane(R::LANES - 1));
    let mut joint_radps2 = vec![0.0; model.joints().len()];
    for (node, qdd) in program.nodes.iter().zip(&solved.joints) {
        joint_radps2[node.joint] = qdd.lane(R::LANES - 1);
    }
    Ok(Accelerations { base_mps2: one(solved.lin), base_radps2: one(solved.ang), joint_radps2 })
}

struct Solve<'a, R: Lanes> {
    program: &'a Program<R>,
    ground: &'a Ground<R>,
    law: &'a ContactLaw<R>,
    group: &'a mut Group<R>,
    torques: &'a [R],
}

struct Solved<R> {
    ang: V3<R>,
    lin: V3<R>,
    joints: Vec<R>,
}

impl<R: Lanes> Kernel for Solve<'_, R> {
    type Output = Solved<R>;

    #[inline(always)]
    fn run(self) -> Solved<R> {
        let (program, n) = (self.program, self.program.nodes.len());
        let mut frames = vec![Frame::zero(); n + 1];
        let mut inertias = vec![Inertia::zero(); n + 1];
        let mut hinges = vec![Hinge::zero(); n];
        let mut beyond = vec![(zero3(), zero3()); n + 1];
        let mut joints = vec![R::zero(); n];
        let mut loads = Vec::with_capacity(n);
        for i in 0..n {
            loads.push(Load { torque: self.torques[i], inertia: self.group.params.armature[i] });
        }
        let world = World {
            program,
            ground: self.ground,
            law: self.law,
            params: &self.group.params,
            push: Push { force: zero3(), torque: zero3() },
            half_dt: R::elem(0.0),
        };
        kinematics::outward::<R, true>(
            &world,
            &mut self.group.x,
            &mut frames,
            &mut inertias,
            &mut [],
        );
        aba::inward(program, &frames, &loads, &mut inertias, &mut hinges);
        if program.free {
            beyond[0] = aba::solve_base(&inertias[0]);
        }
        aba::outward(program, &frames, &hinges, &mut beyond, &mut joints);
        Solved { ang: beyond[0].0, lin: add_cross(beyond[0].1, beyond[0].0, frames[0].pos), joints }
    }
}
