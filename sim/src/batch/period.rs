//! One control period of one group of lanes: the physics steps, then the report.
//!
//! A step is semi-implicit Euler, which is leapfrog with velocities half a step off the positions. Coriolis
//! and centrifugal forces belong to the positions' time, so they are taken at the velocity half a step on,
//! extrapolated with the last step's acceleration: with the velocity as it is, a chaotic double pendulum
//! gains 5 % of its energy in 1.4 s at 2 ms.

use super::aba::{self, Load};
use super::clock::Phase;
use super::contact_law::MEMORY;
use super::cores;
use super::group::{Group, Layout, layout};
use super::integrate;
use super::kinematics::{self, Push, World};
use super::pairs;
use super::place::Part;
use super::shared::{Scratch, Shared};
use super::vec3::{dot, zero3};
use super::wet;
use crate::CommandLoss;
use crate::drive::ImplicitTorque;
use crate::drive::command::Scheduled;
use crate::drive::loop_delay::Loop;
use crate::drive::loss::LossMemory;
use crate::drive::passive::StopAt;
use crate::drive::step;
use crate::drive::supply;
use crate::real::Mask;
use crate::simd::{Kernel, Lanes};

/// Runs a period and reports it. `FLAT`: the ground is the plane z = 0.
pub(super) struct Period<'a, R: Lanes, const FLAT: bool> {
    pub shared: &'a Shared<R>,
    pub group: &'a mut Group<R>,
    pub scratch: &'a mut Scratch<R>,
    /// Lanes of this group that are in use.
    pub used: usize,
    /// `[used, A]`, rad.
    pub targets: &'a [f32],
    /// `[used, 6]`: force, torque.
    pub wrenches: &'a [f32],
}

impl<R: Lanes, const FLAT: bool> Kernel for Period<'_, R, FLAT> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Period { shared, group, scratch, used, targets, wrenches } = self;
        if let Some(clock) = &mut scratch.clock {
            clock.begin();
        }
        let width = shared.program.actuated;
        for lane in 0..used {
            let finite = all_finite(&targets[lane * width..(lane + 1) * width])
                && all_finite(&wrenches[lane * 6..(lane + 1) * 6]);
            group.diverged[lane] |= !finite;
        }
        scratch.saved.copy_from_slice(&group.x);
        scratch.saved_sums.copy_from_slice(&group.sums);
        scratch.saved_drives.copy_from_slice(&group.drives);
        push_commands(shared, group, scratch, used, targets);
        let mut push = Push { force: zero3(), torque: zero3() };
        for c in 0..3 {
            push.force[c] = column(&group.diverged[..used], wrenches, 6, c);
            push.torque[c] = column(&group.diverged[..used], wrenches, 6, 3 + c);
        }
        for sum in &mut group.sums {
            *sum = R::zero();
        }
        scratch.mark(Phase::Report);
        // lanes that already broke down run along, unseen
        let mut sound = R::zero().le(R::zero());
        for substep in 0..shared.substeps {
            sound = sound & step::<R, FLAT>(shared, group, scratch, push, substep);
        }
        let share = R::splat(1.0 / f64::from(shared.substeps));
        for sum in &mut group.sums {
            *sum = *sum * share;
        }
        for lane in 0..used {
            group.diverged[lane] |= !sound.lane(lane);
        }
        integrate::freeze(group, scratch);
        super::report::report(shared, shared.readout, group, scratch);
        scratch.mark(Phase::Report);
    }
}

#[inline(always)]
fn all_finite(values: &[f32]) -> bool {
    let mut finite = true;
    for v in values {
        finite &= v.is_finite();
    }
    finite
}

/// Puts this period's commands first into the history, and looks up what each servo is told when; a lane that
/// broke down hears nothing.
#[inline(always)]
fn push_commands<R: Lanes>(
    shared: &Shared<R>,
    group: &mut Group<R>,
    scratch: &mut Scratch<R>,
    used: usize,
    targets: &[f32],
) {
    let width = shared.program.actuated;
    let mut lost = [0.0_f32; 16];
    lost_frames(&mut group.loss, &group.params.loss, &mut lost);
    for a in 0..width {
        scratch.targets[a] = column(&group.diverged[..used], targets, width, a);
    }
    let lost = R::zero().lt(R::read(&lost));
    group.history.push(&scratch.targets, lost);
    let period_s = shared.period_s();
    for a in 0..width {
        scratch.scheduled[a] = if group.params.features.delay {
            group.history.schedule(a, group.params.servos[a].delay_s, period_s)
        } else {
            Scheduled::constant(group.history.newest(a))
        };
    }
}

/// Draws which lanes lose this period's frame: 1 where one does.
#[inline(never)]
fn lost_frames(memory: &mut [LossMemory], loss: &[CommandLoss], lost: &mut [f32; 16]) {
    for ((memory, loss), lost) in memory.iter_mut().zip(loss).zip(lost) {
        *lost = f32::from(u8::from(memory.next(loss)));
    }
}

/// Column `at` of rows of `width` numbers, one per lane; 0 for a lane that broke down.
#[inline(always)]
fn column<R: Lanes>(diverged: &[bool], rows: &[f32], width: usize, at: usize) -> R {
    let mut all = [0.0_f32; 16];
    for lane in 0..diverged.len() {
        if !diverged[lane] {
            all[lane] = rows[lane * width + at];
        }
    }
    R::read(&all)
}

/// One physics step. Gives which lanes are still sound.
#[inline(always)]
fn step<R: Lanes, const FLAT: bool>(
    shared: &Shared<R>,
    group: &mut Group<R>,
    scratch: &mut Scratch<R>,
    push: Push<R>,
    substep: u32,
) -> R::Mask {
    let program = &shared.program;
    let world = World {
        program,
        ground: &shared.ground,
        law: &shared.law,
        params: &group.params,
        push,
        half_dt: R::elem(0.5 * shared.dt_s),
    };
    kinematics::outward::<R, FLAT>(
        &world,
        &mut group.x,
        &mut scratch.frames,
        &mut scratch.inertias,
        &mut scratch.touches,
    );
    scratch.mark(Phase::KinematicsAndContact);
    if !program.pairs.is_empty() {
        pairs::collide(
            program,
            group,
            &scratch.frames,
            &mut scratch.centres,
            &mut scratch.inertias,
        );
        scratch.mark(Phase::SelfCollision);
    }
    if !program.core_pairs.is_empty() {
        cores::collide(program, group, &scratch.frames, &mut scratch.inertias);
        scratch.mark(Phase::SelfCollision);
    }
    if program.water {
        wet::immerse(
            program,
            &group.params,
            kinematics::centre(&group.x, &scratch.frames[0])[2],
            R::splat(shared.dt_s),
            &scratch.frames,
            &mut scratch.inertias,
        );
        scratch.mark(Phase::Water);
    }
    load_joints(shared, group, scratch, substep);
    scratch.mark(Phase::Drives);
    aba::inward(
        program,
        &scratch.frames,
        &scratch.loads,
        &mut scratch.inertias,
        &mut scratch.hinges,
    );
    scratch.mark(Phase::Inward);
    if program.free {
        scratch.beyond[0] = aba::solve_base(&scratch.inertias[0]);
    }
    aba::outward(program, &scratch.frames, &scratch.hinges, &mut scratch.beyond, &mut scratch.qdd);
    scratch.mark(Phase::Outward);
    sum_contacts::<R, FLAT>(shared, group, scratch);
    let sound = integrate::integrate(shared, group, scratch);
    scratch.mark(Phase::Integration);
    sound
}

/// Loads of all joints for this step.
#[inline(always)]
fn load_joints<R: Lanes>(
    shared: &Shared<R>,
    group: &mut Group<R>,
    scratch: &mut Scratch<R>,
    substep: u32,
) {
    let program = &shared.program;
    let lay = layout(program);
    let n = program.nodes.len();
    let Group { x, params, drives, wanted, .. } = group;
    let (q, qd) = (&x[lay.q()..lay.q() + n], &x[lay.qd()..lay.qd() + n]);
    let bristle = &x[lay.bristle()..lay.bristle() + n];
    let free = &x[lay.free()..lay.free() + n];
    let qdd = &x[lay.qdd()..lay.qdd() + n];
    let step = &shared.step;
    let since = R::splat(shared.dt_s * f64::from(substep));
    let bus_v = x[Layout::BUS];
    let mut drawn_a = R::zero();
    let sags = params.supply.sags();
    let late = params.features.loop_delay;
    if late {
        wanted.begin_step();
    }
    for i in 0..n {
        let hinge = &params.hinges[i];
        let stop = StopAt { law: &program.nodes[i].stop, free_radps2: free[i] };
        let torque = if let Some(a) = program.nodes[i].servo {
            let command = scratch.scheduled[a].over_step(since, step.dt_s, step.per_dt);
            let driven = step::start(
                params.features,
                &params.servos[a],
                hinge,
                &mut drives[a],
                if late { wanted.joint(a) } else { Loop::direct() },
                step,
                bus_v,
                command,
                q[i],
                qd[i],
                qdd[i],
                stop,
            );
            if sags {
                drawn_a += driven.drawn_a(&params.servos[a], &drives[a], bus_v);
            }
            scratch.driven[a] = Some(driven);
            driven.torque
        } else {
            step::hinge_torque(hinge, step, bristle[i], q[i], qd[i], stop)
        };
        scratch.loads[i] = load(&torque, params.armature[i], step.dt_s, qd[i]);
    }
    for (load, outer_nm) in scratch.loads.iter_mut().zip(&params.outer_nm) {
        load.torque += *outer_nm;
    }
    if late {
        wanted.end_step();
    }
    x[Layout::BUS] = supply::settle_v(&params.supply, x[Layout::BUS], drawn_a);
}

/// A torque at the end of the step as one that is linear in the acceleration.
#[inline(always)]
fn load<R: Lanes>(t: &ImplicitTorque<R>, armature: R, dt: R, qd: R) -> Load<R> {
    let resistance = t.stiffness_nm_per_rad.mul_add(dt, t.damping_nms_per_rad);
    Load {
        torque: t.now_nm - resistance * qd,
        inertia: resistance.mul_add(dt, armature + t.inertia_kgm2),
    }
}

/// Adds up the contact forces that came out.
#[inline(always)]
fn sum_contacts<R: Lanes, const FLAT: bool>(
    shared: &Shared<R>,
    group: &mut Group<R>,
    scratch: &Scratch<R>,
) {
    let program = &shared.program;
    let feet = 2 * program.actuated;
    let trunk = feet + 3 * program.feet.len();
    let contacts = layout(program).contacts();
    for k in 0..program.frames() {
        if k == 0 && !program.free {
            continue;
        }
        let (ang, lin) = scratch.beyond[k];
        for p in program.points_of[k].clone() {
            let touch = &scratch.touches[p];
            if !touch.any {
                continue;
            }
            let (force, acceleration) = touch.force(ang, lin);
            if shared.law.convex {
                for c in 0..3 {
                    let free = acceleration[c] - touch.give * force[c];
                    group.x[contacts + MEMORY * p + c] = free * touch.touching;
                }
            }
            let (normal, acceleration) = if FLAT {
                (force[2], acceleration[2])
            } else {
                (dot(force, touch.normal), dot(acceleration, touch.normal))
            };
            let free = (acceleration - touch.give * normal) * touch.touching;
            group.x[contacts + MEMORY * p + 3] = normal.max(R::zero());
            group.x[contacts + MEMORY * p + 4] = free;
            match program.points[p].part {
                Part::Foot(f) => {
                    for c in 0..3 {
                        group.sums[feet + 3 * f + c] += force[c];
                    }
                }
                Part::Trunk => group.sums[trunk] += normal,
                Part::Tail => group.sums[trunk + 1] += normal,
            }
        }
    }
}
