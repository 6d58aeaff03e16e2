//! The command stream of one joint, as the servo hears it: delayed, with frames lost, seen through a wrong encoder, averaged over a step.

use caudata_model::ServoParams;
use caudata_random::{Key, Purpose, Stream};
use caudata_sim::CommandLoss;
use caudata_sim::sensors::EncoderErrors;

use crate::trial::Steps;

/// The commands of all joints of a robot, read in order of time.
pub(super) struct Readers<'a> {
    joints: Vec<Reader<'a>>,
    /// What each servo has heard last, rad. Beside the readers, so that steps in which no frame arrives are one short loop. `[A]`
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
        self.heard_rad
            .extend(self.joints.iter().map(|j| j.heard_rad));
        let next = self.joints.iter().map(Reader::next_s);
        self.next_s = next.fold(f64::INFINITY, f64::min);
    }

    /// As [`Reader::mean`], of each joint. `[A]`
    pub fn means(&mut self, from_s: f64, to_s: f64, means_rad: &mut [f32]) {
        let length_s = to_s - from_s;
        if self.faultless && self.next_s >= to_s && length_s > 0.0 {
            for (mean, heard) in means_rad.iter_mut().zip(&self.heard_rad) {
                // as in `Reader::mean`, to the bit: a product and a quotient are not the number itself
                *mean = ((0.0 + heard * length_s) / length_s) as f32;
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
    steps: &'a Steps,
    delay_s: f64,
    encoder: EncoderErrors,
    /// Frames that arrive; `None`: all.
    arrive: Option<Vec<bool>>,
    at: usize,
    heard_rad: f64,
}

impl<'a> Reader<'a> {
    pub fn new(
        steps: &'a Steps,
        delay_s: f64,
        encoder: EncoderErrors,
        loss: &CommandLoss,
        from_s: f64,
    ) -> Self {
        let arrive = (loss.share > 0.0).then(|| arrivals(steps.value.len(), loss));
        let mut reader = Self {
            steps,
            delay_s,
            encoder,
            arrive,
            at: 0,
            heard_rad: steps.value.first().copied().unwrap_or(0.0),
        };
        reader.advance(from_s);
        reader
    }

    /// Takes in every frame that has arrived by `t_s`.
    fn advance(&mut self, t_s: f64) {
        while self.next_s() <= t_s {
            let arrives = self.arrive.as_ref().is_none_or(|a| a[self.at]);
            if arrives {
                self.heard_rad = self.steps.value[self.at];
            }
            self.at += 1;
        }
    }

    fn next_s(&self) -> f64 {
        self.steps
            .time_s
            .get(self.at)
            .map_or(f64::INFINITY, |t| t + self.delay_s)
    }

    /// Mean over `[from_s, to_s]`, which follows the last one; as an angle of the joint for which the encoder would read the command, rad.
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
        let command = if to_s > from_s {
            sum / (to_s - from_s)
        } else {
            self.heard_rad
        };
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

/// Current that a servo shows for a motor torque, without counting, A. Its dead band fades in over a hundredth of an ampere.
pub(super) fn shown_current(
    servo: &ServoParams,
    torque_nm: f64,
    per_a_nm: f64,
    band_a: f64,
) -> f64 {
    let _ = servo;
    let amps = torque_nm / per_a_nm;
    amps + band_a * (amps / 0.01).clamp(-1.0, 1.0)
}

/// Two states, as in the simulator's bus: bursts of mean length `burst` lose `share` of the frames in all.
fn arrivals(frames: usize, loss: &CommandLoss) -> Vec<bool> {
    let burst = f64::from(loss.burst.max(1.0));
    let share = f64::from(loss.share.clamp(0.0, 0.9));
    let mut stream = Stream::new(Key::for_run(loss.seed), Purpose::CommandLoss);
    let mut lost = false;
    (0..frames)
        .map(|_| {
            let chance = if lost {
                1.0 - 1.0 / burst
            } else {
                share / (burst * (1.0 - share))
            };
            lost = f64::from(stream.uniform(0.0, 1.0)) < chance;
            !lost
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_within_an_interval_counts_by_its_share() {
        let steps = Steps {
            time_s: vec![0.0, 1.0],
            value: vec![0.0, 4.0],
        };
        let mut r = Reader::new(
            &steps,
            0.25,
            EncoderErrors::default(),
            &CommandLoss::default(),
            0.0,
        );
        // arrives at 1.25: half of [1.0, 1.5]
        assert_eq!(r.mean(0.0, 1.0), 0.0);
        assert_eq!(r.mean(1.0, 1.5), 2.0);
        assert_eq!(r.mean(1.5, 2.0), 4.0);
    }

    #[test]
    fn joints_read_together_read_as_they_do_alone() {
        let steps = [0.3, 0.7].map(|shift| Steps {
            time_s: vec![0.0, 0.011 + shift, 0.9],
            value: vec![0.1, shift, -0.3],
        });
        let reader = |joint: usize| {
            Reader::new(
                &steps[joint],
                0.0006,
                EncoderErrors::default(),
                &CommandLoss::default(),
                0.0,
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
        let e = EncoderErrors {
            eccentricity_rad: 0.0,
            ..e
        };
        assert!((true_angle(&e, 1.0) - 0.4).abs() < 1e-12);
    }
}
