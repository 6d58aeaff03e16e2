//! Numbers that look random and are the same each time.

/// xorshift64*: repeats with its seed.
pub struct Dice(u64);

impl Dice {
    /// Dice of this seed; any will do.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        // A state of 0 would stay 0.
        Self(seed.max(1))
    }

    /// From 0 to `n` − 1, `n` at least 1.
    pub fn below(&mut self, n: u64) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 32) % n
    }
}
