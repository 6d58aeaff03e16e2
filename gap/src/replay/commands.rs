//! The command stream of one joint, as the servo hears it: delayed, with frames lost, seen through a wrong
//! encoder, averaged over a step.
//!
//! Which frames were lost in a run nobody knows. The replay hears what a servo hears on average over all ways
//! to lose them: the mean of repeats tends to it, and no single way of losing them is as close to a run whose
//! own way is not known.

use std::borrow::Cow;

use caudata_sim::CommandLoss;
use caudata_sim::sensors::EncoderErrors;

use crate::trial::Steps;

/// The commands of all joints of a robot, read in order of time.
pub(super) struct Readers<'a> {
    joints: Vec<Reader<'a>>,
    /// What each servo has heard last, rad. Beside the readers, so that steps in which no frame arrives are
    /// one short loop. `[A]`
    heard_rad: Vec<f64>,
    /// When the first frame arrives that has not been taken in, s.
    next_s: f64,
    /// Whether every encoder is faultless.
    faultless: bool,
}

impl<'a> Readers<'a> {
    /// One per joint, policy order.
    pub fn new(joints: Vec<Reader<'a>>) -> Self {
        let mut readers = Self {
            faultless: joints.iter().all(|j| j.encoder == EncoderErrors::default()),
            heard_rad: Vec::new(),
            next_s: f64::INFINITY,
            joints,
        };
        readers.look_ahead();
        readers
    }

    /// Takes over what the readers have heard.
    fn look_ahead(&mut self) {
        self.heard_rad.clear();
        self.heard_rad.extend(self.joints.iter().map(|j| j.heard_rad));
        let next = self.joints.iter().map(Reader::next_s);
        self.next_s = next.fold(f64::INFINITY, f64::min);
    }

    /// As [`Reader::mean`], of each joint. `[A]`
    pub fn means(&mut self, from_s: f64, to_s: f64, means_rad: &mut [f32]) {
        if self.faultless && self.next_s >= to_s {
            for (mean, heard) in means_rad.iter_mut().zip(&self.heard_rad) {
                *mean = *heard as f32;
            }
            return;
        }
        for (mean, joint) in means_rad.iter_mut().zip(&mut self.joints) {
            *mean = joint.mean(from_s, to_s) as f32;
        }
        self.look_ahead();
    }
}

/// A stepwise command read in order of time.
pub(super) struct Reader<'a> {
    steps: Cow<'a, Steps>,
    delay_s: f64,
    encoder: EncoderErrors,
    at: usize,
    heard_rad: f64,
}

impl<'a> Reader<'a> {
    pub fn new(
        steps: &'a Steps,
        delay_s: f64,
        encoder: EncoderErrors,
        loss: &CommandLoss,
        window_s: (f64, f64),
    ) -> Self {
        let steps = if loss.share > 0.0 {
            Cow::Owned(heard_on_average(steps, loss, window_s))
        } else {
            Cow::Borrowed(steps)
        };
        let mut reader = Self {
            heard_rad: steps.value.first().copied().unwrap_or(0.0),
            steps,
            delay_s,
            encoder,
            at: 0,
        };
        reader.advance(window_s.0);
        reader
    }

    /// Takes in every frame that has arrived by `t_s`.
    fn advance(&mut self, t_s: f64) {
        while self.next_s() <= t_s {
            self.heard_rad = self.steps.value[self.at];
            self.at += 1;
        }
    }

    fn next_s(&self) -> f64 {
        self.steps.time_s.get(self.at).map_or(f64::INFINITY, |t| t + self.delay_s)
    }

    /// Mean over `[from_s, to_s]`, which follows the last one; as an angle of the joint for which the encoder
    /// would read the command, rad.
    pub fn mean(&mut self, from_s: f64, to_s: f64) -> f64 {
        let mut sum = 0.0;
        let mut since = from_s;
        while self.next_s() < to_s {
            let t = self.next_s().max(since);
            sum += self.heard_rad * (t - since);
            since = t;
            self.advance(t);
        }
        sum += self.heard_rad * (to_s - since);
        let command = if to_s > from_s { sum / (to_s - from_s) } else { self.heard_rad };
        true_angle(&self.encoder, command)
    }
}

/// The angle that an encoder with these errors shows as `shown_rad`.
pub(super) fn true_angle(encoder: &EncoderErrors, shown_rad: f64) -> f64 {
    let e = encoder;
    if *e == EncoderErrors::default() {
        return shown_rad;
    }
    let mut q = (shown_rad - f64::from(e.offset_rad)) / f64::from(1.0 + e.gain);
    if e.eccentricity_rad != 0.0 {
        // a contraction: its slope is the eccentricity, a few hundredths
        for _ in 0..8 {
            let swing =
                f64::from(e.eccentricity_rad) * (q + f64::from(e.eccentricity_phase_rad)).sin();
            q = (shown_rad - f64::from(e.offset_rad) - swing) / f64::from(1.0 + e.gain);
        }
    }
    q
}

/// What an encoder with these errors shows, before counting, rad.
pub(super) fn shown_angle(encoder: &EncoderErrors, q_rad: f64) -> f64 {
    let swing = if encoder.eccentricity_rad == 0.0 {
        0.0
    } else {
        f64::from(encoder.eccentricity_rad)
            * (q_rad + f64::from(encoder.eccentricity_phase_rad)).sin()
    };
    f64::from(1.0 + encoder.gain) * q_rad + swing + f64::from(encoder.offset_rad)
}

/// Current that a servo shows for a motor torque, without counting, A. Its dead band fades in over a
/// hundredth of an ampere.
pub(super) fn shown_current(torque_nm: f64, per_a_nm: f64, band_a: f64) -> f64 {
    let amps = torque_nm / per_a_nm;
    amps + band_a * (amps / 0.01).clamp(-1.0, 1.0)
}

/// A command whose late hearers are off by less than this is heard, rad, …
const HEARD_RAD: f64 = 1e-6;
/// … and after so many bursts it is in any case: a millionth of a millionth is not.
const BURSTS_UNHEARD: f64 = 30.0;

/// What was lost so long before a stretch begins is heard by then, s.
const BEFORE_S: f64 = 2.0;

/// What is heard on average, from `window_s.0` to `window_s.1`, of `steps` over a bus with two states, as the
/// simulator's: bursts of mean length `burst` lose `share` of the frames in all.
fn heard_on_average(steps: &Steps, loss: &CommandLoss, window_s: (f64, f64)) -> Steps {
    let share = f64::from(loss.share.clamp(0.0, 0.9));
    // where more are lost than arrive, single frames cannot be
    let burst = f64::from(loss.burst).max(f64::max(1.0, share / (1.0 - share)));
    // chance that a frame is lost after one that was
    let stay = 1.0 - 1.0 / burst;
    let mut heard = Steps { frame_s: steps.frame_s, ..Steps::default() };
    // what those hear who lost the last frame, on average
    let first = (steps.time_s).partition_point(|&t| t <= window_s.0 - BEFORE_S);
    let first = first.saturating_sub(1);
    let mut stale_rad = steps.value.get(first).copied().unwrap_or(0.0);
    let mut before_rad = stale_rad;
    for (k, (&from_s, &sent_rad)) in (steps.time_s.iter().zip(&steps.value).enumerate()).skip(first)
    {
        if from_s > window_s.1 {
            break;
        }
        let next_s = steps.time_s.get(k + 1);
        let end_s = next_s.map_or(f64::INFINITY, |t| t - 0.5 * steps.frame_s);
        let mut frame = 0.0;
        loop {
            // who lost this frame lost the one before as well, or heard it
            stale_rad = stay * stale_rad + (1.0 - stay) * before_rad;
            before_rad = sent_rad;
            heard.time_s.push(from_s + frame * steps.frame_s);
            heard.value.push(sent_rad + share * (stale_rad - sent_rad));
            frame += 1.0;
            let heard_by_all =
                (stale_rad - sent_rad).abs() < HEARD_RAD || frame > BURSTS_UNHEARD * burst;
            if heard_by_all || steps.frame_s <= 0.0 || from_s + frame * steps.frame_s >= end_s {
                break;
            }
        }
    }
    heard
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHOLE_S: (f64, f64) = (0.0, 100.0);

    #[test]
    fn a_step_within_an_interval_counts_by_its_share() {
        let steps = Steps { time_s: vec![0.0, 1.0], value: vec![0.0, 4.0], ..Steps::default() };
        let mut r =
            Reader::new(&steps, 0.25, EncoderErrors::default(), &CommandLoss::default(), WHOLE_S);
        // arrives at 1.25: half of [1.0, 1.5]
        assert_eq!(r.mean(0.0, 1.0), 0.0);
        assert_eq!(r.mean(1.0, 1.5), 2.0);
        assert_eq!(r.mean(1.5, 2.0), 4.0);
    }

    #[test]
    fn lost_frames_are_heard_as_they_are_on_average() {
        // a third is lost, two in a row on average: one that was lost is followed by another with 1/2. Of a
        // jump from 0 to 3 two thirds hear at once; of the others half hear with the next frame, which says
        // the same, and so on: 3 − 1, 3 − 1/2 …
        let loss = CommandLoss { share: 1.0 / 3.0, burst: 2.0, ..CommandLoss::default() };
        let steps = Steps { time_s: vec![0.0, 1.0], value: vec![0.0, 3.0], frame_s: 0.25 };
        let heard = heard_on_average(&steps, &loss, WHOLE_S);
        assert_eq!(heard.time_s[..4], [0.0, 1.0, 1.25, 1.5]);
        for (value, expected) in heard.value.iter().zip([0.0, 2.0, 2.5, 2.75]) {
            assert!((value - expected).abs() < 1e-6, "{value}");
        }
        // it ends: 3·2⁻ⁿ/3·… falls below a millionth after some twenty frames
        assert!(heard.value.len() < 30);
        // lost one at a time: who did not hear a frame heard the one before, and hears the next. 1, 4, 9 are
        // heard as 1 − 1/4, 4 − 3/4, 9 − 5/4
        let loss = CommandLoss { share: 0.25, burst: 1.0, ..CommandLoss::default() };
        let steps = Steps {
            time_s: vec![0.0, 1.0, 2.0, 3.0],
            value: vec![0.0, 1.0, 4.0, 9.0],
            frame_s: 1.0,
        };
        let heard = heard_on_average(&steps, &loss, WHOLE_S);
        let expected = [0.0, 0.75, 3.25, 7.75, 9.0];
        for (value, expected) in heard.value.iter().zip(expected) {
            assert!((value - expected).abs() < 1e-9, "{value}");
        }
        assert_eq!(heard.value.len(), expected.len());
        // a stretch of it is heard as the whole is
        let long = Steps {
            time_s: (0..50).map(f64::from).collect(),
            value: (0..50).map(|k| f64::from(k % 7)).collect(),
            frame_s: 1.0,
        };
        let whole = heard_on_average(&long, &loss, WHOLE_S);
        let part = heard_on_average(&long, &loss, (20.0, 30.0));
        assert!(part.time_s.first() > Some(&10.0) && part.time_s.last() < Some(&32.0));
        for k in 200..300 {
            let t = 0.1 * f64::from(k);
            assert_eq!(part.at(t), whole.at(t), "{t}");
        }
        // 9 of 10 lost one at a time is not possible; a command that stands is heard all the same
        let most = CommandLoss { share: 0.9, ..loss };
        let still = Steps { time_s: vec![0.0], value: vec![0.3], frame_s: 1.0 };
        assert_eq!(heard_on_average(&still, &most, WHOLE_S).value, [0.3]);
    }

    #[test]
    fn joints_read_together_read_as_they_do_alone() {
        let steps = [0.3, 0.7].map(|shift| Steps {
            time_s: vec![0.0, 0.011 + shift, 0.9],
            value: vec![0.1, shift, -0.3],
            ..Steps::default()
        });
        let reader = |joint: usize| {
            Reader::new(
                &steps[joint],
                0.0006,
                EncoderErrors::default(),
                &CommandLoss::default(),
                WHOLE_S,
            )
        };
        let mut together = Readers::new(vec![reader(0), reader(1)]);
        let mut alone = [reader(0), reader(1)];
        for k in 0..600 {
            let from_s = 0.002 * f64::from(k);
            let mut means = [0.0; 2];
            together.means(from_s, from_s + 0.002, &mut means);
            let expected = (alone.each_mut()).map(|r| r.mean(from_s, from_s + 0.002) as f32);
            assert_eq!(means, expected, "step {k}");
        }
    }

    #[test]
    fn a_wrong_encoder_shifts_what_is_aimed_at() {
        let e = EncoderErrors {
            gain: 0.25,
            offset_rad: 0.5,
            eccentricity_rad: 0.02,
            eccentricity_phase_rad: 0.3,
        };
        let q = true_angle(&e, 1.0);
        assert!((shown_angle(&e, q) - 1.0).abs() < 1e-9);
        // without eccentricity (1 − 0.5)/1.25 = 0.4
        let e = EncoderErrors { eccentricity_rad: 0.0, ..e };
        assert!((true_angle(&e, 1.0) - 0.4).abs() < 1e-12);
    }
}
