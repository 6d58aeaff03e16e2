//! Fetching the bytes of a policy, taken up again where it was cut, and what they are checked for.

use std::time::{Duration, Instant};

use caudata_proto::checks::Check;
use caudata_proto::registry::{FetchPart, Manifest};
use caudata_proto::wire::registry as wire;
use sha2::{Digest, Sha256};

use crate::call::within;
use crate::client::RegistryClient;
use crate::error::ClientError;
use crate::limits::{CALL_TIMEOUT, FETCH_RETRIES, RATE_MIN, RETRY_PAUSE_MAX};

/// One message of a fetch, and what came before it.
struct Piece<'a> {
    manifest: &'a Manifest,
    /// From where on this answer was asked for.
    offset: u64,
    /// Bytes that came so far.
    have: usize,
    part: &'a FetchPart,
}

type PieceCheck = fn(&Piece<'_>) -> bool;
type WholeCheck = fn(&Manifest, &[u8]) -> bool;

/// What each message must be.
const PIECES: &[Check<PieceCheck>] = &[
    // What follows is the file that was asked for, from where it was asked for.
    Check::new("follows", |piece| match piece.part {
        FetchPart::Info(info) => {
            info.offset != piece.offset
                || info.size != piece.manifest.size
                || info.sha256 != piece.manifest.sha256
        }
        FetchPart::NotModified => true,
        FetchPart::Data(_) => false,
    }),
    // No byte more than announced is taken.
    Check::new("size", |piece| match piece.part {
        FetchPart::Data(data) => piece.have as u64 + data.len() as u64 > piece.manifest.size,
        _ => false,
    }),
];

/// What all of them together must be.
const WHOLE: &[Check<WholeCheck>] = &[
    Check { name: "length", refuse: |manifest, bytes| bytes.len() as u64 != manifest.size },
    Check::new("hash", |manifest, bytes| {
        <[u8; 32]>::from(Sha256::digest(bytes)) != manifest.sha256
    }),
];

/// The bytes that `part` adds to the `have` bytes that came so far, the first of this answer behind `offset`.
fn piece(
    checks: &[Check<PieceCheck>],
    manifest: &Manifest,
    offset: u64,
    have: usize,
    part: FetchPart,
) -> Result<Vec<u8>, ClientError> {
    let piece = Piece { manifest, offset, have, part: &part };
    if checks.iter().any(|check| (check.refuse)(&piece)) {
        return Err(ClientError::WrongBytes {
            reason: format!("the server left the {} bytes of the manifest", manifest.size),
        });
    }
    Ok(match part {
        FetchPart::Data(data) => data,
        _ => Vec::new(),
    })
}

/// Refuses what is not, byte for byte, the file of `manifest`.
fn check_whole(
    checks: &[Check<WholeCheck>],
    manifest: &Manifest,
    bytes: &[u8],
) -> Result<(), ClientError> {
    if !checks.iter().any(|check| (check.refuse)(manifest, bytes)) {
        return Ok(());
    }
    Err(ClientError::WrongBytes {
        reason: format!("{} of {} bytes came, or their hash differs", bytes.len(), manifest.size),
    })
}

impl RegistryClient {
    /// The bytes that `manifest` names: exactly its size, hashing to its SHA-256. A cut transfer goes on by
    /// offset.
    ///
    /// # Errors
    /// See [`ClientError`]; the last one after [`FETCH_RETRIES`] retries.
    pub async fn fetch(&mut self, manifest: &Manifest) -> Result<Vec<u8>, ClientError> {
        let mut bytes = Vec::with_capacity(usize::try_from(manifest.size).unwrap_or(0));
        let limit = self.patience.whole_max;
        let whole = self.fetch_with_retries(manifest, &mut bytes);
        tokio::time::timeout(limit, whole)
            .await
            .map_err(|_| ClientError::TimedOut { what: "fetch" })??;
        check_whole(WHOLE, manifest, &bytes)?;
        Ok(bytes)
    }

    async fn fetch_with_retries(
        &mut self,
        manifest: &Manifest,
        bytes: &mut Vec<u8>,
    ) -> Result<(), ClientError> {
        let mut pause = self.patience.retry_pause;
        let mut attempt = 0;
        loop {
            let before = bytes.len();
            match self.fetch_rest(manifest, bytes).await {
                Ok(()) => return Ok(()),
                Err(error) if error.is_transient() && attempt < FETCH_RETRIES => {
                    tracing::warn!(%error, got = bytes.len(), size = manifest.size, "fetch cut, going on");
                    // A connection that brings something each time is a bad one, not a dead one.
                    attempt = if bytes.len() > before { 0 } else { attempt + 1 };
                    tokio::time::sleep(jittered(pause)).await;
                    pause = (pause * 2).min(RETRY_PAUSE_MAX);
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Appends what is missing to `bytes`; on an error `bytes` holds what came so far.
    async fn fetch_rest(
        &mut self,
        manifest: &Manifest,
        bytes: &mut Vec<u8>,
    ) -> Result<(), ClientError> {
        let offset = bytes.len() as u64;
        if offset == manifest.size {
            return Ok(());
        }
        let request = wire::FetchRequest {
            sha256: manifest.sha256.to_vec(),
            offset,
            if_none_match: Vec::new(),
        };
        let call = self.inner.fetch(request);
        let mut answer = within("fetch", CALL_TIMEOUT, &self.address, call).await?.into_inner();
        let mut rate = Rate::new(self.patience.rate_window, Instant::now());
        while let Some(message) =
            within("fetch", self.patience.idle_max, &self.address, answer.message()).await?
        {
            let piece = piece(PIECES, manifest, offset, bytes.len(), message.try_into()?)?;
            bytes.extend_from_slice(&piece);
            if !piece.is_empty() {
                rate.add(piece.len() as u64, Instant::now())?;
            }
        }
        if (bytes.len() as u64) < manifest.size {
            return Err(ClientError::TimedOut { what: "fetch" });
        }
        Ok(())
    }
}

/// `pause` made up to half longer or shorter by chance, so that clients that lost the same server do not all
/// come back at once.
pub fn jittered(pause: Duration) -> Duration {
    use std::hash::{BuildHasher, Hasher};
    // Keyed anew in each process and each time, from the system's random source; nothing depends on its
    // quality.
    let draw = std::collections::hash_map::RandomState::new().build_hasher().finish();
    pause.mul_f64(0.5 + (draw >> 11) as f64 / (1u64 << 53) as f64)
}

/// Whether a transfer is fast enough.
struct Rate {
    window: Duration,
    since: Instant,
    bytes: u64,
}

impl Rate {
    fn new(window: Duration, now: Instant) -> Self {
        Self { window, since: now, bytes: 0 }
    }

    /// # Errors
    /// [`ClientError::TooSlow`] where the window that ends now brought too little.
    fn add(&mut self, bytes: u64, now: Instant) -> Result<(), ClientError> {
        self.bytes += bytes;
        if now.duration_since(self.since) < self.window {
            return Ok(());
        }
        if (self.bytes as f64) < RATE_MIN as f64 * self.window.as_secs_f64() {
            return Err(ClientError::TooSlow);
        }
        *self = Self::new(self.window, now);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use crate::limits::RATE_WINDOW;
    use caudata_proto::checks::each_left_out;
    use caudata_proto::registry::{FetchInfo, StreamName};

    use super::*;

    fn manifest(bytes: &[u8]) -> Manifest {
        Manifest {
            stream: StreamName::new("s").unwrap(),
            version: 1,
            sha256: Sha256::digest(bytes).into(),
            size: bytes.len() as u64,
            created_unix_ms: 5,
            run_id: "run".into(),
            contract_hash: [2; 32],
            robot_name: "polymander".into(),
            robot_hash: [3; 32],
            env_steps: 9,
            training_commit: String::new(),
            config_hash: String::new(),
            evaluation_json: None,
            reverts_to: None,
            signatures: Vec::new(),
        }
    }

    #[test]
    fn each_step_and_no_other_keeps_its_bytes_out() {
        let good = manifest(b"a policy");
        let pieces = each_left_out(PIECES, |name, checks| {
            let tried = match name {
                // Four bytes are there, and it begins anew.
                "follows" => {
                    let info = FetchInfo { sha256: good.sha256, size: good.size, offset: 0 };
                    piece(checks, &good, 4, 4, FetchPart::Info(info))
                }
                _ => piece(checks, &good, 0, 8, FetchPart::Data(vec![7])),
            };
            tried.map(drop)
        });
        let whole = each_left_out(WHOLE, |name, checks| match name {
            "length" => {
                let mut longer = good.clone();
                longer.size += 1;
                check_whole(checks, &longer, b"a policy")
            }
            _ => check_whole(checks, &good, b"A policy"),
        });
        // Seen with --nocapture: `make mutants`.
        for table in [pieces, whole] {
            eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
        }
    }

    #[test]
    fn pauses_scatter_around_their_length() {
        let pause = Duration::from_secs(10);
        let drawn: Vec<f64> = (0..200).map(|_| jittered(pause).as_secs_f64()).collect();
        assert!(drawn.iter().all(|p| (5.0..15.0).contains(p)), "{drawn:?}");
        let mean = drawn.iter().sum::<f64>() / 200.0;
        // Uniform over 10 s: standard error of 200 draws 0.2 s.
        assert!((9.0..11.0).contains(&mean), "{mean}");
        let spread = drawn.iter().filter(|p| **p < 7.5).count();
        assert!((20..80).contains(&spread), "{spread}");
    }

    #[test]
    fn fault_27_one_byte_per_second_is_too_slow_and_a_poor_network_is_not() {
        let start = Instant::now();
        let at = |s| start + Duration::from_secs(s);
        let mut drip = Rate::new(RATE_WINDOW, start);
        assert!((0..30).all(|s| drip.add(1, at(s)).is_ok()));
        assert!(matches!(drip.add(1, at(30)), Err(ClientError::TooSlow)));
        let mut poor = Rate::new(RATE_WINDOW, start);
        assert!((0..600).all(|s| poor.add(4200, at(s)).is_ok()));
        // What came fast at first does not count later.
        let mut stalls = Rate::new(RATE_WINDOW, start);
        assert!(stalls.add(1 << 20, at(1)).is_ok() && stalls.add(1, at(30)).is_ok());
        assert!(matches!(stalls.add(1, at(60)), Err(ClientError::TooSlow)));
    }
}
