//! Lost command frames: whether the frame of a control period arrives, drawn by seed and count alone.
//!
//! Two states (Gilbert, "Capacity of a burst-noise channel", 1960): frames arrive, or a burst is on in which
//! none does. With a share s of frames lost in bursts of mean length L, a burst ends with probability 1/L and
//! starts with s/(L·(1 − s)).

use caudata_declare::settings;
use caudata_random::{Key, Purpose, Stream};
use serde::{Deserialize, Serialize};

settings! {
    /// How many command frames are lost, and which.
    #[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
    pub struct CommandLoss {
        /// Share of frames that do not arrive, 0..=0.9. Nominal 0.
        pub share: f32 = 0.0,
        /// Mean number of frames lost in a row, 1..=100. Nominal 1.
        pub burst: f32 = 1.0,
        /// Which ones: same seed, same losses, counted from the lane's reset.
        pub seed: u64 = 0,
    }
}

/// Where a lane is in its losses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct LossMemory {
    /// Control periods since reset.
    period: u64,
    /// Whether the last frame was lost.
    lost: bool,
}

impl LossMemory {
    /// Whether the frame of the period that now begins is lost.
    pub fn next(&mut self, loss: &CommandLoss) -> bool {
        let period = self.period;
        self.period += 1;
        if loss.share <= 0.0 {
            self.lost = false;
            return false;
        }
        let key = Key { episode: period, ..Key::for_run(loss.seed) };
        let draw = Stream::new(key, Purpose::CommandLoss).uniform(0.0, 1.0);
        let burst = loss.burst.max(1.0);
        let chance =
            if self.lost { 1.0 - 1.0 / burst } else { loss.share / (burst * (1.0 - loss.share)) };
        self.lost = draw < chance;
        self.lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lost(loss: &CommandLoss, n: usize) -> Vec<bool> {
        let mut memory = LossMemory::default();
        (0..n).map(|_| memory.next(loss)).collect()
    }

    #[test]
    fn as_many_as_asked_in_bursts_as_long_as_asked() {
        let loss = CommandLoss { share: 0.1, burst: 4.0, seed: 3 };
        const N: usize = 40_000;
        let all = lost(&loss, N);
        let count = all.iter().filter(|&&l| l).count();
        let starts = all.windows(2).filter(|w| !w[0] && w[1]).count();
        // 1000 bursts of 4: the share is known to about 5 %, the length to 3 %
        assert!((count as f64 / N as f64 - 0.1).abs() < 0.015, "{count}");
        assert!((count as f64 / starts as f64 - 4.0).abs() < 0.4);
    }

    #[test]
    fn the_same_ones_again_by_seed() {
        let loss = CommandLoss { share: 0.3, burst: 1.0, seed: 9 };
        assert_eq!(lost(&loss, 200), lost(&loss, 200));
        assert_ne!(lost(&loss, 200), lost(&CommandLoss { seed: 10, ..loss }, 200));
        assert!(!lost(&CommandLoss::default(), 200).contains(&true));
    }
}
