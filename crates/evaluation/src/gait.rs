//! What a robot does, measured from its trace.

use caudata_task::{PerFoot, PerJoint};
use serde::Serialize;

use crate::anatomy::Anatomy;
use crate::envelope::Envelope;
use crate::posture::Posture;
use crate::spectrum::{Spectrum, Welch};
use crate::stride::Stride;
use crate::trace::{Frame, Trace};

/// Standard gravity, m/s².
const GRAVITY_MPS2: f64 = 9.81;
/// Slowest stride that is looked for, Hz.
const SLOWEST_STRIDE_HZ: f64 = 0.3;
/// Shortest trace that can be measured, s: two strides at 1.25 Hz.
pub const SHORTEST_S: f64 = 1.6;

/// How to measure.
#[derive(Clone, Debug)]
pub struct Measure {
    /// Time left out at the start of an episode, s: the robot speeds up.
    pub settle_s: f64,
    /// Vertical force from which a foot counts as in contact, N.
    pub contact_force_n: f64,
    /// Force on the trunk from which it counts as in contact, N.
    pub trunk_force_n: f64,
    /// Mass of the robot, kg.
    pub mass_kg: f64,
    /// How it is built.
    pub anatomy: Anatomy,
    /// Joint power above this is vibration, not walking, Hz.
    pub vibration_hz: f64,
    /// What each of its servos can give.
    pub envelopes: Vec<Envelope>,
}

/// One episode in figures. Means are over its frames after settling.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Gait {
    /// Mean velocity of the whole body, heading frame, m/s.
    pub velocity_mps: [f64; 2],
    /// Forward velocity over the commanded one; 1 where none is commanded.
    pub speed_share: f64,
    /// Mean yaw rate, rad/s.
    pub yaw_rate_radps: f64,
    /// Root mean square of velocity x, y (m/s) and yaw rate (rad/s), each averaged over whole strides, minus
    /// the command.
    pub tracking_rmse: [f64; 3],
    /// Speed over the ground in a straight line: way from first to last frame over time, m/s.
    pub drift_mps: f64,
    /// The same along the heading of the first frame: negative where it came back, m/s.
    pub ahead_mps: f64,
    /// Strongest frequency in the height of the feet, Hz; 0 where the feet do not move.
    pub stride_hz: f64,
    /// Frequency that the gait clock asks for, Hz.
    pub clock_hz: f64,
    /// Share of time that each foot is on the ground.
    pub duty_factor: PerFoot<f64>,
    /// Height that each foot reaches above the ground, mean over strides, m.
    pub clearance_m: PerFoot<f64>,
    /// Mean horizontal speed of a foot in the middle of its stance (on the ground the step before and after
    /// as well), m/s.
    pub slip_mps: f64,
    /// Share of time with the trunk or a leg (but not its foot) on the ground.
    pub trunk_contact_share: f64,
    /// Mean of Σ|q̇τ|, W.
    pub power_w: f64,
    /// Power over weight times speed along the way, 1; infinite where it stands.
    pub cost_of_transport: f64,
    /// Share of the mechanical power of the joints at frequencies above [`Measure::vibration_hz`].
    pub vibration_share: f64,
    /// Largest torque of any motor, N·m.
    pub torque_peak_nm: f64,
    /// Root mean square of the torque of all motors, N·m.
    pub torque_rms_nm: f64,
    /// Share of time and motors at 95 % or more of what the servo can give at that speed.
    pub servo_limit_share: f64,
    /// Largest speed of any joint, rad/s.
    pub joint_speed_peak_radps: f64,
    /// Root mean square of the acceleration of all joints (difference of velocities), rad/s²: how smooth the
    /// motion is.
    pub joint_accel_rms_radps2: f64,
    /// What an eye sees.
    pub posture: Posture,
    /// How limbs and trunk go together; `None` for robots without two girdles.
    pub stride: Option<Stride>,
}

impl Gait {
    /// Measures an episode; `None` if fewer than [`SHORTEST_S`] of it are left after settling.
    pub fn of(trace: &Trace, measure: &Measure) -> Option<Self> {
        let frames = trace.after(measure.settle_s);
        if (frames.len() as f64) * trace.period_s < SHORTEST_S {
            return None;
        }
        let spectrum = Spectrum::new(frames.len(), 1.0 / trace.period_s);
        let speed = |f: &Frame| f64::from(f.velocity_mps[0]).hypot(f64::from(f.velocity_mps[1]));
        let power_w = mean(frames, |f| f.power_w.iter().map(|&p| f64::from(p.abs())).sum());
        let duty_factor = PerFoot::from_fn(feet_of(frames), |foot| {
            mean(frames, |f| f64::from(on_ground(f, foot, measure)))
        });
        let velocity_mps = [0, 1].map(|i| mean(frames, |f| f64::from(f.velocity_mps[i])));
        let along = velocity_mps[0].hypot(velocity_mps[1]);
        let time_s = trace.period_s * (frames.len() - 1) as f64;
        Some(Self {
            velocity_mps,
            speed_share: match mean(frames, |f| f64::from(f.command[0])) {
                0.0 => 1.0,
                commanded => velocity_mps[0] / commanded,
            },
            yaw_rate_radps: mean(frames, |f| f64::from(f.yaw_rate_radps)),
            tracking_rmse: tracking_rmse(frames, stride_frames(trace)),
            drift_mps: way_m(frames).map_or(0.0, |[x, y]| x.hypot(y)) / time_s,
            ahead_mps: way_m(frames).map_or(0.0, |[x, _]| x) / time_s,
            stride_hz: stride_hz(frames, &spectrum),
            clock_hz: trace.clock_hz,
            duty_factor,
            clearance_m: clearance_m(frames, stride_frames(trace)),
            slip_mps: slip_mps(frames, measure),
            trunk_contact_share: mean(frames, |f| {
                f64::from(u8::from(f64::from(f.trunk_force_n) > measure.trunk_force_n))
            }),
            power_w,
            cost_of_transport: power_w
                / (measure.mass_kg * GRAVITY_MPS2 * along.min(mean(frames, speed))),
            vibration_share: vibration_share(frames, trace.period_s, measure.vibration_hz),
            torque_peak_nm: peak(frames, |f| &f.torque_nm),
            torque_rms_nm: mean(frames, |f| mean_square(&f.torque_nm)).sqrt(),
            servo_limit_share: mean(frames, |f| at_limit(f, &measure.envelopes)),
            joint_speed_peak_radps: peak(frames, |f| &f.joint_vel_radps),
            joint_accel_rms_radps2: accel_rms(frames, trace.period_s),
            posture: Posture::of(frames, &duty_factor, &measure.anatomy),
            stride: Stride::of(
                frames,
                stride_frames(trace),
                &spectrum,
                &measure.anatomy,
                &|f, foot| on_ground(f, foot, measure) == 1,
            ),
        })
    }
}

/// Frames of one stride of the clock, at least one.
fn stride_frames(trace: &Trace) -> usize {
    ((1.0 / (trace.clock_hz.max(SLOWEST_STRIDE_HZ) * trace.period_s)).round() as usize).max(1)
}

fn mean(frames: &[Frame], value: impl Fn(&Frame) -> f64) -> f64 {
    frames.iter().map(value).sum::<f64>() / frames.len().max(1) as f64
}

fn mean_square(values: &[f32]) -> f64 {
    let sum: f64 = values.iter().map(|&v| f64::from(v).powi(2)).sum();
    sum / values.len().max(1) as f64
}

fn peak(frames: &[Frame], values: impl Fn(&Frame) -> &[f32]) -> f64 {
    let all = frames.iter().flat_map(|f| values(f).iter());
    all.fold(0.0, |most, v| most.max(f64::from(v.abs())))
}

fn accel_rms(frames: &[Frame], period_s: f64) -> f64 {
    let squares = frames.windows(2).map(|w| {
        let (before, after) = (&w[0].joint_vel_radps, &w[1].joint_vel_radps);
        let change = PerJoint::from_fn(after.len(), |j| after[j] - before[j]);
        mean_square(&change) / (period_s * period_s)
    });
    (squares.sum::<f64>() / (frames.len() - 1) as f64).sqrt()
}

/// Share of the motors that give all they can.
fn at_limit(frame: &Frame, envelopes: &[Envelope]) -> f64 {
    let motors = frame.torque_nm.iter().zip(&frame.joint_vel_radps).zip(envelopes);
    let reached = motors.filter(|((t, v), own)| own.is_reached(f64::from(**t), f64::from(**v)));
    reached.count() as f64 / frame.torque_nm.len().max(1) as f64
}

/// How many feet the robot of these frames has.
fn feet_of(frames: &[Frame]) -> usize {
    frames.first().map_or(0, |f| f.foot_height_m.len())
}

fn on_ground(frame: &Frame, foot: usize, measure: &Measure) -> u8 {
    u8::from(f64::from(frame.foot_force_n[foot]) > measure.contact_force_n)
}

/// Way from the first frame to the last, ahead and to the left of the first one, m.
fn way_m(frames: &[Frame]) -> Option<[f64; 2]> {
    let (first, last) = (frames.first()?, frames.last()?);
    let [x, y] = [0, 1].map(|i| f64::from(last.com_m[i] - first.com_m[i]));
    let (sin, cos) = f64::from(first.heading_rad).sin_cos();
    Some([cos * x + sin * y, cos * y - sin * x])
}

/// Averages over whole strides, because a trunk that bends sways about its mean velocity.
fn tracking_rmse(frames: &[Frame], stride: usize) -> [f64; 3] {
    let strides = frames.chunks_exact(stride.min(frames.len()));
    let n = strides.len() as f64;
    let mut squares = [0.0; 3];
    for stride in strides {
        let errors = [
            mean(stride, |f| f64::from(f.velocity_mps[0] - f.command[0])),
            mean(stride, |f| f64::from(f.velocity_mps[1] - f.command[1])),
            mean(stride, |f| f64::from(f.yaw_rate_radps - f.command[2])),
        ];
        for (sum, error) in squares.iter_mut().zip(errors) {
            *sum += error * error / n;
        }
    }
    squares.map(f64::sqrt)
}

fn stride_hz(frames: &[Frame], spectrum: &Spectrum) -> f64 {
    let mut power = vec![0.0; spectrum.bins()];
    for foot in 0..feet_of(frames) {
        let heights = spectrum.of(frames.iter().map(|f| f64::from(f.foot_height_m[foot])));
        for (sum, c) in power.iter_mut().zip(&heights) {
            *sum += c.norm_sqr();
        }
    }
    spectrum.peak_hz(&power, SLOWEST_STRIDE_HZ).unwrap_or(0.0)
}

fn clearance_m(frames: &[Frame], stride: usize) -> PerFoot<f64> {
    PerFoot::from_fn(feet_of(frames), |foot| {
        let strides = frames.chunks_exact(stride.min(frames.len()));
        let n = strides.len() as f64;
        let highest = |s: &[Frame]| {
            s.iter().fold(f64::MIN, |top, f| top.max(f64::from(f.foot_height_m[foot])))
        };
        strides.map(highest).sum::<f64>() / n
    })
}

fn slip_mps(frames: &[Frame], measure: &Measure) -> f64 {
    let (mut sum, mut n) = (0.0, 0_u32);
    for w in frames.windows(3) {
        for foot in 0..feet_of(frames) {
            if w.iter().all(|f| on_ground(f, foot, measure) == 1) {
                sum += f64::from(w[1].foot_speed_mps[foot]);
                n += 1;
            }
        }
    }
    sum / f64::from(n.max(1))
}

/// The share of joint power above [`Measure::vibration_hz`], from Welch's cross-spectrum P of speed and
/// torque of each joint, in segments of 2 s: Σ_joints Σ_fast bands │Σ_band P│ over the same plus Σ_joints Σ_slow bins │P│.
///
/// Below the limit a joint may drive at one harmonic of its stride and be driven at another; both are work,
/// so each bin counts by itself. Above it the sign is kept within each of two bands: speed and torque that
/// have nothing in common cancel there instead of adding up, which a vibration (one line that drives) does
/// not. Two bands, so that a joint that drives at 7 Hz and brakes at 14 Hz does not cancel either.
///
/// Speeds are means over each step, as torques are: the speed at the end of a step would fold motion faster
/// than half the control rate (a foot that touches down) into the bins that are looked at.
fn vibration_share(frames: &[Frame], period_s: f64, vibration_hz: f64) -> f64 {
    const SEGMENT_S: f64 = 2.0;
    let welch = Welch::new(frames.len() - 1, 1.0 / period_s, SEGMENT_S);
    let (mut above, mut all) = (0.0, 0.0);
    for joint in 0..frames[0].joint_pos_rad.len() {
        let pos = |f: &Frame| f64::from(f.joint_pos_rad[joint]);
        let speeds: Vec<f64> =
            frames.windows(2).map(|w| (pos(&w[1]) - pos(&w[0])) / period_s).collect();
        let torques: Vec<f64> = frames[1..].iter().map(|f| f64::from(f.torque_nm[joint])).collect();
        let mut bands = [0.0; 2];
        for (k, power) in welch.in_phase(&speeds, &torques).into_iter().enumerate() {
            match welch.frequency_hz(k) {
                hz if hz > 2.0 * vibration_hz => bands[1] += power,
                hz if hz > vibration_hz => bands[0] += power,
                _ => all += power.abs(),
            }
        }
        let fast: f64 = bands.iter().map(|p| p.abs()).sum();
        above += fast;
        all += fast;
    }
    if all > 0.0 { above / all } else { 0.0 }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::envelope::tests::W210;
    use caudata_random::{Key, Purpose, Stream};
    use std::f64::consts::{PI, TAU};

    const ACT_DIM: usize = 16;

    /// Eight joints of the body, then two of each leg.
    pub(crate) const IN_LEG: [bool; ACT_DIM] = {
        let mut in_leg = [false; ACT_DIM];
        in_leg.split_at_mut(8).1.copy_from_slice(&[true; 8]);
        in_leg
    };

    pub(crate) fn measure() -> Measure {
        Measure {
            settle_s: 2.0,
            contact_force_n: 1.0,
            trunk_force_n: 1.0,
            mass_kg: 2.6,
            anatomy: Anatomy {
                in_leg: IN_LEG.into(),
                ..Anatomy::of(&crate::anatomy::tests::polymander())
            },
            vibration_hz: 6.0,
            envelopes: vec![W210; ACT_DIM],
        }
    }

    /// A robot that trots at `stride_hz` with 0.3 m/s for 12 s, with a vibration of `shake` (0 to 1) of its
    /// joint speed at 8 Hz.
    pub(crate) fn trot(stride_hz: f64, shake: f64) -> Trace {
        let frames = (0..600).map(|i| {
            let t = f64::from(i) * 0.02;
            let mut frame = Frame {
                command: [0.3, 0.0, 0.0],
                velocity_mps: [0.3, 0.02 * (TAU * stride_hz * t).sin() as f32],
                com_m: [0.3 * t as f32, 0.0, 0.1],
                ..Frame::still(ACT_DIM, 4)
            };
            for foot in 0..4 {
                let phase = TAU * stride_hz * t + if foot == 1 || foot == 2 { PI } else { 0.0 };
                // in the air for the first half of each cycle, up to 5 cm
                let lift = phase.sin();
                frame.foot_height_m[foot] = (0.05 * lift.max(0.0)) as f32;
                frame.foot_force_n[foot] = if lift > 0.0 { 0.0 } else { 12.0 };
                frame.foot_speed_mps[foot] = if lift > 0.0 { 0.6 } else { 0.02 };
            }
            let (slow, fast) = (TAU * stride_hz, TAU * 8.0);
            let angle = |t: f64| {
                2.0 * ((1.0 - shake) * (slow * t).sin() / slow + shake * (fast * t).sin() / fast)
            };
            let speed = 2.0 * ((1.0 - shake) * (slow * t).cos() + shake * (fast * t).cos());
            let mean_speed = (angle(t) - angle(t - 0.02)) / 0.02;
            frame.joint_pos_rad = [angle(t) as f32; ACT_DIM].into();
            frame.joint_vel_radps = [speed as f32; ACT_DIM].into();
            frame.torque_nm = [(0.2 * mean_speed) as f32; ACT_DIM].into();
            frame.power_w = [(0.2 * speed * speed) as f32; ACT_DIM].into();
            // a tail that trails
            frame.power_w[5..8].fill((0.05 * speed * speed) as f32);
            frame
        });
        Trace { period_s: 0.02, clock_hz: stride_hz, frames: frames.collect(), fell: None }
    }

    fn near(got: f64, want: f64, by: f64) {
        assert!((got - want).abs() <= by, "got {got}, want {want}");
    }

    #[test]
    fn a_trot_by_hand() {
        let gait = Gait::of(&trot(1.4, 0.0), &measure()).unwrap();
        near(gait.stride_hz, 1.4, 0.03);
        near(gait.velocity_mps[0], 0.3, 1e-6);
        near(gait.drift_mps, 0.3, 1e-4);
        near(gait.ahead_mps, 0.3, 1e-4);
        near(gait.duty_factor[0], 0.5, 0.02);
        near(gait.clearance_m[3], 0.05, 0.001);
        near(gait.slip_mps, 0.02, 1e-6);
        // 13 joints · 0.2·(2·cos)² = 13·0.2·4·½ = 5.2 W, three of the tail 0.3 W; 5.5/(2.6·9.81·0.3) = 0.719
        near(gait.power_w, 5.5, 0.05);
        near(gait.cost_of_transport, 0.719, 0.01);
        near(gait.torque_peak_nm, 0.4, 0.002);
        near(gait.joint_speed_peak_radps, 2.0, 0.005);
        // acceleration 2·2π·1.4·sin: 17.59/√2 = 12.44 rad/s²
        near(gait.joint_accel_rms_radps2, 12.44, 0.1);
        assert!(gait.vibration_share < 0.01);
        // sway averages out over whole strides
        assert!(gait.tracking_rmse.iter().all(|e| *e < 2e-3), "{:?}", gait.tracking_rmse);
        assert_eq!(gait.trunk_contact_share, 0.0);
    }

    #[test]
    fn who_comes_back_is_as_far_off_and_not_ahead() {
        let mut trace = trot(1.4, 0.0);
        for frame in &mut trace.frames {
            frame.com_m[0] = -frame.com_m[0];
        }
        let gait = Gait::of(&trace, &measure()).unwrap();
        near(gait.drift_mps, 0.3, 1e-4);
        near(gait.ahead_mps, -0.3, 1e-4);
    }

    #[test]
    fn vibration_is_power_above_six_hertz() {
        // Equal amplitudes; the means over 20 ms of the 8 Hz part are smaller by sin(x)/x, x = π·8·0.02:
        // 0.9583, so its share is 0.9583²/(1 + 0.9583²) = 0.479
        let gait = Gait::of(&trot(1.4, 0.5), &measure()).unwrap();
        near(gait.vibration_share, 0.479, 0.01);
    }

    #[test]
    fn a_small_vibration_on_a_slow_gait_counts_in_full() {
        // A fifth of the speed at 8 Hz, four fifths at 1.25 Hz: (0.2·0.9583)²/(0.8² + (0.2·0.9583)²) = 0.0543
        let gait = Gait::of(&trot(1.25, 0.2), &measure()).unwrap();
        near(gait.vibration_share, 0.0543, 0.002);
    }

    #[test]
    fn noise_on_a_quiet_gait_is_not_vibration() {
        // White noise of its own on each position and each torque, which has no power in common. The mean
        // over many bins of |Re| of single bins does not know that: it gives over 5 % here. With signs kept
        // what is left is a tenth of that, and falls with the length.
        let mut stream = Stream::new(Key::for_run(3), Purpose::Sensor);
        let mut trace = trot(1.4, 0.0);
        for frame in &mut trace.frames {
            for j in 0..ACT_DIM {
                frame.joint_pos_rad[j] += 0.0065 * stream.normal();
                frame.torque_nm[j] += 0.13 * stream.normal();
            }
        }
        let gait = Gait::of(&trace, &measure()).unwrap();
        assert!(gait.vibration_share < 0.015, "{}", gait.vibration_share);
    }

    #[test]
    fn a_joint_that_drives_and_brakes_at_fast_harmonics_still_vibrates() {
        // 7.5 Hz driven with torque along the speed, 15 Hz braked: the signed sum is near 0, the bands are
        // not
        let mut trace = trot(1.4, 0.0);
        for (i, frame) in trace.frames.iter_mut().enumerate() {
            let t = i as f64 * 0.02;
            let speed = |hz: f64| (TAU * hz * t).cos();
            let way = |hz: f64| (TAU * hz * t).sin() / (TAU * hz);
            let (slow, fast) = (speed(7.5), speed(15.0));
            frame.joint_pos_rad = [(way(7.5) + way(15.0)) as f32; ACT_DIM].into();
            frame.torque_nm = [(0.2 * slow - 0.2 * fast) as f32; ACT_DIM].into();
        }
        let gait = Gait::of(&trace, &measure()).unwrap();
        assert!(gait.vibration_share > 0.95, "{}", gait.vibration_share);
    }

    #[test]
    fn a_short_episode_is_not_measured() {
        let mut trace = trot(1.4, 0.0);
        trace.frames.truncate(150);
        assert_eq!(Gait::of(&trace, &measure()), None);
    }
}
