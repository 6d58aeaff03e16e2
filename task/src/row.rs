//! Rows of as many values as a robot has joints or feet, kept in place: they are copied like a number and
//! allocate nothing.

use std::ops::{Deref, DerefMut};

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Most actuated joints of a robot.
pub const MAX_JOINTS: usize = 32;
/// Most feet of a robot.
pub const MAX_FEET: usize = 8;

/// A value per actuated joint, policy order.
pub type PerJoint<T = f32> = Row<T, MAX_JOINTS>;
/// A value per foot, in the order of the robot file.
pub type PerFoot<T = f32> = Row<T, MAX_FEET>;

/// Up to `MAX` values; a slice for all who read it.
#[derive(Clone, Copy)]
pub struct Row<T, const MAX: usize> {
    values: [T; MAX],
    len: usize,
}

impl<T: Copy + Default, const MAX: usize> Row<T, MAX> {
    /// `len` values, of which number i is `of(i)`; at most `MAX` of them.
    #[inline]
    pub fn from_fn(len: usize, mut of: impl FnMut(usize) -> T) -> Self {
        let mut row = Self::filled(len, T::default());
        for (i, value) in row.iter_mut().enumerate() {
            *value = of(i);
        }
        row
    }

    /// Becomes what [`Self::from_fn`] gives; writes no more than these values.
    #[inline]
    pub fn refill(&mut self, len: usize, mut of: impl FnMut(usize) -> T) {
        self.len = len.min(MAX);
        for (i, value) in self.iter_mut().enumerate() {
            *value = of(i);
        }
    }

    /// Becomes these values, the first `MAX` of them; writes no more.
    #[inline]
    pub fn set(&mut self, values: &[T]) {
        self.len = values.len().min(MAX);
        for (to, from) in self.iter_mut().zip(values) {
            *to = *from;
        }
    }

    /// `len` times the same value; at most `MAX` times.
    #[inline]
    pub const fn filled(len: usize, value: T) -> Self {
        Self { values: [value; MAX], len: if len < MAX { len } else { MAX } }
    }

    /// The values of a slice, the first `MAX` of them.
    #[inline]
    pub fn of(values: &[T]) -> Self {
        Self::from_fn(values.len(), |i| values[i])
    }

    /// What `of` makes of each value.
    #[inline]
    pub fn map<U: Copy + Default>(&self, mut of: impl FnMut(T) -> U) -> Row<U, MAX> {
        Row::from_fn(self.len, |i| of(self[i]))
    }

    /// As an array, if it has that many values.
    #[inline]
    pub fn to_array<const N: usize>(&self) -> Option<[T; N]> {
        self[..].try_into().ok()
    }
}

impl<T: Copy + Default, const MAX: usize> Default for Row<T, MAX> {
    fn default() -> Self {
        Self::filled(0, T::default())
    }
}

impl<T, const MAX: usize> Deref for Row<T, MAX> {
    type Target = [T];
    #[inline]
    fn deref(&self) -> &[T] {
        &self.values[..self.len]
    }
}

impl<T, const MAX: usize> DerefMut for Row<T, MAX> {
    #[inline]
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.values[..self.len]
    }
}

impl<'a, T, const MAX: usize> IntoIterator for &'a Row<T, MAX> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;
    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl<'a, T, const MAX: usize> IntoIterator for &'a mut Row<T, MAX> {
    type Item = &'a mut T;
    type IntoIter = std::slice::IterMut<'a, T>;
    fn into_iter(self) -> Self::IntoIter {
        self.iter_mut()
    }
}

impl<T, const MAX: usize> IntoIterator for Row<T, MAX> {
    type Item = T;
    type IntoIter = std::iter::Take<std::array::IntoIter<T, MAX>>;
    fn into_iter(self) -> Self::IntoIter {
        self.values.into_iter().take(self.len)
    }
}

impl<T: Copy + Default, const N: usize, const MAX: usize> From<[T; N]> for Row<T, MAX> {
    fn from(values: [T; N]) -> Self {
        const { assert!(N <= MAX) };
        Self::of(&values)
    }
}

impl<T: PartialEq, const MAX: usize> PartialEq for Row<T, MAX> {
    fn eq(&self, other: &Self) -> bool {
        self[..] == other[..]
    }
}

impl<T: PartialEq, const N: usize, const MAX: usize> PartialEq<[T; N]> for Row<T, MAX> {
    fn eq(&self, other: &[T; N]) -> bool {
        self[..] == other[..]
    }
}

impl<T: PartialEq, const N: usize, const MAX: usize> PartialEq<Row<T, MAX>> for [T; N] {
    fn eq(&self, other: &Row<T, MAX>) -> bool {
        self[..] == other[..]
    }
}

impl<T: std::fmt::Debug, const MAX: usize> std::fmt::Debug for Row<T, MAX> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self[..].fmt(f)
    }
}

impl<T: Serialize, const MAX: usize> Serialize for Row<T, MAX> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self[..].serialize(serializer)
    }
}

impl<'de, T: Copy + Default + Deserialize<'de>, const MAX: usize> Deserialize<'de> for Row<T, MAX> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let values = Vec::deserialize(deserializer)?;
        if values.len() > MAX {
            return Err(D::Error::custom(format!("more than {MAX} values")));
        }
        Ok(Self::of(&values))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holds_as_many_as_it_was_given() {
        let row = PerFoot::from_fn(3, |i| i as f32);
        assert_eq!(row, [0.0, 1.0, 2.0]);
        assert_eq!((row.len(), row.to_array::<4>()), (3, None));
        assert_eq!(row.into_iter().sum::<f32>(), 3.0);
        assert_ne!(row, PerFoot::filled(2, 0.0));
        assert_eq!(PerFoot::filled(100, 1.0).len(), MAX_FEET);
        let mut row = row;
        row.refill(2, |i| 5.0 - i as f32);
        assert_eq!(row, [5.0, 4.0]);
        row.set(&[9.0]);
        assert_eq!(row, [9.0]);
        row.refill(100, |i| i as f32);
        assert_eq!(row[..], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
    }

    #[test]
    fn is_written_as_a_sequence_and_not_read_when_too_long() {
        let row: PerFoot = [0.5, 1.5].into();
        let text = serde_json::to_string(&row).unwrap();
        assert_eq!(text, "[0.5,1.5]");
        assert_eq!(serde_json::from_str::<PerFoot>(&text).unwrap(), row);
        assert!(serde_json::from_str::<PerFoot>("[0,1,2,3,4,5,6,7,8]").is_err());
    }
}
