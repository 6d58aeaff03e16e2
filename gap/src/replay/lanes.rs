//! One engine full of jobs: reset, step, record.

use caudata_sim::batch::{BatchEngine, Readout};
use caudata_sim::{Engine, InitialState, MAX_LOOP_DELAY_S};

use super::commands::{Reader, Readers, true_angle};
use super::cuts::replay_span;
use super::data::Data;
use super::fed::Fed;
use super::observe::{self, has_second, readout};
use super::starts::{Start, roll_pitch};
use super::trace::Trace;
use crate::error::GapError;
use crate::plant::Plant;
use crate::trial::{Trial, attitude_of};

/// Period of a servo's loop, s: 1 ms in the firmware of hobby servos, a tenth of it in drives with a current loop.
/// A command waits for half of it on average, and the torque of a tick is held until the next, which makes the
/// loop late by another half.
const FIRMWARE_TICK_S: f64 = 0.0005;

/// How long a held robot stands at its first commands before a recording begins, where a loop has an integral
/// part, s: nobody begins to record in the moment of switching on, and what has been integrated by then no
/// row tells. Much longer, and a soft integral part would have taken over all of the load.
const STAND_S: f64 = 1.0;

/// Periods in which all of a stretch is recorded: one more than it lasts, since velocities are those of half a
/// period before.
fn periods(duration_s: f64, period_s: f64) -> usize {
    (duration_s / period_s).ceil() as usize + 1
}

/// One lane at work.
struct Lane<'a> {
    plant: Plant,
    segment: usize,
    readers: Readers<'a>,
    /// What acts beside those.
    fed: Option<Fed<'a>>,
    switches: Switches,
    trace: Trace,
    /// After how many periods it is put to what was measured once more, and what that was.
    again: Option<(usize, &'a Start)>,
    /// Periods for which it stands before its stretch begins.
    stand: usize,
    /// Whether the candidate can be simulated.
    sound: bool,
}

impl<'a> Lane<'a> {
    fn new(plant: Plant, data: &'a Data, segment: usize, period_s: f64) -> Self {
        let own = &data.segments[segment];
        let trial = &data.trials[own.trial];
        let periods = periods(own.duration_s(), period_s);
        let stand = match stands_before(&plant, data, segment) {
            true => (STAND_S / period_s).round() as usize,
            false => 0,
        };
        let from_s = own.start_s - stand as f64 * period_s;
        let to_s = from_s + (stand + periods) as f64 * period_s;
        let window_s = (from_s - 0.5 * period_s, to_s);
        let again = own.again.as_ref().map(|(at_s, measured)| {
            let after = ((at_s - own.start_s) / period_s).round() as usize;
            (after, measured)
        });
        Self {
            readers: readers_of(trial, &plant, window_s),
            fed: Fed::new(trial, &plant, |a| heard_after_s(&plant, a), window_s),
            switches: Switches::new(trial, &plant, own.start_s),
            trace: Trace::new(
                readout(trial),
                has_second(trial),
                &plant,
                own.start_s,
                period_s,
                periods,
            ),
            plant,
            segment,
            again,
            stand,
            sound: true,
        }
    }

    /// What comes before step `k`: puts lane `lane` right, records it, and gives it its commands (rad).
    fn before_step(
        &mut self,
        engine: &mut BatchEngine,
        (lane, k, period_s): (usize, usize, f64),
        data: &Data,
        targets: &mut [f32],
        wrench: &mut [f32],
    ) {
        let (own, stand) = (&data.segments[self.segment], self.stand);
        if k == stand && stand > 0 && self.sound {
            self.sound &= correct(engine, lane, &self.plant, &own.start);
        }
        if k >= stand && k - stand < self.trace.rows() {
            self.trace.record(engine, lane, &self.plant.model, targets);
            if k == stand {
                self.trace.forget();
            }
        }
        if let Some((_, measured)) = self.again.filter(|(after, _)| stand + after == k)
            && self.sound
        {
            self.sound &= correct(engine, lane, &self.plant, measured);
            self.trace.forget();
        }
        let from = own.start_s + (k as f64 - stand as f64) * period_s;
        // a step takes velocities from half a step before to half a step after the time of the positions
        let half_s = 0.5 * period_s;
        self.readers.means(from - half_s, from + half_s, targets);
        if self.switches.due(from) && self.sound {
            let params = self.switches.apply(&self.plant, from);
            self.sound &= engine.set_params(lane, &params).is_ok();
        }
        if let Some(fed) = self.fed.as_mut().filter(|_| self.sound) {
            let span_s = (from - half_s, from + half_s);
            self.sound &= fed.feed(engine, lane, &self.plant, span_s, wrench);
        }
    }
}

/// Runs `jobs` (robot, segment), at most as many as the engine has lanes. An empty prediction stands for a
/// candidate that cannot be simulated.
pub(super) fn run(
    engine: &mut BatchEngine,
    data: &Data,
    period_s: f64,
    jobs: Vec<(Plant, usize)>,
) -> Result<Vec<Vec<f32>>, GapError> {
    let joints = jobs.first().map_or(0, |(p, _)| p.model.actuated().len());
    let mut read = Readout::JOINTS;
    let mut most = 0;
    let mut all = Vec::with_capacity(jobs.len());
    for (number, (plant, segment)) in jobs.into_iter().enumerate() {
        let mut lane = Lane::new(plant, data, segment, period_s);
        let own = &data.segments[segment];
        let signals = readout(&data.trials[own.trial]);
        let pushed = !data.trials[own.trial].forces.is_empty();
        read.base |= signals.base || own.again.is_some() || lane.stand > 0 || pushed;
        read.imu |= signals.imu;
        read.feet |= signals.feet;
        most = most.max(lane.stand + periods(own.duration_s(), period_s));
        lane.sound = start(engine, number, &lane, data);
        all.push(lane);
    }
    engine.report_only(read);
    let mut targets = vec![0.0_f32; engine.lanes() * joints];
    let mut wrenches = vec![0.0_f32; engine.lanes() * 6];
    for k in 0..=most {
        for (number, lane) in all.iter_mut().enumerate() {
            let own = &mut targets[number * joints..(number + 1) * joints];
            let wrench = &mut wrenches[number * 6..(number + 1) * 6];
            lane.before_step(engine, (number, k, period_s), data, own, wrench);
        }
        if k < most {
            engine.step(&targets, &wrenches)?;
        }
    }
    let predicted = all.iter().enumerate().map(|(number, lane)| {
        if !lane.sound || engine.state().diverged[number] {
            return Vec::new();
        }
        observe::predict(&lane.plant, &lane.trace, data, lane.segment)
    });
    Ok(predicted.collect())
}

/// Whether a robot stands before stretch `segment` begins: at the beginning of a run of a held robot whose
/// servos are on, with an integral part.
fn stands_before(plant: &Plant, data: &Data, segment: usize) -> bool {
    let s = &data.segments[segment];
    let trial = &data.trials[s.trial];
    data.hold(segment) == 0
        && s.start_s <= replay_span(trial).0
        && trial.enabled.iter().flatten().all(|on| on.at(s.start_s) > 0.5)
        && plant.lane.joints.iter().any(|j| j.ki_nm_per_rad_s > 0.0)
}

/// Puts a lane at its measured start. Whether the candidate is physical.
fn start(engine: &mut BatchEngine, number: usize, lane: &Lane, data: &Data) -> bool {
    let own = &data.segments[lane.segment];
    let nominal = InitialState::nominal(&lane.plant.model);
    let init = placed(&lane.plant, &own.start, data.hold(lane.segment) != 0, nominal);
    let params = lane.switches.apply(&lane.plant, own.start_s);
    let good = engine.set_params(number, &params).is_ok();
    good && engine.reset(number, &init).is_ok()
}

/// `init` with what was measured in the place of what it has.
fn placed(plant: &Plant, measured: &Start, moves: bool, mut init: InitialState) -> InitialState {
    for (a, q) in init.joint_pos_rad.iter_mut().enumerate() {
        *q = true_angle(&plant.sensing.encoders[a], measured.pos_rad[a]) as f32;
    }
    for (a, qd) in init.joint_vel_radps.iter_mut().enumerate() {
        *qd = measured.vel_radps[a] as f32;
    }
    if let Some(p) = measured.base_pos_m {
        init.base_xy_m = [p[0] as f32, p[1] as f32];
        init.base_z_m = Some(p[2] as f32);
    }
    if let Some(rpy) = measured.base_rpy_rad {
        init.base_rpy_rad = rpy.map(|x| x as f32);
    }
    if let Some(v) = measured.base_vel_mps.filter(|_| moves) {
        init.base_vel_mps = v.map(|x| x as f32);
    }
    if let Some(w) = measured.base_angvel_radps.filter(|_| moves) {
        init.base_angvel_radps = w.map(|x| x as f32);
    }
    init
}

/// Puts a lane to what was measured once more; what was not measured stays where the simulation has brought
/// it. Whether that went well.
fn correct(engine: &mut BatchEngine, lane: usize, plant: &Plant, measured: &Start) -> bool {
    let state = engine.state();
    let three = |x: &[f32]| [x[3 * lane], x[3 * lane + 1], x[3 * lane + 2]];
    let pos_m = three(&state.base_pos_m);
    let quat = [0, 1, 2, 3].map(|i| f64::from(state.base_quat_wxyz[4 * lane + i]));
    let [gx, gy, yaw, gz] = attitude_of(quat);
    let [roll, pitch] = roll_pitch(gx, gy, gz);
    let own = InitialState {
        base_xy_m: [pos_m[0], pos_m[1]],
        base_z_m: Some(pos_m[2]),
        base_rpy_rad: [roll as f32, pitch as f32, yaw as f32],
        base_vel_mps: three(&state.base_vel_mps),
        base_angvel_radps: three(&state.base_angvel_radps),
        ..InitialState::nominal(&plant.model)
    };
    let mut init = placed(plant, measured, true, own);
    for (joints, ahead) in [
        (&mut init.joint_pos_rad, &state.encoder_ahead_rad),
        (&mut init.joint_vel_radps, &state.encoder_ahead_radps),
    ] {
        let ahead = ahead.chunks(state.actuated.max(1)).nth(lane);
        for (own, ahead) in joints.iter_mut().zip(ahead.into_iter().flatten()) {
            *own -= ahead;
        }
    }
    engine.correct(lane, &init).is_ok()
}

/// How long after it was sent a servo acts on a command, s.
fn heard_after_s(plant: &Plant, a: usize) -> f64 {
    let delay_s = plant.lane.command_delay_s + plant.lane.joints[a].command_skew_s;
    0.5 * FIRMWARE_TICK_S + f64::from(delay_s)
}

fn readers_of<'a>(trial: &'a Trial, plant: &Plant, window_s: (f64, f64)) -> Readers<'a> {
    let joints = trial
        .commands
        .iter()
        .enumerate()
        .map(|(a, steps)| {
            Reader::new(
                steps,
                heard_after_s(plant, a),
                plant.sensing.encoders[a],
                &plant.lane.command_loss,
                window_s,
            )
        })
        .collect();
    Readers::new(joints)
}

/// Time after which friction that changes within a run is set anew, s.
const REFRESH_S: f64 = 0.2;

/// Which servos are on, and what else changes within a run.
struct Switches {
    /// When the run began, s.
    origin_s: f64,
    /// When friction that changes is next set anew, s; infinite: nothing changes.
    refresh_s: f64,
    /// Time, joint, on.
    events: Vec<(f64, usize, bool)>,
    next: usize,
    on: Vec<bool>,
}

impl Switches {
    fn new(trial: &Trial, plant: &Plant, from_s: f64) -> Self {
        let changes = plant.run_in.iter().any(|r| r.extra_nm != 0.0);
        let mut events = Vec::new();
        let mut on = vec![true; trial.enabled.len()];
        for (a, steps) in trial.enabled.iter().enumerate() {
            let Some(steps) = steps else { continue };
            on[a] = steps.at(from_s) > 0.5;
            for (t, v) in steps.time_s.iter().zip(&steps.value) {
                if *t > from_s {
                    events.push((*t, a, *v > 0.5));
                }
            }
        }
        events.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        Self {
            origin_s: trial.span_s.0,
            refresh_s: if changes { from_s + REFRESH_S } else { f64::INFINITY },
            events,
            next: 0,
            on,
        }
    }

    /// Whether something switched by `t_s`.
    fn due(&mut self, t_s: f64) -> bool {
        let before = self.next;
        while self.next < self.events.len() && self.events[self.next].0 <= t_s {
            let (_, a, on) = self.events[self.next];
            self.on[a] = on;
            self.next += 1;
        }
        let refresh = t_s >= self.refresh_s;
        if refresh {
            self.refresh_s = t_s + REFRESH_S;
        }
        self.next > before || refresh
    }

    /// The engine's parameters at time `t_s`: command delays are in the command stream already, and a servo
    /// that is off gives nothing.
    fn apply(&self, plant: &Plant, t_s: f64) -> caudata_sim::LaneParams {
        let mut params = plant.lane.clone();
        for (friction, run_in) in params.joint_friction_nm.iter_mut().zip(&plant.run_in) {
            if run_in.extra_nm != 0.0 {
                let since_s = (t_s - self.origin_s).max(0.0);
                let extra = run_in.extra_nm * (-since_s / run_in.time_s).exp();
                *friction = (*friction + extra as f32).max(0.0);
            }
        }
        params.command_delay_s = 0.0;
        params.command_loss = caudata_sim::CommandLoss::default();
        for joint in &mut params.joints {
            joint.command_skew_s = 0.0;
            let late_s = joint.loop_delay_s + 0.5 * FIRMWARE_TICK_S as f32;
            joint.loop_delay_s = late_s.min(MAX_LOOP_DELAY_S);
        }
        for (a, on) in self.on.iter().enumerate() {
            if !on {
                params.torque_scale[a] = 0.0;
            }
            // the loop sees the angle through its encoder
            let gain = 1.0 + plant.sensing.encoders[a].gain;
            params.kp_nm_per_rad[a] *= gain;
            params.kd_nms_per_rad[a] *= gain;
        }
        params
    }
}
