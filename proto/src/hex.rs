//! Hashes and signatures as hexadecimal digits.

use serde::{Deserialize, Deserializer, Serializer};

/// Lower-case hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    ::hex::encode(bytes)
}

/// The bytes of pairs of hexadecimal digits.
pub fn from_hex(text: &str) -> Option<Vec<u8>> {
    ::hex::decode(text).ok()
}

/// For serde: bytes as hexadecimal.
///
/// # Errors
/// What the format says.
pub fn serialize<S: Serializer>(bytes: &[u8], to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(&hex(bytes))
}

/// For serde: bytes from hexadecimal.
///
/// # Errors
/// Text that is none.
pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<u8>, D::Error> {
    let text = String::deserialize(from)?;
    from_hex(&text).ok_or_else(|| serde::de::Error::custom("not hexadecimal"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_come_back_and_what_is_no_digit_does_not() {
        assert_eq!(hex(&[0, 9, 0xaf]), "0009af");
        assert_eq!(from_hex("0009AF"), Some(vec![0, 9, 0xaf]));
        for bad in ["0", "0g", "+1", "ä"] {
            assert_eq!(from_hex(bad), None, "{bad}");
        }
    }
}
