//! The gait clock: a phase per foot, and the foot height that each phase asks for.

use std::collections::BTreeMap;
use std::f32::consts::{PI, TAU};

use caudata_declare::settings;
use caudata_random::Stream;
use serde::{Deserialize, Serialize};

use crate::error::{checks, within};
use crate::{COMMAND_DIM, PerFoot, TaskError};

/// Which feet step together. Feet come in pairs, left and right, from front to hind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GaitPattern {
    /// Each foot half a cycle from those next to it: a biped's walk, a quadruped's trot (the first foot with
    /// the fourth, the second with the third), a hexapod's tripod.
    #[default]
    Alternate,
    /// One foot after the other, from hind to front on one side, then on the other: a quadruped's walk, an
    /// insect's wave.
    Walk,
    /// Left against right.
    Pace,
    /// Each pair half a cycle from the next.
    Bound,
    /// All together.
    Pronk,
    /// No clock: every phase stays π. Its reward `phase` then asks for feet on the ground; set its weight to
    /// 0.
    None,
}

impl GaitPattern {
    /// Phase of a foot relative to the clock, rad, for a robot with so many feet.
    pub fn offset_rad(self, foot: usize, feet: usize) -> f32 {
        let (pair, right) = (foot / 2, foot % 2);
        let half = |odd: usize| if odd.is_multiple_of(2) { 0.0 } else { PI };
        match self {
            Self::Alternate => half(foot + pair),
            Self::Walk => {
                let pairs = feet.div_ceil(2).max(1);
                wrap_angle(PI * (pair as f32 / pairs as f32 + (1 - right) as f32))
            }
            Self::Pace => half(right),
            Self::Bound => half(pair),
            Self::Pronk | Self::None => 0.0,
        }
    }
}

settings! {
    /// Table `[task.phase]`: the gait clock.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct PhaseConfig {
        /// Stride frequency, Hz: each episode draws its own, uniformly. Default 1.25 to 1.5 (MuJoCo
        /// Playground). Too low: speed needs long strides; too high: the servos cannot follow and power
        /// rises.
        pub frequency_hz: [f32; 2] = [1.25, 1.5],
        /// Which feet step together: `alternate` (a biped's walk, a trot, a tripod), `walk` (one after the
        /// other), `pace`, `bound`, `pronk`, or `none` (no clock). Default alternate.
        pub pattern: GaitPattern,
        /// Height h of the foot reference at the top of the swing, m. Default 0.05; 0.06 to 0.07 suits rough
        /// ground. Too low: feet drag; too high: the trunk has to roll to lift them.
        pub swing_height_m: f32 = 0.05,
        /// Commands whose norm (m/s and rad/s together) is at most this stop the clock: every phase is then π
        /// (foot reference 0), so that the robot stands instead of trotting on the spot. Default 0.01 (MuJoCo
        /// Playground); 0 stops it for the zero command only; negative: the clock never stops.
        pub stand_command_norm: f32 = 0.01,
        /// Phase of single feet relative to the clock, by name, in cycles; feet that are not named follow
        /// `pattern`. Default none. 0.5 is half a stride.
        pub offset_cycles: BTreeMap<String, f32>,
    }
}

impl PhaseConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        checks! {
            self, "phase.";
            frequency_hz: within(self.frequency_hz, 0.0, 10.0), "must be [min, max] within 0 to 10 Hz";
            offset_cycles: self.offset_cycles.values().all(|c| (-1.0..=1.0).contains(c)), "must be -1 to 1 cycle";
            swing_height_m: (0.0..=0.5).contains(&self.swing_height_m), "must be 0 to 0.5 m";
            stand_command_norm: self.stand_command_norm.is_finite(), "must be finite (negative: the clock never stops)";
        }
    }
}

impl PhaseConfig {
    /// Phase of each foot relative to the clock, rad, for feet with these names; one phase, that of the
    /// clock, for a robot without feet.
    ///
    /// # Errors
    /// [`TaskError::UnknownFoot`] where `offset_cycles` names a foot that is not among them.
    pub fn offsets_rad(&self, feet: &[&str]) -> Result<PerFoot, TaskError> {
        for name in self.offset_cycles.keys() {
            if !feet.contains(&name.as_str()) {
                return Err(TaskError::UnknownFoot { foot: name.clone(), known: feet.join(", ") });
            }
        }
        let offset = |foot: usize| match feet.get(foot).and_then(|f| self.offset_cycles.get(*f)) {
            Some(cycles) => wrap_angle(TAU * cycles),
            None => self.pattern.offset_rad(foot, feet.len()),
        };
        Ok(PerFoot::from_fn(feet.len().max(1), offset))
    }

    /// Stride frequencies, Hz, [min, max]; 0 without a clock.
    pub fn clock_hz(&self) -> [f32; 2] {
        match self.pattern {
            GaitPattern::None => [0.0; 2],
            _ => self.frequency_hz,
        }
    }
}

/// The clock of one environment (or of the robot).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhaseClock {
    /// Phase of the clock, rad, (−π, π].
    phase_rad: f32,
    frequency_hz: f32,
    standing: bool,
}

impl PhaseClock {
    /// A clock at `phase_rad` running at `frequency_hz`.
    pub fn new(phase_rad: f32, frequency_hz: f32) -> Self {
        Self {
            // a clock that stands, stands at the end of a step
            phase_rad: if frequency_hz == 0.0 { PI } else { wrap_angle(phase_rad) },
            frequency_hz,
            standing: false,
        }
    }

    /// Draws the frequency and the start phase of an episode.
    pub fn draw(config: &PhaseConfig, stream: &mut Stream) -> Self {
        let [lo, hi] = config.clock_hz();
        let frequency_hz = stream.uniform(lo, hi);
        Self::new(stream.uniform(-PI, PI), frequency_hz)
    }

    /// Stride frequency, Hz.
    pub fn frequency_hz(&self) -> f32 {
        self.frequency_hz
    }

    /// Whether the clock is stopped because the command asks to stand.
    pub fn standing(&self) -> bool {
        self.standing
    }

    /// Tells the clock the command: it stops while the command asks to stand.
    pub fn set_command(&mut self, config: &PhaseConfig, command: &[f32; COMMAND_DIM]) {
        let norm = command.iter().map(|c| c * c).sum::<f32>().sqrt();
        self.standing = norm <= config.stand_command_norm;
    }

    /// Moves on by `dt_s`, unless standing.
    pub fn advance(&mut self, dt_s: f32) {
        if !self.standing {
            self.phase_rad = wrap_angle(self.phase_rad + TAU * self.frequency_hz * dt_s);
        }
    }

    /// Phase of each foot whose offset from the clock is given, rad, (−π, π]; all π while standing.
    pub fn phases_rad(&self, offsets_rad: &PerFoot) -> PerFoot {
        match self.standing {
            true => PerFoot::filled(offsets_rad.len(), PI),
            false => offsets_rad.map(|offset_rad| wrap_angle(self.phase_rad + offset_rad)),
        }
    }

    /// Phase of the clock itself, rad, (−π, π]; π while standing.
    pub fn phase_rad(&self) -> f32 {
        self.phases_rad(&PerFoot::filled(1, 0.0))[0]
    }
}

/// The angle brought into (−π, π].
#[inline]
pub fn wrap_angle(angle_rad: f32) -> f32 {
    // Most angles need at most one turn, which is much cheaper than rounding.
    if angle_rad > -PI && angle_rad <= PI {
        angle_rad
    } else if angle_rad > PI && angle_rad <= 3.0 * PI {
        angle_rad - TAU
    } else {
        let wrapped = angle_rad - TAU * (angle_rad / TAU).round();
        if wrapped <= -PI || wrapped > PI { PI } else { wrapped }
    }
}

/// Height of the foot's lowest point above the ground that `phase_rad` (in [−π, π]) asks for, m.
///
/// With x = (φ + π)/2π and b(s) = 3s² − 2s³: h·b(2x) up to x = ½, then h·(1 − b(2x − 1)): up during the first
/// half of the cycle, down during the second (MuJoCo Playground's `get_rz`).
pub fn reference_height_m(phase_rad: f32, swing_height_m: f32) -> f32 {
    let x = (phase_rad + PI) / TAU;
    let blend = |s: f32| s * s * (3.0 - 2.0 * s);
    if x <= 0.5 {
        swing_height_m * blend(2.0 * x)
    } else {
        swing_height_m * (1.0 - blend(2.0 * x - 1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_random::{Key, Purpose};
    use std::f32::consts::FRAC_PI_2;

    fn close(a: f32, b: f32) {
        assert!((a - b).abs() < 2e-6, "{a} is not {b}");
    }

    fn trot() -> PerFoot {
        PhaseConfig::default().offsets_rad(&["FL", "FR", "HL", "HR"]).unwrap()
    }

    #[test]
    fn reference_height_rises_then_falls() {
        let h = 0.08;
        close(reference_height_m(-PI, h), 0.0); // x = 0
        // x = ¼: b(½) = 3/4 − 2/8 = ½
        close(reference_height_m(-FRAC_PI_2, h), 0.04);
        close(reference_height_m(0.0, h), 0.08); // x = ½
        close(reference_height_m(FRAC_PI_2, h), 0.04);
        close(reference_height_m(PI, h), 0.0);
        // φ = −3π/4: x = 1/8, b(¼) = 3/16 − 2/64 = 5/32; 0.08·5/32 = 0.0125
        close(reference_height_m(-0.75 * PI, h), 0.0125);
        // φ = 3π/4: x = 7/8, b(3/4) = 27/16 − 27/32 = 27/32; 0.08·5/32
        close(reference_height_m(0.75 * PI, h), 0.0125);
    }

    #[test]
    fn trot_offsets_pair_the_diagonals() {
        let clock = PhaseClock::new(0.5, 1.25);
        let [fl, fr, hl, hr] = clock.phases_rad(&trot()).to_array().unwrap();
        close(fl, 0.5);
        close(hr, 0.5);
        // 0.5 + π − 2π
        close(fr, 0.5 - PI);
        close(hl, fr);
    }

    /// Two feet alternate, six make two tripods: front left, middle right, hind left against the others.
    #[test]
    fn other_numbers_of_feet_alternate() {
        let near_zero = |foot| GaitPattern::Alternate.offset_rad(foot, 6) == 0.0;
        assert_eq!([0, 1].map(near_zero), [true, false]);
        let tripod = [true, false, false, true, true, false];
        assert_eq!([0, 1, 2, 3, 4, 5].map(near_zero), tripod);
    }

    #[test]
    fn patterns_and_single_feet() {
        let feet = ["FL", "FR", "HL", "HR"];
        let of = |pattern| {
            let config = PhaseConfig { pattern, ..PhaseConfig::default() };
            config.offsets_rad(&feet).unwrap().map(|rad| rad.rem_euclid(TAU) / TAU)
        };
        // who is farther ahead comes down earlier: hind left, front left, hind right, front right
        assert_eq!(of(GaitPattern::Walk), [0.5, 0.0, 0.75, 0.25]);
        assert_eq!(of(GaitPattern::Pace), [0.0, 0.5, 0.0, 0.5]);
        assert_eq!(of(GaitPattern::Bound), [0.0, 0.0, 0.5, 0.5]);
        assert_eq!(of(GaitPattern::Pronk), [0.0; 4]);
        let mut config = PhaseConfig::default();
        config.offset_cycles.insert("HR".into(), 0.25);
        assert_eq!(config.offsets_rad(&feet).unwrap(), [0.0, PI, PI, FRAC_PI_2]);
        let refused = config.offsets_rad(&["L", "R"]).unwrap_err().to_string();
        assert!(refused.contains("HR") && refused.contains("L, R"), "{refused}");
        // no feet: the clock itself; no clock: always the end of a step
        assert_eq!(PhaseConfig::default().offsets_rad(&[]).unwrap(), [0.0]);
        let none = PhaseConfig { pattern: GaitPattern::None, ..PhaseConfig::default() };
        let mut clock = PhaseClock::draw(&none, &mut Stream::new(Key::for_run(1), Purpose::Reset));
        clock.advance(0.3);
        assert_eq!(clock.phases_rad(&none.offsets_rad(&feet).unwrap()), [PI; 4]);
    }

    #[test]
    fn advances_by_two_pi_f_dt_and_wraps() {
        // 2π·1.25·0.02 = π/20 per control step: 40 steps are one cycle.
        let mut clock = PhaseClock::new(0.0, 1.25);
        clock.advance(0.02);
        close(clock.phases_rad(&trot())[0], PI / 20.0);
        for _ in 0..39 {
            clock.advance(0.02);
        }
        assert!(clock.phases_rad(&trot())[0].abs() < 1e-4);
        for _ in 0..100_000 {
            clock.advance(0.02);
            for phase in clock.phases_rad(&trot()) {
                assert!(phase > -PI && phase <= PI);
            }
        }
    }

    #[test]
    fn stops_for_the_zero_command_and_goes_on_where_it_was() {
        let config = PhaseConfig::default();
        let mut clock = PhaseClock::new(0.3, 1.25);
        clock.set_command(&config, &[0.0, 0.0, 0.0]);
        clock.advance(0.02);
        assert!(clock.standing());
        assert_eq!(clock.phases_rad(&trot()), [PI; 4]);
        close(reference_height_m(PI, config.swing_height_m), 0.0);
        clock.set_command(&config, &[0.0, 0.0, 0.2]);
        close(clock.phases_rad(&trot())[0], 0.3);
        let never = PhaseConfig { stand_command_norm: -1.0, ..config };
        clock.set_command(&never, &[0.0; 3]);
        assert!(!clock.standing());
    }

    #[test]
    fn draws_frequencies_from_the_range() {
        let config = PhaseConfig::default();
        let mut stream = Stream::new(Key::for_run(1), Purpose::Reset);
        let clocks: Vec<_> = (0..200).map(|_| PhaseClock::draw(&config, &mut stream)).collect();
        assert!(clocks.iter().all(|c| (1.25..=1.5).contains(&c.frequency_hz())));
        assert!(clocks.iter().any(|c| c.frequency_hz() < 1.3));
        assert!(clocks.iter().any(|c| c.frequency_hz() > 1.45));
        assert!(clocks.iter().any(|c| c.phases_rad(&trot())[0] < -1.0));
        assert!(clocks.iter().any(|c| c.phases_rad(&trot())[0] > 1.0));
    }

    #[test]
    fn angles_wrap_into_the_half_open_interval() {
        close(wrap_angle(PI + 0.1), 0.1 - PI);
        close(wrap_angle(-PI), PI);
        close(wrap_angle(7.0 * TAU + 0.25), 0.25);
        assert!(wrap_angle(f32::NAN).is_nan());
    }

    proptest::proptest! {
        #[test]
        fn wrapped_angles_are_in_range_and_point_the_same_way(angle in -1e3f32..1e3) {
            let wrapped = wrap_angle(angle);
            proptest::prop_assert!(wrapped > -PI && wrapped <= PI);
            // f32 angles near 1000 are 6e-5 apart.
            proptest::prop_assert!((wrapped.sin() - angle.sin()).abs() < 2e-4);
            proptest::prop_assert!((wrapped.cos() - angle.cos()).abs() < 2e-4);
        }

        #[test]
        fn the_reference_is_between_zero_and_the_swing_height(phase in -PI..PI, h in 0.0f32..0.2) {
            let z = reference_height_m(phase, h);
            proptest::prop_assert!((-1e-6..=h + 1e-6).contains(&z));
            // Symmetric about the top of the swing.
            proptest::prop_assert!((z - reference_height_m(-phase, h)).abs() < 1e-6);
        }
    }
}
