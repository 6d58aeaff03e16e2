//! One engine full of jobs: reset, step, record.

use caudata_sim::batch::{BatchEngine, Readout};
use caudata_sim::{Engine, InitialState, State};

use super::commands::{Reader, Readers, true_angle};
use super::data::{Data, Start, replay_span, roll_pitch};
use super::observe::{self, Trace, readout};
use super::{Replayer, Variant};
use crate::error::GapError;
use crate::plant::Plant;
use crate::trial::{Trial, attitude_of};

/// How long a command waits in any servo, s: half a period of a firmware loop of about 1 kHz and its bridge. The simulated loop acts at once; without this
/// every faultless servo shows 0.5 to 0.8 ms of delay.
const SERVO_TICK_S: f64 = 0.0006;

/// How long a held robot stands at its first commands before a recording begins, where a loop has an integral part, s: nobody begins to record in the
/// moment of switching on, and what has been integrated by then no row tells. Much longer, and a soft integral part would have taken over all of the load.
const STAND_S: f64 = 1.0;

/// Runs `jobs` (variant, segment), at most as many as the engine has lanes. An empty prediction stands for a candidate that cannot be simulated.
pub(super) fn run(
    replayer: &Replayer,
    engine: &mut BatchEngine,
    data: &Data,
    variants: &[Variant],
    jobs: &[(usize, usize)],
) -> Result<Vec<Vec<f32>>, GapError> {
    let model = replayer.model().clone();
    let (joints, lanes) = (model.actuated().len(), engine.lanes());
    let period_s = replayer.period_s();
    let mut sound = vec![true; jobs.len()];
    let mut plants = Vec::with_capacity(jobs.len());
    let mut readers = Vec::with_capacity(jobs.len());
    let mut switches = Vec::with_capacity(jobs.len());
    let mut traces = Vec::with_capacity(jobs.len());
    let mut corrections = Vec::with_capacity(jobs.len());
    let mut stands = Vec::with_capacity(jobs.len());
    let mut read = Readout::JOINTS;
    let mut most = 0;
    for (lane, &(v, s)) in jobs.iter().enumerate() {
        let segment = &data.segments[s];
        let trial = &data.trials[segment.trial];
        let plant = replayer.plant(trial, &variants[v]);
        let periods = (segment.duration_s() / period_s).ceil() as usize;
        let stand = if stands_before(&plant, data, s) {
            (STAND_S / period_s).round() as usize
        } else {
            0
        };
        most = most.max(stand + periods);
        let from_s = segment.start_s - stand as f64 * period_s;
        let window_s = (from_s, from_s + (stand + periods) as f64 * period_s);
        readers.push(readers_of(trial, &plant, window_s));
        switches.push(Switches::new(trial, &plant, segment.start_s));
        let signals = readout(trial);
        traces.push(Trace::new(
            signals,
            &plant,
            segment.start_s,
            period_s,
            periods,
        ));
        read.base |= signals.base || segment.again.is_some() || stand > 0;
        read.imu |= signals.imu;
        read.feet |= signals.feet;
        corrections.push(segment.again.as_ref().map(|(at_s, measured)| {
            let after = ((at_s - segment.start_s) / period_s).round() as usize;
            (after, measured)
        }));
        stands.push(stand);
        sound[lane] = start(engine, lane, &plant, &switches[lane], data, s);
        plants.push(plant);
    }
    engine.report_only(read);
    let mut targets = vec![0.0_f32; lanes * joints];
    let wrenches = vec![0.0_f32; lanes * 6];
    for k in 0..=most {
        for (lane, &(_, s)) in jobs.iter().enumerate() {
            let stand = stands[lane];
            if k == stand && stand > 0 && sound[lane] {
                let measured = &data.segments[s].start;
                sound[lane] &= correct(engine, lane, &plants[lane], measured);
            }
            if k >= stand && k - stand < traces[lane].rows() {
                traces[lane].record(engine.state(), lane, &model);
            }
            if let Some((_, measured)) = corrections[lane].filter(|(after, _)| stand + after == k)
                && sound[lane]
            {
                sound[lane] &= correct(engine, lane, &plants[lane], measured);
            }
            let from = data.segments[s].start_s + (k as f64 - stand as f64) * period_s;
            let own = &mut targets[lane * joints..(lane + 1) * joints];
            readers[lane].means(from, from + period_s, own);
            if switches[lane].due(from) && sound[lane] {
                let params = switches[lane].apply(&plants[lane], from);
                sound[lane] &= engine.set_params(lane, &params).is_ok();
            }
        }
        if k < most {
            engine.step(&targets, &wrenches)?;
        }
    }
    let diverged = |state: &State, lane: usize| state.diverged[lane];
    let out = jobs
        .iter()
        .enumerate()
        .map(|(lane, &(_, s))| {
            if !sound[lane] || diverged(engine.state(), lane) {
                return Vec::new();
            }
            observe::predict(&plants[lane], &traces[lane], data, s)
        })
        .collect();
    Ok(out)
}

/// Whether a robot stands before stretch `segment` begins: at the beginning of a run of a held robot whose servos are on, with an integral part.
fn stands_before(plant: &Plant, data: &Data, segment: usize) -> bool {
    let s = &data.segments[segment];
    let trial = &data.trials[s.trial];
    data.hold(segment) == 0
        && s.start_s <= replay_span(trial).0
        && trial
            .enabled
            .iter()
            .flatten()
            .all(|on| on.at(s.start_s) > 0.5)
        && plant.lane.joints.iter().any(|j| j.ki_nm_per_rad_s > 0.0)
}

/// Puts a lane at its measured start. Whether the candidate is physical.
fn start(
    engine: &mut BatchEngine,
    lane: usize,
    plant: &Plant,
    switches: &Switches,
    data: &Data,
    segment: usize,
) -> bool {
    let init = placed(
        plant,
        &data.segments[segment].start,
        data.hold(segment) != 0,
        InitialState::nominal(&plant.model),
    );
    let params = switches.apply(plant, data.segments[segment].start_s);
    let good = engine.set_params(lane, &params).is_ok();
    good && engine.reset(lane, &init).is_ok()
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

/// Puts a lane to what was measured once more; what was not measured stays where the simulation has brought it. Whether that went well.
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
    let init = placed(plant, measured, true, own);
    engine.correct(lane, &init).is_ok()
}

fn readers_of<'a>(trial: &'a Trial, plant: &Plant, window_s: (f64, f64)) -> Readers<'a> {
    let joints = trial
        .commands
        .iter()
        .enumerate()
        .map(|(a, steps)| {
            let delay = plant.lane.command_delay_s + plant.lane.joints[a].command_skew_s;
            Reader::new(
                steps,
                SERVO_TICK_S + f64::from(delay),
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
            refresh_s: if changes {
                from_s + REFRESH_S
            } else {
                f64::INFINITY
            },
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

    /// The engine's parameters at time `t_s`: command delays are in the command stream already, and a servo that is off gives nothing.
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
