//! One random stream: draws, and exact save and restore.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::{Key, Purpose};

/// A stream of random numbers (ChaCha with 8 rounds, 64-bit counter).
///
/// Serialises as `(key, purpose, word position)`; the restored stream goes on with the same bits.
#[derive(Clone, Debug)]
pub struct Stream {
    key: Key,
    purpose: Purpose,
    rng: ChaCha8Rng,
}

/// What is saved of a stream. 2^64 words are 64 EiB of random numbers, so the position fits.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SavedStream {
    key: Key,
    purpose: Purpose,
    word_position: u64,
}

impl Stream {
    /// The stream of `key` and `purpose`, at its start.
    pub fn new(key: Key, purpose: Purpose) -> Self {
        let mut rng = ChaCha8Rng::from_seed(key.to_bytes());
        rng.set_stream(purpose as u64);
        Self { key, purpose, rng }
    }

    /// How many 32-bit words have been taken from the stream.
    pub fn word_position(&self) -> u64 {
        self.rng.get_word_pos() as u64
    }

    /// 32 random bits.
    #[inline]
    pub fn next_u32(&mut self) -> u32 {
        self.rng.next_u32()
    }

    /// 64 random bits.
    #[inline]
    pub fn next_u64(&mut self) -> u64 {
        self.rng.next_u64()
    }

    /// Uniform on the interval from `lo` to `hi` (24 random bits; `hi` itself can come out only by
    /// rounding). Equal bounds give `lo` exactly; reversed bounds are the same interval.
    #[inline]
    pub fn uniform(&mut self, lo: f32, hi: f32) -> f32 {
        let unit = (self.rng.next_u32() >> 8) as f32 * (1.0 / (1u32 << 24) as f32);
        lo + (hi - lo) * unit
    }

    /// Uniform on the interval from `lo` to `hi`, in double precision (53 random bits).
    #[inline]
    pub fn uniform_f64(&mut self, lo: f64, hi: f64) -> f64 {
        let unit = (self.rng.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64);
        lo + (hi - lo) * unit
    }

    /// Normal with mean 0 and standard deviation 1.
    #[inline]
    pub fn normal(&mut self) -> f32 {
        StandardNormal.sample(&mut self.rng)
    }

    /// Normal with mean 0 and standard deviation 1, in double precision.
    #[inline]
    pub fn normal_f64(&mut self) -> f64 {
        StandardNormal.sample(&mut self.rng)
    }

    /// Adds bell-shaped noise of standard deviation `std` to every value: much faster than [`Self::normal`],
    /// for sensor noise.
    ///
    /// Each draw is the sum of the four bytes of one word (Irwin–Hall distribution), so it is at most 3.45
    /// standard deviations from 0, and comes in steps of 0.007 standard deviations.
    #[inline]
    pub fn add_bell_noise(&mut self, values: &mut [f32], std: f32) {
        // A byte, uniform over 0 to 255, has variance (256² − 1)/12 = 5461.25; four of them 21,845.
        let scale = std / 21_845.0f32.sqrt();
        let mut words = [0; 4 * 16];
        for values in values.chunks_mut(16) {
            let words = &mut words[..4 * values.len()];
            self.rng.fill_bytes(words);
            for (value, bytes) in values.iter_mut().zip(words.as_chunks::<4>().0) {
                let word = u32::from_le_bytes(*bytes);
                let pairs = (word & 0x00ff_00ff) + ((word >> 8) & 0x00ff_00ff);
                let sum = (pairs & 0xffff) + (pairs >> 16);
                *value += scale * (sum as f32 - 510.0);
            }
        }
    }

    /// A whole number from 0 to `n − 1`, each equally likely; 0 when `n` is 0.
    ///
    /// Multiplies a 64-bit draw by `n` and rejects the draws that would favour some results
    /// (Lemire, "Fast Random Integer Generation in an Interval", ACM TOMACS 2019).
    pub fn below(&mut self, n: u64) -> u64 {
        if n == 0 {
            return 0;
        }
        // 2^64 mod n: that many low fractions are one too many.
        let excess = n.wrapping_neg() % n;
        loop {
            let product = u128::from(self.rng.next_u64()) * u128::from(n);
            if product as u64 >= excess {
                return (product >> 64) as u64;
            }
        }
    }

    /// True with probability `p`; never for `p ≤ 0` or not-a-number, always for `p ≥ 1`.
    #[inline]
    pub fn chance(&mut self, p: f32) -> bool {
        self.uniform(0.0, 1.0) < p
    }

    /// Puts the items into a random order, each order equally likely (Fisher–Yates).
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for last in (1..items.len()).rev() {
            let other = self.below(last as u64 + 1) as usize;
            items.swap(last, other);
        }
    }
}

impl PartialEq for Stream {
    /// Two streams are equal when everything they will ever give is equal.
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
            && self.purpose == other.purpose
            && self.word_position() == other.word_position()
    }
}

impl Serialize for Stream {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        SavedStream { key: self.key, purpose: self.purpose, word_position: self.word_position() }
            .serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Stream {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let saved = SavedStream::deserialize(deserializer)?;
        let mut stream = Self::new(saved.key, saved.purpose);
        stream.rng.set_word_pos(u128::from(saved.word_position));
        Ok(stream)
    }
}

#[cfg(test)]
mod tests;
