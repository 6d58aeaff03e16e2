//! However a frame was tampered with, reading it takes no more memory than its limit says.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
// Only the allocator sees every allocation; an allocator cannot be written without `unsafe`.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use caudata_proto::rollout::ROLLOUT_PROTOCOL;
use caudata_proto::{DecodeLimits, decode};

static NOW: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

struct Counting;

// SAFETY: every call goes to the system's allocator unchanged; only sizes are counted beside it.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let now = NOW.fetch_add(layout.size(), Relaxed) + layout.size();
        PEAK.fetch_max(now, Relaxed);
        // SAFETY: the caller keeps `alloc`'s contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Relaxed);
        // SAFETY: `memory` came from `System.alloc` with this layout.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Most bytes that were allocated at once while a frame was read.
fn peak_of(frame: &[u8]) -> usize {
    let before = NOW.load(Relaxed);
    PEAK.store(before, Relaxed);
    let refused = decode(frame, &DecodeLimits::default()).unwrap_err();
    assert_ne!(refused.reason_id(), "protocol", "the frame is not read at all");
    PEAK.load(Relaxed) - before
}

/// A length-delimited protobuf field.
fn field(number: u32, payload: &[u8]) -> Vec<u8> {
    let mut bytes = varint(u64::from(number << 3 | 2));
    bytes.extend(varint(payload.len() as u64));
    bytes.extend_from_slice(payload);
    bytes
}

fn varint(mut value: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
    bytes
}

/// An envelope around the fields of a chunk.
fn envelope(chunk: &[u8]) -> Vec<u8> {
    let protocol = [varint(1 << 3), varint(ROLLOUT_PROTOCOL.into())].concat();
    [protocol, field(3, chunk)].concat()
}

#[test]
fn hostile_frames_cannot_ask_for_much_more_than_their_own_size() {
    // Announced lengths that are not there: a 2 GiB tensor in a few bytes.
    let mut announced = varint(12 << 3 | 2);
    announced.extend(varint(2 << 30));
    // A megabyte of empty sub-messages, empty tensors and unknown fields.
    let empty_episodes = field(21, &[]).repeat(1 << 18);
    let empty_tensors = field(12, &[]).repeat(1 << 19);
    let unknown = field(900, &[]).repeat(1 << 18);
    // A megabyte of the smallest episodes and of the smallest final observations.
    let count = 40_000_usize;
    let episodes = [
        field(1, &vec![0; count * 4]),
        field(2, &vec![0; count * 4]),
        field(3, &vec![0; count * 4]),
        field(6, &vec![0; count]),
        field(7, &vec![0; count]),
        field(8, &vec![0; count * 4]),
    ];
    let moments = field(22, &field(2, &[0; 8]));
    let hash = [7; 32];
    let finals = [
        field(1, &vec![0; count * 4]),
        field(2, &vec![0; count * 4]),
        field(3, &vec![0; count * 4]),
    ];
    let whole = [
        field(6, &hash),
        field(7, &hash),
        vec![10 << 3, 1],
        field(20, &finals.concat()),
        field(21, &episodes.concat()),
        moments,
    ];
    // Observations of two values, one of them left out: a chunk that grows as much as one can.
    let history = [vec![8, 0], vec![16, 1], [vec![29], 1.0_f32.to_le_bytes().to_vec()].concat()];
    let narrow = [
        field(6, &hash),
        field(7, &hash),
        [varint(8 << 3), varint(1)].concat(),
        [varint(9 << 3), varint(50_000)].concat(),
        vec![10 << 3, 2],
        vec![11 << 3, 1],
        field(12, &vec![0; (2 + 1) * 50_000 * 4]),
        field(13, &vec![0; 50_000 * 4]),
        field(18, &vec![0; 50_000]),
        field(19, &vec![0; 50_000]),
        field(22, &field(2, &[0; 8])),
        [varint(24 << 3 | 2), varint(9), history.concat()].concat(),
    ];
    for (name, chunk) in [
        ("announced", announced),
        ("empty episodes", empty_episodes),
        ("empty tensors", empty_tensors),
        ("unknown", unknown),
        ("smallest records", whole.concat()),
        ("past actions", narrow.concat()),
    ] {
        let frame = envelope(&chunk);
        let peak = peak_of(&frame);
        // Documented at `DecodeLimits::max_frame_bytes`; the constant is for small change.
        assert!(peak <= 5 * frame.len() + 4096, "{name}: {peak} for {}", frame.len());
    }
}
