//! A delay inside the position loop: the torque that a loop asks for reaches the motor later (computing time,
//! a bus between controller and bridge).
//!
//! ```text
//!  arrives(t) = wanted(t − d)      between two steps: the straight line between what was wanted at them
//! ```
//!
//! A torque holds for a whole step, so the straight line is at the same time its mean over a step in which it
//! changes; and what arrives has a derivative by d from d = 0 on. A delay takes phase only: pure damping `kd`
//! on an inertia `J` rings for good from `kd·d/J = π/2` on, whereas behind a first-order lag it always dies.
//!
//! A lane remembers as many steps as its own longest delay needs, and only where it has one. What it was
//! asking for before the first step that it remembers (after a reset, or after the delay was switched on)
//! nobody knows: it counts as what it asks for in that step, as if the joint had been held like this for
//! long.

use serde::{Deserialize, Serialize};

use crate::real::Real;

/// Longest delay of a loop, s.
pub const MAX_LOOP_DELAY_S: f32 = 0.05;

/// `delay_s` in physics steps of `dt_s`.
pub fn steps(delay_s: f32, dt_s: f64) -> f64 {
    f64::from(delay_s) / dt_s
}

/// What the loops of some lanes asked for in the last steps. Empty while no lane has a delay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WantedTorques<R> {
    /// Joints.
    width: usize,
    /// Steps kept: as many as the lane that needs most.
    depth: usize,
    /// Which of them is the present one; the ones before it follow, round the end.
    newest: usize,
    /// `[width, depth]`, N·m.
    values_nm: Vec<R>,
    /// What each lane needs by itself; what lies beyond, its neighbours may have brought about, and it must
    /// not show.
    own: Vec<usize>,
    /// 1 in lanes whose memory begins with the next step.
    begins: R,
    /// Whether any does.
    any_begins: bool,
}

impl<R: Real> WantedTorques<R> {
    /// Torques of `width` joints, none of them late.
    pub fn new(width: usize) -> Self {
        Self {
            width,
            depth: 0,
            newest: 0,
            values_nm: Vec::new(),
            own: vec![0; R::LANES],
            begins: R::one(),
            any_begins: true,
        }
    }

    /// Lane `lane` needs `steps` from now on (see [`loop_memory_steps`](super::loop_memory_steps)). What it
    /// remembers stays; of steps further back it takes the oldest one that it has.
    pub fn set_steps(&mut self, lane: usize, steps: usize) {
        let before = std::mem::replace(&mut self.own[lane], steps);
        if before == 0 {
            self.forget(lane);
        }
        let depth = self.own.iter().copied().max().unwrap_or(0);
        if depth != self.depth {
            self.deepen(depth);
        }
        if before < steps && before > 0 {
            for joint in 0..self.width {
                let oldest = self.at(joint, before - 1).lane(lane);
                for age in before..self.depth {
                    self.put(joint, age, lane, oldest);
                }
            }
        }
    }

    /// Lane `lane` knows nothing of the past: its memory begins with the next step.
    pub fn forget(&mut self, lane: usize) {
        self.begins = self.begins.with_lane(lane, 1.0);
        self.any_begins = true;
    }

    /// What lane `lane` remembers, newest first. `[width, its steps]`, N·m; empty where it remembers nothing.
    pub fn lane(&self, lane: usize) -> Vec<f64> {
        if self.begins.lane(lane) > 0.5 {
            return Vec::new();
        }
        let own = self.own[lane];
        (0..self.width * own).map(|k| self.at(k / own, k % own).lane(lane)).collect()
    }

    /// Replaces what lane `lane` remembers by what [`lane`](Self::lane) gave. Whether the length fitted; if
    /// not, nothing changes.
    pub fn set_lane(&mut self, lane: usize, values_nm: &[f64]) -> bool {
        let own = self.own[lane];
        if !fits(values_nm.len(), self.width, own) {
            return false;
        }
        if values_nm.is_empty() {
            self.forget(lane);
            return true;
        }
        self.begins = self.begins.with_lane(lane, 0.0);
        for joint in 0..self.width {
            for age in 0..self.depth {
                self.put(joint, age, lane, values_nm[joint * own + age.min(own - 1)]);
            }
        }
        true
    }

    /// A physics step begins.
    #[inline(always)]
    pub fn begin_step(&mut self) {
        self.newest = if self.newest == 0 { self.depth.max(1) - 1 } else { self.newest - 1 };
    }

    /// Joint `joint` in the step that began; [`Loop::direct`] while nobody is late.
    #[inline(always)]
    pub fn joint(&mut self, joint: usize) -> Loop<'_, R> {
        let first = joint * self.depth;
        Loop {
            values_nm: &mut self.values_nm[first..first + self.depth],
            newest: self.newest,
            begins: self.begins,
            any_begins: self.any_begins,
        }
    }

    /// Every joint has gone through the step.
    #[inline(always)]
    pub fn end_step(&mut self) {
        self.begins = R::zero();
        self.any_begins = false;
    }

    /// Keeps `depth` steps; further back than it goes now, all lanes have their oldest one.
    fn deepen(&mut self, depth: usize) {
        let mut values_nm = Vec::with_capacity(self.width * depth);
        for joint in 0..self.width {
            for age in 0..depth {
                values_nm.push(match self.depth.checked_sub(1) {
                    Some(oldest) => self.at(joint, age.min(oldest)),
                    None => R::zero(),
                });
            }
        }
        (self.depth, self.newest, self.values_nm) = (depth, 0, values_nm);
    }

    fn place(&self, joint: usize, age: usize) -> usize {
        joint * self.depth + (self.newest + age) % self.depth
    }

    fn at(&self, joint: usize, age: usize) -> R {
        self.values_nm[self.place(joint, age)]
    }

    fn put(&mut self, joint: usize, age: usize, lane: usize, value_nm: f64) {
        let place = self.place(joint, age);
        self.values_nm[place] = self.values_nm[place].with_lane(lane, value_nm);
    }
}

/// Whether `length` numbers are a memory of `width` joints over `steps`, or none.
pub fn fits(length: usize, width: usize, steps: usize) -> bool {
    length == 0 || length == width * steps
}

/// One joint's part of [`WantedTorques`] in one step.
#[derive(Debug)]
pub struct Loop<'a, R> {
    values_nm: &'a mut [R],
    newest: usize,
    begins: R,
    any_begins: bool,
}

impl<R: Real> Loop<'_, R> {
    /// A loop that acts at once and remembers nothing.
    #[inline(always)]
    pub fn direct() -> Self {
        Self { values_nm: &mut [], newest: 0, begins: R::zero(), any_begins: false }
    }

    /// The torque that arrives in a step in which `wanted_nm` is asked for, with a delay of `delay_steps`
    /// steps, N·m.
    #[inline(always)]
    pub fn pass(self, wanted_nm: R, delay_steps: R) -> R {
        let depth = self.values_nm.len();
        if depth == 0 {
            return wanted_nm;
        }
        if self.any_begins {
            let begins = R::splat(0.5).lt(self.begins);
            for value in &mut *self.values_nm {
                *value = R::select(begins, wanted_nm, *value);
            }
        }
        self.values_nm[self.newest] = wanted_nm;
        let mut arrives_nm = R::zero();
        for age in 0..depth {
            let place = self.newest + age;
            let value = self.values_nm[if place < depth { place } else { place - depth }];
            // all weights but two are zero, in every lane two of its own
            let off = (delay_steps - R::splat(age as f64)).abs();
            let weight = (R::one() - off).max(R::zero());
            arrives_nm = value.mul_add(weight, arrives_nm);
        }
        // exactly what is wanted without a delay: a lane that has none must not notice a neighbour's
        R::select(R::zero().lt(delay_steps), arrives_nm, wanted_nm)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What arrives of `wanted`, step by step, with a delay of `delay` steps.
    fn arrives(delay: f64, wanted: &[f64]) -> Vec<f64> {
        let mut w = WantedTorques::new(1);
        w.set_steps(0, delay.ceil() as usize + 1);
        wanted.iter().map(|&x| step(&mut w, delay, x)).collect()
    }

    fn step(w: &mut WantedTorques<f64>, delay: f64, wanted: f64) -> f64 {
        w.begin_step();
        let arrives = w.joint(0).pass(wanted, delay);
        w.end_step();
        arrives
    }

    #[test]
    fn whole_steps_shift() {
        let wanted = [0.0, 1.0, 2.0, 4.0, 8.0, 16.0];
        assert_eq!(arrives(3.0, &wanted), [0.0, 0.0, 0.0, 0.0, 1.0, 2.0]);
        assert_eq!(arrives(1.0, &wanted), [0.0, 0.0, 1.0, 2.0, 4.0, 8.0]);
    }

    #[test]
    fn fractions_lie_on_the_line_between() {
        // 1.25 steps: three quarters of one step ago, one of two steps ago: 0.75·2 + 0.25·1, 0.75·4 + 0.25·2
        let wanted = [0.0, 1.0, 2.0, 4.0, 8.0];
        assert_eq!(arrives(1.25, &wanted), [0.0, 0.0, 0.75, 1.75, 3.5]);
        // a tenth of a step: 0.9·1, 0.9·2 + 0.1·1
        let small = arrives(0.1, &wanted);
        assert!((small[1] - 0.9).abs() < 1e-12 && (small[2] - 1.9).abs() < 1e-12);
    }

    #[test]
    fn begins_as_if_held_for_long() {
        assert_eq!(arrives(2.0, &[0.6, 1.0, 1.0, 1.0]), [0.6, 0.6, 0.6, 1.0]);
    }

    #[test]
    fn a_delay_that_changes_keeps_what_is_under_way() {
        let mut w = WantedTorques::new(1);
        w.set_steps(0, 3);
        for x in [1.0, 2.0, 3.0] {
            let _ = step(&mut w, 2.0, x);
        }
        // longer: further back than 1 it knows nothing, and takes the 1
        w.set_steps(0, 5);
        assert_eq!(w.lane(0), [3.0, 2.0, 1.0, 1.0, 1.0]);
        assert_eq!(step(&mut w, 4.0, 4.0), 1.0);
        // shorter
        w.set_steps(0, 2);
        assert_eq!(w.lane(0), [4.0, 3.0]);
        assert_eq!(step(&mut w, 1.0, 5.0), 4.0);
        // none, and then again: begins anew
        w.set_steps(0, 0);
        assert_eq!(w.joint(0).pass(7.0, 0.0), 7.0);
        w.set_steps(0, 2);
        assert!(w.lane(0).is_empty());
        assert_eq!(step(&mut w, 1.0, 8.0), 8.0);
        assert_eq!(step(&mut w, 1.0, 9.0), 8.0);
    }

    #[test]
    fn what_was_remembered_can_be_put_back() {
        let mut w = WantedTorques::new(1);
        w.set_steps(0, 4);
        for x in [1.0, 2.0, 3.0, 5.0, 8.0] {
            let _ = step(&mut w, 3.0, x);
        }
        let kept = w.lane(0);
        let mut other = WantedTorques::new(1);
        other.set_steps(0, 4);
        assert!(!other.set_lane(0, &kept[1..]));
        assert!(other.set_lane(0, &kept));
        for x in [13.0, 21.0, 34.0] {
            assert_eq!(step(&mut w, 2.5, x), step(&mut other, 2.5, x));
        }
        // and nothing is put back as nothing
        assert!(other.set_lane(0, &[]));
        assert_eq!(step(&mut other, 2.5, 1.0), 1.0);
    }
}
