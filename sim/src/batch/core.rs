//! All lanes of an engine in groups of one width, behind a trait that hides the width.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use caudata_model::RobotModel;

use super::clock::{Clock, PhaseSeconds};
use super::ground::Ground;
use super::group::Group;
use super::period::Period;
use super::pool::Pool;
use super::program::Program;
use super::readout::Readout;
use super::report;
use super::shared::{Scratch, Shared};
use crate::drive::loss::LossMemory;
use crate::drive::{JointMemory, loop_delay};
use crate::per_lane::PerLane as _;
use crate::real::Real;
use crate::simd::{Kernel, Lanes};
use crate::state::FIELDS;
use crate::{EngineConfig, LaneParams, SimError, State, Terrain};

/// Parts that a step's groups are cut into, per thread.
const PARTS_PER_THREAD: usize = 8;

/// One lane's state without its parameters.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct LaneState {
    pub x: Vec<f64>,
    pub drives: Vec<JointMemory<f64>>,
    /// What the loops asked for in the last steps, see [`lane`](crate::drive::WantedTorques::lane).
    pub wanted_nm: Vec<f64>,
    pub history: Vec<f64>,
    pub loss: LossMemory,
    pub sums: Vec<f64>,
    pub diverged: bool,
}

/// Lanes whose width is not known.
pub(super) trait Core: Send {
    fn set_params(
        &mut self,
        lane: usize,
        model: &RobotModel,
        config: &EngineConfig,
        params: &LaneParams,
    );
    /// Commanded torques (policy order) and torques from outside on joints (model order), N·m, until the lane's
    /// parameters are set.
    fn feed(&mut self, lane: usize, commanded_nm: &[f32], outer_nm: &[f32]);
    /// How far each rotor is ahead of its joint, rad.
    fn rotor_leads_rad(&self, lane: usize) -> Vec<f32>;
    /// Whether a lane's state has the lengths that these lanes have with a loop memory of `steps` steps.
    fn fits(&self, lane: &LaneState, steps: usize) -> bool;
    /// Puts a lane at rest inside: `pose` position and quaternion, `motion` velocity and angular velocity
    /// (world), joints in model order, servos holding `rest`. Then reports it in `row` of `state`.
    fn reset(&mut self, lane: usize, start: &Start<'_>, state: &mut State);
    /// Puts base and the hinges of `driven` (model order) where `start` says; what else the lane has stays as
    /// it is.
    fn correct(&mut self, lane: usize, start: &Start<'_>, driven: &[usize], state: &mut State);
    fn get(&self, lane: usize) -> LaneState;
    fn put(&mut self, lane: usize, from: &LaneState) -> bool;
    fn step(&mut self, pool: &Pool, targets: &[f32], wrenches: &[f32], state: &mut State);
    /// What the steps that follow report.
    fn report_only(&mut self, readout: Readout);
    /// Starts to time the phases of the steps that follow.
    fn time_phases(&mut self);
    /// All threads together.
    fn phase_seconds(&self) -> PhaseSeconds;
}

/// Where a lane starts.
pub(super) struct Start<'a> {
    pub pose: [f64; 7],
    pub motion: [f64; 6],
    /// Model order.
    pub joint_pos: &'a [f64],
    pub joint_vel: &'a [f64],
    /// Supply, V.
    pub bus_v: f64,
    /// Policy order.
    pub servo_vel: &'a [f32],
    /// Policy order.
    pub rest: &'a [f32],
}

/// Lanes in groups of `R`.
pub(super) struct CoreOf<R: Lanes> {
    shared: Shared<R>,
    groups: Vec<Group<R>>,
    scratch: Vec<Scratch<R>>,
    lanes: usize,
}

impl<R: Lanes> CoreOf<R> {
    pub fn new(
        model: &RobotModel,
        lanes: usize,
        config: &EngineConfig,
        terrain: &Terrain,
        threads: usize,
    ) -> Result<Self, SimError> {
        let level = terrain.water_level_m;
        let program = Program::<R>::new(model, config, level.is_some())?;
        let level = level.map_or(0.0, f64::from);
        let shared = Shared::new(program, Ground::new(terrain), config, level);
        let groups = lanes.div_ceil(R::LANES);
        Ok(Self {
            scratch: vec![Scratch::new(&shared.program); threads.clamp(1, groups)],
            groups: vec![Group::new(&shared.program, shared.period_s()); groups],
            shared,
            lanes,
        })
    }

    /// Puts a lane into a state and reports it in `row` of `state`, with no acceleration.
    fn place(&mut self, lane: usize, from: &LaneState, state: &mut State) {
        self.put(lane, from);
        let (g, slot) = (lane / R::LANES, lane % R::LANES);
        if lane + 1 == self.lanes {
            for spare in slot + 1..R::LANES {
                put_slot(&mut self.groups[g], spare, from);
            }
        }
        // The report moves the IMU's velocity on: once to learn it, once to report no acceleration.
        let group = &mut self.groups[g];
        let scratch = &mut self.scratch[0];
        for _ in 0..2 {
            let imu: Vec<R> = group.x[13..16].to_vec();
            R::run(Report { shared: &self.shared, group, scratch });
            for (now, before) in group.x[13..16].iter_mut().zip(imu) {
                let new = Real::lane(*now, slot);
                *now = before.with_lane(slot, new);
                for spare in slot + 1..R::LANES {
                    if lane + 1 == self.lanes {
                        *now = now.with_lane(spare, new);
                    }
                }
            }
        }
        let first = g * R::LANES;
        let widths = self.shared.program.widths();
        let mut at = 0;
        state.diverged[lane] = from.diverged;
        for (field, k) in state.fields_mut().into_iter().zip(widths) {
            for c in 0..k {
                field[(first + slot) * k + c] = Real::lane(scratch.out[at + c], slot) as f32;
            }
            at += k;
        }
    }
}

impl<R: Lanes> Core for CoreOf<R> {
    fn set_params(
        &mut self,
        lane: usize,
        model: &RobotModel,
        config: &EngineConfig,
        params: &LaneParams,
    ) {
        let group = &mut self.groups[lane / R::LANES];
        let slot = lane % R::LANES;
        let level = self.shared.water_level_m;
        group.set_params(slot, &self.shared.program, model, config, level, params);
        if lane + 1 == self.lanes {
            // what fills up the last group does as its last lane does
            for spare in slot + 1..R::LANES {
                group.set_params(spare, &self.shared.program, model, config, level, params);
            }
        }
        self.shared.ahead |= group.params.features.motor_encoder;
    }

    fn feed(&mut self, lane: usize, commanded_nm: &[f32], outer_nm: &[f32]) {
        let group = &mut self.groups[lane / R::LANES];
        group.feed(lane % R::LANES, &self.shared.program, commanded_nm, outer_nm);
    }

    fn rotor_leads_rad(&self, lane: usize) -> Vec<f32> {
        let drives = &self.groups[lane / R::LANES].drives;
        drives.iter().map(|m| Real::lane(m.lead_rad, lane % R::LANES) as f32).collect()
    }

    fn fits(&self, lane: &LaneState, steps: usize) -> bool {
        let group = &self.groups[0];
        lane.x.len() == group.x.len()
            && lane.drives.len() == group.drives.len()
            && loop_delay::fits(lane.wanted_nm.len(), group.drives.len(), steps)
            && lane.sums.len() == group.sums.len()
            && lane.history.len() == group.history.lane(0).len()
    }

    fn reset(&mut self, lane: usize, start: &Start<'_>, state: &mut State) {
        let program = &self.shared.program;
        let mut x = vec![0.0; super::group::layout(program).len()];
        x[..7].copy_from_slice(&start.pose);
        x[super::group::Layout::BUS] = start.bus_v;
        if program.free {
            x[7..13].copy_from_slice(&start.motion);
        }
        let lay = super::group::layout(program);
        for (i, node) in program.nodes.iter().enumerate() {
            x[lay.q() + i] = start.joint_pos[node.joint];
            x[lay.qd() + i] = start.joint_vel[node.joint];
        }
        let from = LaneState {
            x,
            drives: (start.rest.iter().zip(start.servo_vel))
                .map(|(&q, &qd)| JointMemory::rest(f64::from(q), f64::from(qd)))
                .collect(),
            wanted_nm: Vec::new(),
            history: {
                let width = program.actuated.max(1);
                let depth = self.groups[0].history.lane(0).len() / width;
                let rest: Vec<f64> = start.rest.iter().map(|&q| f64::from(q)).collect();
                rest.repeat(depth)
            },
            loss: LossMemory::default(),
            sums: vec![0.0; super::group::sums_len(program)],
            diverged: false,
        };
        self.place(lane, &from, state);
    }

    fn correct(&mut self, lane: usize, start: &Start<'_>, driven: &[usize], state: &mut State) {
        let mut from = self.get(lane);
        let program = &self.shared.program;
        let lay = super::group::layout(program);
        from.x[..7].copy_from_slice(&start.pose);
        if program.free {
            from.x[7..13].copy_from_slice(&start.motion);
        }
        for (i, node) in program.nodes.iter().enumerate() {
            if driven.contains(&node.joint) {
                from.x[lay.q() + i] = start.joint_pos[node.joint];
                from.x[lay.qd() + i] = start.joint_vel[node.joint];
            }
        }
        self.place(lane, &from, state);
    }

    fn get(&self, lane: usize) -> LaneState {
        let (group, slot) = (&self.groups[lane / R::LANES], lane % R::LANES);
        LaneState {
            x: group.x.iter().map(|v| Real::lane(*v, slot)).collect(),
            drives: group.drives.iter().map(|d| d.lane(slot)).collect(),
            wanted_nm: group.wanted.lane(slot),
            history: group.history.lane(slot),
            loss: group.loss[slot],
            sums: group.sums.iter().map(|v| Real::lane(*v, slot)).collect(),
            diverged: group.diverged[slot],
        }
    }

    fn put(&mut self, lane: usize, from: &LaneState) -> bool {
        let (group, slot) = (&mut self.groups[lane / R::LANES], lane % R::LANES);
        put_slot(group, slot, from)
    }

    fn report_only(&mut self, readout: Readout) {
        self.shared.readout = readout;
    }

    fn time_phases(&mut self) {
        for scratch in &mut self.scratch {
            scratch.clock = Some(Clock::new());
        }
    }

    fn phase_seconds(&self) -> PhaseSeconds {
        let mut sum = PhaseSeconds::default();
        for clock in self.scratch.iter().filter_map(|s| s.clock.as_ref()) {
            for (sum, seconds) in sum.iter_mut().zip(clock.seconds) {
                *sum += seconds;
            }
        }
        sum
    }

    fn step(&mut self, pool: &Pool, targets: &[f32], wrenches: &[f32], state: &mut State) {
        let shared = &self.shared;
        let threads = pool.threads().min(self.scratch.len());
        // Small parts. Each thread begins with those that it had in the last step, which are in its cache,
        // and then helps the others: the machine may be busy with other things as well. A group's result does
        // not depend on who works it out.
        let share = self.groups.len().div_ceil(PARTS_PER_THREAD * threads);
        let widths = shared.program.widths();
        let actuated = shared.program.actuated;
        let mut rest = Rows::of(state);
        if threads == 1 {
            // nobody to share with
            let mut all = Part {
                shared,
                groups: &mut self.groups,
                rows: rest,
                targets,
                wrenches,
                lanes: self.lanes,
                widths,
            };
            all.run(&mut self.scratch[0]);
            return;
        }
        let mut first = 0;
        let mut work = Vec::with_capacity(PARTS_PER_THREAD * threads);
        for groups in self.groups.chunks_mut(share) {
            let lanes = (groups.len() * R::LANES).min(self.lanes - first);
            work.push(Mutex::new(Part {
                shared,
                groups,
                rows: rest.split_off_front(lanes, &widths),
                targets: &targets[first * actuated..(first + lanes) * actuated],
                wrenches: &wrenches[first * 6..(first + lanes) * 6],
                lanes,
                widths,
            }));
            first += lanes;
        }
        let scratch: Vec<Mutex<&mut Scratch<R>>> =
            self.scratch.iter_mut().map(Mutex::new).collect();
        let taken: Vec<AtomicBool> = work.iter().map(|_| AtomicBool::new(false)).collect();
        pool.run(&|k| {
            // nobody else has this thread's working memory, or a part that it took
            let Some(Ok(mut scratch)) = scratch.get(k).map(Mutex::lock) else { return };
            let own = k * work.len() / threads;
            for at in (own..work.len()).chain(0..own) {
                if !taken[at].swap(true, Ordering::Relaxed)
                    && let Ok(mut part) = work[at].lock()
                {
                    part.run(&mut scratch);
                }
            }
        });
    }
}

fn put_slot<R: Lanes>(group: &mut Group<R>, slot: usize, from: &LaneState) -> bool {
    if !group.history.set_lane(slot, &from.history) || !group.wanted.set_lane(slot, &from.wanted_nm)
    {
        return false;
    }
    for (to, v) in group.x.iter_mut().zip(&from.x) {
        to.set_lane(slot, v);
    }
    for (to, v) in group.drives.iter_mut().zip(&from.drives) {
        to.set_lane(slot, v);
    }
    for (to, v) in group.sums.iter_mut().zip(&from.sums) {
        to.set_lane(slot, v);
    }
    group.loss[slot] = from.loss;
    group.diverged[slot] = from.diverged;
    true
}

/// The report alone.
struct Report<'a, R: Lanes> {
    shared: &'a Shared<R>,
    group: &'a mut Group<R>,
    scratch: &'a mut Scratch<R>,
}

impl<R: Lanes> Kernel for Report<'_, R> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        report::report(self.shared, Readout::ALL, self.group, self.scratch);
    }
}

/// Rows of [`State`] that one thread writes.
struct Rows<'a> {
    fields: [&'a mut [f32]; FIELDS],
    diverged: &'a mut [bool],
}

impl<'a> Rows<'a> {
    fn of(state: &'a mut State) -> Self {
        let (fields, diverged) = state.parts_mut();
        Self { fields, diverged }
    }

    fn split_off_front(&mut self, lanes: usize, widths: &[usize; FIELDS]) -> Self {
        let mut front: [&'a mut [f32]; FIELDS] = [(); FIELDS].map(|()| Default::default());
        for ((slot, field), k) in front.iter_mut().zip(&mut self.fields).zip(widths) {
            let (head, tail) = std::mem::take(field).split_at_mut(lanes * k);
            *slot = head;
            *field = tail;
        }
        let (head, tail) = std::mem::take(&mut self.diverged).split_at_mut(lanes);
        self.diverged = tail;
        Self { fields: front, diverged: head }
    }
}

/// Some groups and what they are told in a step.
struct Part<'a, R: Lanes> {
    shared: &'a Shared<R>,
    groups: &'a mut [Group<R>],
    rows: Rows<'a>,
    targets: &'a [f32],
    wrenches: &'a [f32],
    lanes: usize,
    widths: [usize; FIELDS],
}

impl<R: Lanes> Part<'_, R> {
    fn run(&mut self, scratch: &mut Scratch<R>) {
        let actuated = self.shared.program.actuated;
        for g in 0..self.groups.len() {
            let first = g * R::LANES;
            let used = R::LANES.min(self.lanes - first);
            let targets = &self.targets[first * actuated..(first + used) * actuated];
            let wrenches = &self.wrenches[first * 6..(first + used) * 6];
            let group = &mut self.groups[g];
            if self.shared.ground.is_flat() {
                R::run(Period::<R, true> {
                    shared: self.shared,
                    group,
                    scratch,
                    used,
                    targets,
                    wrenches,
                });
            } else {
                R::run(Period::<R, false> {
                    shared: self.shared,
                    group,
                    scratch,
                    used,
                    targets,
                    wrenches,
                });
            }
            self.publish(scratch, g, first, used);
        }
    }

    /// Copies the report into the rows; lanes that broke down keep theirs.
    fn publish(&mut self, scratch: &mut Scratch<R>, g: usize, first: usize, used: usize) {
        let diverged = &self.groups[g].diverged[..used];
        self.rows.diverged[first..first + used].copy_from_slice(diverged);
        R::run(Publish {
            out: &scratch.out,
            turned: &mut scratch.turned,
            rows: &mut self.rows.fields,
            widths: &self.widths,
            readout: self.shared.readout.fields(self.shared.ahead),
            first,
            diverged,
        });
    }
}

/// Turns a report's registers into rows.
struct Publish<'a, 'b, R> {
    out: &'a [R],
    /// Working memory, 16 per register.
    turned: &'a mut [f32],
    rows: &'a mut [&'b mut [f32]; FIELDS],
    widths: &'a [usize; FIELDS],
    /// Which fields.
    readout: [bool; FIELDS],
    first: usize,
    diverged: &'a [bool],
}

impl<R: Lanes> Kernel for Publish<'_, '_, R> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let mut next = 0;
        for f in 0..FIELDS {
            let (at, k) = (next, self.widths[f]);
            next += k;
            if !self.readout[f] {
                continue;
            }
            for v in at..next {
                self.out[v].write(&mut self.turned[16 * v..16 * v + 16]);
            }
            for lane in 0..self.diverged.len() {
                if self.diverged[lane] {
                    continue;
                }
                let from = (self.first + lane) * k;
                let row = &mut self.rows[f][from..from + k];
                let columns = self.turned[16 * at..16 * next].as_chunks::<16>().0;
                for (to, column) in row.iter_mut().zip(columns) {
                    *to = column[lane];
                }
            }
        }
    }
}
