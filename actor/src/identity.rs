//! Who an actor is where nobody counts actors: a number out of a name, an incarnation out of the clock.

use std::time::{SystemTime, UNIX_EPOCH};

use sha2::{Digest, Sha256};

/// Numbers out of names have this bit, so that they never meet the numbers that a supervisor counts from 0.
const NAMED: u32 = 1 << 31;

/// The number of an actor with this name: the same on every start. Of 1,000 names two share a number with a
/// probability of 0.02 %; such actors share one quota, and every chunk still counts once.
pub fn named_actor_id(name: &str) -> u32 {
    let digest: [u8; 32] = Sha256::digest(name.as_bytes()).into();
    let [a, b, c, d, ..] = digest;
    u32::from_be_bytes([a, b, c, d]) | NAMED
}

/// The incarnation of an actor that starts at `now`, seconds since 1970: a later start has a larger number,
/// on whichever host. Whoever starts actors must leave a second between two starts of one.
pub fn clock_incarnation(now: SystemTime) -> u64 {
    now.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

/// The name of this host, or of this container.
pub fn host_name() -> std::io::Result<String> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname")?;
    Ok(name.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_name_has_one_number_far_from_those_that_are_counted() {
        // SHA-256 of "abc" begins with ba 78 16 bf (FIPS 180-4, appendix B.1).
        assert_eq!(named_actor_id("abc"), 0xba78_16bf);
        for name in ["caudata-actor-6d9f-x2x4k", "", "node-7"] {
            assert!(named_actor_id(name) >= NAMED, "{name}");
        }
    }

    #[test]
    fn a_later_start_is_a_larger_incarnation() {
        let at = |seconds| clock_incarnation(UNIX_EPOCH + Duration::from_secs(seconds));
        assert_eq!(at(1_767_225_600), 1_767_225_600);
        assert!(at(2) > at(1));
    }
}
