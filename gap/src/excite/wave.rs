//! A joint's command over time, put together from pieces that respect its limits. Places are in the joint's
//! own unit; sizes and speeds of motions are angles, and of a slide so many of what counts as a radian.

use std::f64::consts::{PI, TAU};

use super::limits::JointLimits;

/// A command being written, one value per row.
pub struct Wave<'a> {
    /// Limits of the joint.
    pub limits: &'a JointLimits,
    /// 1 or −1: joints alternate, so that they can be told apart and a chain does not curl up.
    pub sign: f64,
    /// About 1, different for each joint: factor on frequencies and speeds, for the same reason.
    pub pace: f64,
    /// Factor on sizes and speeds of motions, 0 to 1: less than 1 where a joint is too heavy for the whole of
    /// it.
    pub scale: f64,
    rate_hz: f64,
    rad: Vec<f64>,
    on: Vec<bool>,
    powered: bool,
}

impl<'a> Wave<'a> {
    /// A command that begins at the nominal position.
    pub fn new(limits: &'a JointLimits, rate_hz: f64, sign: f64, pace: f64) -> Self {
        Self {
            limits,
            sign,
            pace,
            scale: 1.0,
            rate_hz,
            rad: vec![limits.nominal_rad],
            on: vec![true],
            powered: true,
        }
    }

    /// Rows and switch of the finished command.
    pub fn finish(self) -> (Vec<f64>, Vec<bool>) {
        (self.rad, self.on)
    }

    /// The last command, rad.
    pub fn now(&self) -> f64 {
        self.rad.last().copied().unwrap_or(self.limits.nominal_rad)
    }

    /// A place in what may be held: −1 the lower end, 0 the nominal position, 1 the upper end, turned by the
    /// joint's sign.
    pub fn place(&self, x: f64) -> f64 {
        self.between(self.limits.hold_rad, self.sign * x)
    }

    /// The same in the whole range, for moving through.
    pub fn far(&self, x: f64) -> f64 {
        self.between(self.limits.range_rad, self.sign * x)
    }

    fn between(&self, (low, high): (f64, f64), x: f64) -> f64 {
        let middle = self.limits.nominal_rad.clamp(low, high);
        if x < 0.0 { middle + x * (middle - low) } else { middle + x * (high - middle) }
    }

    /// How far the command may swing about `centre_rad` on both sides, rad.
    pub fn room(&self, centre_rad: f64) -> f64 {
        let (low, high) = self.limits.range_rad;
        (centre_rad - low).min(high - centre_rad).max(0.0)
    }

    /// A way as a size: in radians, or so many of what counts as one.
    pub fn as_size(&self, way: f64) -> f64 {
        way / self.limits.per_radian
    }

    /// How far a motion of this size goes about `centre_rad`.
    pub fn reach(&self, centre_rad: f64, size_rad: f64) -> f64 {
        (self.scale * size_rad * self.limits.per_radian).min(self.room(centre_rad))
    }

    fn rows(&self, s: f64) -> usize {
        (s * self.rate_hz).round().max(1.0) as usize
    }

    fn put(&mut self, rad: f64) {
        let (low, high) = self.limits.range_rad;
        self.rad.push(rad.clamp(low, high));
        self.on.push(self.powered);
    }

    /// Stays for `s` seconds (in the joint's pace).
    pub fn hold(&mut self, s: f64) {
        let now = self.now();
        for _ in 0..self.rows(s * self.pace) {
            self.put(now);
        }
    }

    /// Goes there smoothly, not faster than a third of what it may.
    pub fn go(&mut self, to_rad: f64) {
        let from = self.now();
        let way = (to_rad - from).abs();
        // a cosine's greatest speed is π/2 of its mean, its greatest acceleration π²/2·way/s²
        let by_speed = PI / 2.0 * way / (self.limits.speed_radps / 3.0);
        let by_torque = (PI * PI / 2.0 * way / (self.limits.acceleration_radps2 / 3.0)).sqrt();
        let n = self.rows(by_speed.max(by_torque).max(0.3));
        for k in 1..=n {
            let x = k as f64 / n as f64;
            self.put(from + (to_rad - from) * 0.5 * (1.0 - (PI * x).cos()));
        }
    }

    /// Jumps there and stays for `s` seconds.
    pub fn step(&mut self, to_rad: f64, s: f64) {
        self.put(to_rad);
        self.hold(s);
    }

    /// Goes to and fro about `centre_rad` at a constant speed (of the joint's pace), slower where the joint
    /// is too heavy to turn round in a third of the way.
    pub fn triangle(&mut self, centre_rad: f64, size_rad: f64, speed_radps: f64, cycles: f64) {
        let size = self.reach(centre_rad, size_rad);
        // turning round from −v to v takes 2v/a; the way there and back 2·size/v
        let turn = (0.3 * size * self.limits.acceleration_radps2).sqrt();
        let (own, limits) = (self.limits.per_radian, self.limits);
        let speed = (speed_radps * self.pace * self.scale * own)
            .min(limits.speed_radps)
            .min(turn)
            .max(1e-3 * own);
        self.go(centre_rad);
        let n = self.rows(4.0 * size / speed * cycles);
        for k in 1..=n {
            let x = k as f64 / n as f64 * 4.0 * cycles;
            let p = (x + 1.0).rem_euclid(4.0);
            let y = if p < 2.0 { p - 1.0 } else { 3.0 - p };
            self.put(centre_rad + self.sign * size * y);
        }
    }

    /// A sine whose frequency grows from `low_hz` to `high_hz` in `s` seconds; its size falls where speed or
    /// torque would be too much.
    pub fn chirp(&mut self, centre_rad: f64, size_rad: f64, low_hz: f64, high_hz: f64, s: f64) {
        let size = self.reach(centre_rad, size_rad);
        self.go(centre_rad);
        let n = self.rows(s);
        let mut phase = 0.0;
        for k in 1..=n {
            let x = k as f64 / n as f64;
            let hz = low_hz * (high_hz / low_hz).powf(x) * self.pace;
            phase += TAU * hz / self.rate_hz;
            let fade = (8.0 * x).min(8.0 * (1.0 - x)).min(1.0);
            self.put(centre_rad + self.sign * fade * self.limits.sine_rad(size, hz) * phase.sin());
        }
    }

    /// A sine of one frequency for whole periods of about `s` seconds.
    pub fn sine(&mut self, centre_rad: f64, size_rad: f64, hz: f64, s: f64) {
        let hz = hz * self.pace;
        let size = self.limits.sine_rad(self.reach(centre_rad, size_rad), hz);
        self.go(centre_rad);
        let periods = (s * hz).round().max(1.0);
        let n = self.rows(periods / hz);
        for k in 1..=n {
            let x = k as f64 / n as f64;
            let fade = (periods * x).min(periods * (1.0 - x)).min(1.0);
            self.put(centre_rad + self.sign * fade * size * (TAU * periods * x).sin());
        }
    }

    /// Jumps between two places after a fixed pseudo-random sequence (shift register of 7 bits, x⁷ + x⁶ + 1),
    /// `bit_s` each.
    pub fn prbs(&mut self, centre_rad: f64, size_rad: f64, bit_s: f64, bits: usize) {
        let size = self.limits.jump_rad(self.reach(centre_rad, size_rad), bit_s);
        self.go(centre_rad);
        // a start of its own for each joint: sequences that are shifted against each other hardly go together
        let mut register: u8 = 1 + (self.limits.index as u8).wrapping_mul(37) % 126;
        for _ in 0..bits {
            let bit = (register >> 6 ^ register >> 5) & 1;
            register = (register << 1 | bit) & 0x7f;
            self.put(centre_rad + if bit == 1 { size } else { -size });
            for _ in 1..self.rows(bit_s) {
                let now = self.now();
                self.put(now);
            }
        }
    }

    /// Lets go for `s` seconds, then takes hold of where the joint hangs: the nominal position. A joint that
    /// no gravity moves is not let go: it would stay where it is, and be torn back.
    pub fn drop(&mut self, s: f64) {
        const LEAST_SHARE: f64 = 0.01;
        let falls = self.limits.hottest().1 > LEAST_SHARE;
        if !falls {
            self.go(self.limits.nominal_rad);
            return;
        }
        self.powered = false;
        self.hold(s);
        self.powered = true;
        self.put(self.limits.nominal_rad);
        self.hold(0.5);
    }
}
