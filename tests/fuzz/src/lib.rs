//! Spoils bytes that come in from outside, for the doors in `tests/doors.rs`. `make test` knocks for two seconds each
//! with what is kept in `corpus/<door>/`, then spoilt at random; `make fuzz` for a minute each with what libFuzzer
//! makes of it (`guided.rs`).
//!
//! An input that breaks a rule is kept there and is among the first to be tried ever after.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout)]
// Only the allocator sees every allocation; an allocator cannot be written without `unsafe`.
#![allow(unsafe_code)]
// `make fuzz` sets `fuzzing`.
#![allow(unexpected_cfgs)]

#[cfg(fuzzing)]
mod guided;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use caudata_chaos_proxy::Dice;
use sha2::{Digest, Sha256};

thread_local! {
    /// Bytes that this thread holds, and the most that it held.
    static HELD: Cell<[usize; 2]> = const { Cell::new([0; 2]) };
}

struct Counting;

// SAFETY: every call goes to the system's allocator unchanged; sizes are only counted beside it.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = HELD.try_with(|held| {
            let [now, peak] = held.get();
            let now = now.saturating_add(layout.size());
            held.set([now, peak.max(now)]);
        });
        // SAFETY: the caller keeps `alloc`'s contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        let _ = HELD.try_with(|held| {
            let [now, peak] = held.get();
            held.set([now.saturating_sub(layout.size()), peak]);
        });
        // SAFETY: `memory` came from `System.alloc` with this layout.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Bytes that parsers trip over: ends of number ranges, long varints, headers, brackets.
const SPITE: [&[u8]; 14] = [
    &[0],
    &[0xFF],
    &[0x7F, 0xFF, 0xFF, 0xFF],
    &[0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x01],
    &[0x80, 0x80, 0x80, 0x80, 0x08],
    &[0xFF, 0xFF, 0xFD, 0x00],
    b"nan",
    b"-1e999",
    b"\"",
    b"{{[[",
    b"../../../etc/passwd",
    b"\r\n",
    &[0x00, 0x00, 0xC0, 0x7F],
    "ä\u{202e}".as_bytes(),
];

/// Largest input that is worth a place in the repository, bytes.
#[cfg(fuzzing)]
const KEPT_BYTES: usize = 2048;
/// So many at most for each door.
#[cfg(fuzzing)]
const KEPT: usize = 32;

fn spoil(dice: &mut Dice, pool: &[Vec<u8>]) -> Vec<u8> {
    let mut below = |end: usize| dice.below(end.max(1) as u64) as usize;
    let mut bytes = pool[below(pool.len())].clone();
    for _ in 0..=below(6) {
        let (at, kind) = (below(bytes.len() + 1), below(8));
        match kind {
            0 if at < bytes.len() => bytes[at] ^= 1 << below(8),
            1 if at < bytes.len() => bytes[at] = below(256) as u8,
            2 => bytes.truncate(at),
            3 => {
                let piece = SPITE[below(SPITE.len())];
                bytes.splice(at..at, piece.iter().copied());
            }
            4 => {
                let piece = SPITE[below(SPITE.len())];
                let end = (at + piece.len()).min(bytes.len());
                bytes.splice(at..end, piece.iter().copied());
            }
            5 => {
                let end = (at + 1 + below(64)).min(bytes.len());
                bytes.drain(at..end);
            }
            6 => {
                let end = (at + 1 + below(64)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                bytes.splice(at..at, piece);
            }
            _ => {
                let other = &pool[below(pool.len())];
                let from = below(other.len() + 1);
                bytes.truncate(at);
                bytes.extend_from_slice(&other[from..]);
            }
        }
    }
    bytes.truncate(4 << 20);
    bytes
}

fn seconds() -> f64 {
    let told = std::env::var("CAUDATA_FUZZ_S").ok();
    told.map_or(2.0, |text| text.parse().expect("CAUDATA_FUZZ_S is a number of seconds"))
}

fn kept(door: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(door)
}

fn all_in(folder: &Path) -> Vec<Vec<u8>> {
    let files = std::fs::read_dir(folder).into_iter().flatten();
    let mut paths: Vec<PathBuf> = files.map(|f| f.unwrap().path()).collect();
    paths.sort();
    paths.iter().map(|p| std::fs::read(p).unwrap()).collect()
}

/// Knocks with spoilt `seeds`. `check` answers in words what came of it (new words make an input a seed) and
/// panics where a rule is broken. At most `memory` bytes may be held at once.
///
/// # Panics
/// Where an input breaks a rule; it is kept.
pub fn fuzz(
    door: &str,
    seeds: Vec<Vec<u8>>,
    memory: usize,
    mut check: impl FnMut(&[u8]) -> String,
) {
    let one = |bytes: &[u8]| {
        let held = HELD.get()[0];
        HELD.set([held, held]);
        let came = catch_unwind(AssertUnwindSafe(|| check(bytes)));
        let took = HELD.get()[1] - held;
        if came.is_err() || took > memory {
            keep(&kept(door), bytes);
            panic!("{door}: the input is kept (memory {took})");
        }
        came.unwrap()
    };
    #[cfg(fuzzing)]
    if let Some(corpus) = std::env::var_os("CAUDATA_FUZZ_CORPUS") {
        return guided(door, &seeds, &Path::new(&corpus).join(door), one);
    }
    let pool = [seeds, all_in(&kept(door))].concat();
    at_random(door, pool, one);
}

fn keep(folder: &Path, bytes: &[u8]) {
    let name: String = Sha256::digest(bytes)[..8].iter().map(|b| format!("{b:02x}")).collect();
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(folder.join(name), bytes).unwrap();
}

fn at_random(door: &str, mut pool: Vec<Vec<u8>>, mut one: impl FnMut(&[u8]) -> String) {
    // Digits differ from place to place; what is wrong does not.
    let mut said = |bytes: &[u8]| -> String {
        let words = one(bytes);
        words.chars().filter(|c| !c.is_ascii_digit()).collect()
    };
    let mut words: BTreeSet<String> = pool.iter().map(|bytes| said(bytes)).collect();
    let mut dice = Dice::new(0x9E37_79B9_7F4A_7C15 ^ door.len() as u64);
    let end = Instant::now() + Duration::from_secs_f64(seconds());
    let mut tried = 0_u64;
    while Instant::now() < end {
        let bytes = spoil(&mut dice, &pool);
        if words.insert(said(&bytes)) && pool.len() < 2000 {
            pool.push(bytes);
        }
        tried += 1;
    }
    println!("{door}: {tried} inputs, {} kinds of answer", words.len());
    assert!(words.len() > 1, "{door}: every input is treated alike");
}

/// Lets libFuzzer knock, with its flags of `CAUDATA_FUZZ_FLAGS`. Without any, tells which branches all that it
/// has found reaches; with `CAUDATA_FUZZ_KEEP`, small inputs that reach what smaller ones do not are kept.
#[cfg(fuzzing)]
fn guided(door: &str, seeds: &[Vec<u8>], found: &Path, mut one: impl FnMut(&[u8]) -> String) {
    for seed in seeds {
        keep(found, seed);
    }
    let kept = kept(door);
    std::fs::create_dir_all(&kept).unwrap();
    let flags = std::env::var("CAUDATA_FUZZ_FLAGS").unwrap_or_default();
    let flags: Vec<String> = flags.split_whitespace().map(str::to_owned).collect();
    if !flags.is_empty() {
        return guided::knock(&flags, &[found, &kept], |bytes| {
            one(bytes);
        });
    }
    let keeps = std::env::var_os("CAUDATA_FUZZ_KEEP").is_some();
    let mut all = [seeds.to_vec(), all_in(&kept)].concat();
    let own = all.len();
    let mut room = KEPT.saturating_sub(own - seeds.len());
    let mut new = all_in(found);
    new.sort_by_key(Vec::len);
    all.extend(new);
    let mut seen = Vec::new();
    for (number, bytes) in all.iter().enumerate() {
        one(bytes);
        let more = guided::mark(&mut seen);
        let worth = more && bytes.len() <= KEPT_BYTES && room > 0;
        if keeps && number >= own && worth {
            room -= 1;
            keep(&kept, bytes);
        }
    }
    for (function, [reached, all]) in guided::reached() {
        println!("reached\t{reached}\t{all}\t{function}");
    }
}
