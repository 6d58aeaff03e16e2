//! Where the time of a step goes, for `caudata bench sim`.

use std::time::Instant;

use caudata_declare::named;

named! {
    /// Parts of a physics step, in their order; the last is once per control period.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Phase {
        /// Pass outward: frames, velocities, bias accelerations, and contact of every point with the ground.
        KinematicsAndContact = "kinematics and contact",
        /// Links against each other.
        SelfCollision = "self-collision",
        /// Buoyancy, drag and added mass.
        Water = "water",
        /// Servos, losses and stops of all joints.
        Drives = "drives",
        /// Articulated-body pass inward.
        Inward = "pass inward",
        /// The base's acceleration and the pass outward.
        Outward = "pass outward",
        /// Contact forces that came out, and the new positions and velocities.
        Integration = "integration",
        /// What the task sees: commands in, sensors and sums out.
        Report = "commands and report",
    }
}

/// Seconds per [`Phase`], in the order of [`Phase::ALL`].
pub type PhaseSeconds = [f64; Phase::ALL.len()];

/// One thread's stop-watch. A look at it costs some 25 ns, of about 5 µs that a step of 16 lanes takes.
#[derive(Debug, Clone)]
pub(super) struct Clock {
    last: Instant,
    pub seconds: PhaseSeconds,
}

impl Clock {
    pub fn new() -> Self {
        Self { last: Instant::now(), seconds: PhaseSeconds::default() }
    }

    /// What went by since the last look belongs to nobody.
    pub fn begin(&mut self) {
        self.last = Instant::now();
    }

    /// What went by since the last look belongs to `phase`.
    pub fn mark(&mut self, phase: Phase) {
        let now = Instant::now();
        self.seconds[phase as usize] += now.duration_since(self.last).as_secs_f64();
        self.last = now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_goes_to_the_phase_that_ends() {
        let mut clock = Clock::new();
        std::thread::sleep(std::time::Duration::from_millis(20));
        clock.begin();
        clock.mark(Phase::Water);
        std::thread::sleep(std::time::Duration::from_millis(5));
        clock.mark(Phase::Report);
        assert!(clock.seconds[Phase::Report as usize] >= 0.005);
        assert!(clock.seconds[Phase::Water as usize] < clock.seconds[Phase::Report as usize]);
        assert!(clock.seconds[Phase::Drives as usize].abs() < f64::EPSILON);
    }

    #[test]
    fn phases_are_their_own_index() {
        for (at, phase) in Phase::ALL.into_iter().enumerate() {
            assert_eq!(phase as usize, at);
        }
    }
}
