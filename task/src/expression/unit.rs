//! Units of expressions: exponents of metre, kilogram and second (radians are pure numbers).

/// Twice the exponents of m, kg and s, so that a square root has them too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unit {
    doubled: [i16; 3],
}

impl Unit {
    /// A pure number; an angle.
    pub const ONE: Self = Self::of(0, 0, 0);

    /// m^a·kg^b·s^c.
    pub const fn of(metres: i16, kilograms: i16, seconds: i16) -> Self {
        Self { doubled: [2 * metres, 2 * kilograms, 2 * seconds] }
    }

    /// The product with `other` to the power of `sign`.
    pub(super) fn times(self, other: Self, sign: i16) -> Self {
        let at = |i: usize| self.doubled[i].saturating_add(other.doubled[i].saturating_mul(sign));
        Self { doubled: [at(0), at(1), at(2)] }
    }

    /// To the power of half of `halves`.
    pub(super) fn power(self, halves: i16) -> Self {
        Self { doubled: self.doubled.map(|e| e.saturating_mul(halves) / 2) }
    }
}

impl std::fmt::Display for Unit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        const NAMED: [(Unit, &str); 4] = [
            (Unit::ONE, "1"),
            (Unit::of(1, 1, -2), "N"),
            (Unit::of(2, 1, -2), "N·m"),
            (Unit::of(2, 1, -3), "W"),
        ];
        if let Some((_, name)) = NAMED.iter().find(|(unit, _)| unit == self) {
            return f.write_str(name);
        }
        let mut first = true;
        for (exponent, name) in self.doubled.iter().zip(["m", "kg", "s"]) {
            if *exponent == 0 {
                continue;
            }
            if !std::mem::take(&mut first) {
                f.write_str("·")?;
            }
            match exponent % 2 {
                _ if *exponent == 2 => f.write_str(name)?,
                0 => write!(f, "{name}^{}", exponent / 2)?,
                _ => write!(f, "{name}^({exponent}/2)")?,
            }
        }
        Ok(())
    }
}
