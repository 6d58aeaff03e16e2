//! Sealing answers: a text that only the holder of the key can read, and that shows if it was changed.
//!
//! The diagnosing process gets a case folder and nothing else; answers lie elsewhere, encrypted (ChaCha8 as
//! in `crates/random`, the key a hash of a secret), so that a process with all of a machine's permissions
//! still cannot read them by accident or design.

use caudata_random::{Key, Purpose, Stream};
use sha2::{Digest, Sha256};

/// Bytes of the checksum in front.
const TAG: usize = 32;

/// Why a seal did not open.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SealError {
    /// Too short to be sealed text.
    #[error("sealed answers are cut off; make the set again")]
    Short,
    /// Wrong secret or changed bytes.
    #[error("sealed answers do not open with this secret; use the one that the set was made with")]
    Wrong,
}

/// Seals `text` with `secret`.
pub fn seal(text: &[u8], secret: &[u8]) -> Vec<u8> {
    let mut plain = Sha256::digest(text).to_vec();
    plain.extend_from_slice(text);
    mask(&mut plain, secret);
    plain
}

/// Opens what [`seal`] made.
pub fn open(sealed: &[u8], secret: &[u8]) -> Result<Vec<u8>, SealError> {
    if sealed.len() < TAG {
        return Err(SealError::Short);
    }
    let mut plain = sealed.to_vec();
    mask(&mut plain, secret);
    let text = plain.split_off(TAG);
    if Sha256::digest(&text).as_slice() == plain { Ok(text) } else { Err(SealError::Wrong) }
}

fn mask(bytes: &mut [u8], secret: &[u8]) {
    let hash = Sha256::digest(secret);
    let word = |i: usize| {
        let mut eight = [0; 8];
        eight.copy_from_slice(&hash[8 * i..8 * i + 8]);
        u64::from_le_bytes(eight)
    };
    let key = Key { seed: word(0), actor: word(1), env: word(2), episode: word(3) };
    let mut stream = Stream::new(key, Purpose::Init);
    for chunk in bytes.chunks_mut(4) {
        for (byte, mask) in chunk.iter_mut().zip(stream.next_u32().to_le_bytes()) {
            *byte ^= mask;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opens_with_the_secret_and_only_with_it() {
        let text = b"gear_backlash at swing";
        let sealed = seal(text, b"secret");
        assert_eq!(open(&sealed, b"secret").unwrap(), text);
        assert_eq!(open(&sealed, b"Secret"), Err(SealError::Wrong));
        assert_eq!(open(&sealed[..20], b"secret"), Err(SealError::Short));
        let mut bent = sealed.clone();
        bent[40] ^= 1;
        assert_eq!(open(&bent, b"secret"), Err(SealError::Wrong));
        // nothing of the text stands in the sealed bytes
        let words: [&[u8]; 2] = [b"gear", b"swing"];
        for word in words {
            assert!(!sealed.windows(word.len()).any(|w| w == word));
        }
    }
}
