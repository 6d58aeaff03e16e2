//! How a field of a message becomes a checked value, and back.

use super::error::RegistryError;
use super::messages::Manifest;
use super::names::{LabelName, StreamName};
use crate::wire::registry as pb;

/// A checked value of a field whose message has a `W`.
pub(super) trait Field<W>: Sized {
    /// From the message.
    fn read(name: &'static str, wire: W) -> Result<Self, RegistryError>;
    /// Into it.
    fn write(self) -> W;
}

/// Values that are the same on either side.
macro_rules! same {
    ($($type:ty),*) => {$(
        impl Field<$type> for $type {
            fn read(_: &'static str, wire: $type) -> Result<Self, RegistryError> {
                Ok(wire)
            }
            fn write(self) -> $type {
                self
            }
        }
    )*};
}
same!(bool, u32, u64, f64, String, Option<u64>);

impl Field<Vec<u8>> for [u8; 32] {
    fn read(name: &'static str, wire: Vec<u8>) -> Result<Self, RegistryError> {
        let found = wire.len();
        let right = wire.try_into();
        right.map_err(|_| RegistryError::HashLength { field: name, found })
    }
    fn write(self) -> Vec<u8> {
        self.to_vec()
    }
}

impl Field<Vec<u8>> for Vec<u8> {
    fn read(_: &'static str, wire: Vec<u8>) -> Result<Self, RegistryError> {
        Ok(wire)
    }
    fn write(self) -> Vec<u8> {
        self
    }
}

/// Names with rules of their own.
macro_rules! name {
    ($($type:ident),*) => {$(
        impl Field<String> for $type {
            fn read(_: &'static str, wire: String) -> Result<Self, RegistryError> {
                Self::new(&wire)
            }
            fn write(self) -> String {
                self.0
            }
        }
    )*};
}
name!(StreamName, LabelName);

/// What may be left out and is empty then.
macro_rules! optional {
    ($($type:ty = $wire:ty),*) => {$(
        impl Field<$wire> for Option<$type> {
            fn read(name: &'static str, wire: $wire) -> Result<Self, RegistryError> {
                if wire.is_empty() { Ok(None) } else { Field::read(name, wire).map(Some) }
            }
            fn write(self) -> $wire {
                self.map(Field::write).unwrap_or_default()
            }
        }
    )*};
}
optional!(StreamName = String, LabelName = String, String = String, [u8; 32] = Vec<u8>);

/// A message within a message, which must be there.
impl Field<Option<pb::Manifest>> for Manifest {
    fn read(name: &'static str, wire: Option<pb::Manifest>) -> Result<Self, RegistryError> {
        wire.ok_or(RegistryError::Missing { field: name })?.try_into()
    }
    fn write(self) -> Option<pb::Manifest> {
        Some(self.into())
    }
}

/// Lists of messages.
pub(super) fn read_all<T: TryFrom<W, Error = RegistryError>, W>(
    wire: Vec<W>,
) -> Result<Vec<T>, RegistryError> {
    wire.into_iter().map(T::try_from).collect()
}

/// Both conversions of a message whose fields are named alike on either side. A field is read by its type, or
/// by the function behind its name, which gets the field's name and its value. The check in front looks at
/// the message as a whole first.
macro_rules! both_ways {
    ($domain:ident = $wire:ident, $check:expr, {
        $($field:ident $(: $read:expr)?),* $(; $($list:ident),*)?
    }) => {
        impl TryFrom<pb::$wire> for $domain {
            type Error = RegistryError;

            fn try_from(wire: pb::$wire) -> Result<Self, RegistryError> {
                let check: fn(&pb::$wire) -> Result<(), RegistryError> = $check;
                check(&wire)?;
                Ok(Self {
                    $($field: both_ways!(@read wire, $field $(, $read)?)?,)*
                    $($($list: read_all(wire.$list)?,)*)?
                })
            }
        }

        impl From<$domain> for pb::$wire {
            fn from(value: $domain) -> Self {
                Self {
                    $($field: Field::write(value.$field),)*
                    $($($list: value.$list.into_iter().map(Into::into).collect(),)*)?
                }
            }
        }
    };
    (@read $wire:ident, $field:ident) => { Field::read(stringify!($field), $wire.$field) };
    (@read $wire:ident, $field:ident, $read:expr) => {
        $read(stringify!($field), $wire.$field)
    };
}
pub(super) use both_ways;
