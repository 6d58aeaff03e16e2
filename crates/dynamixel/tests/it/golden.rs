//! The example packets of the ROBOTIS e-manual ("DYNAMIXEL Protocol 2.0", section on each instruction), byte
//! for byte, and the time that a tick takes on the wire, worked out by hand.

use caudata_dynamixel::frame::{BROADCAST_ID, Framer, Instruction, STATUS, encode, unstuff};
use caudata_dynamixel::group::common_answer;
use caudata_dynamixel::setup::tick_us;
use caudata_dynamixel::{Answer, GroupRead, StatusError};

fn hex(text: &str) -> Vec<u8> {
    let byte = |word: &str| u8::from_str_radix(word, 16).unwrap();
    text.split_whitespace().map(byte).collect()
}

#[test]
fn instruction_packets() {
    use Instruction::*;
    for (id, instruction, parameters, packet) in [
        (1, Ping, "", "FF FF FD 00 01 03 00 01 19 4E"),
        (BROADCAST_ID, Ping, "", "FF FF FD 00 FE 03 00 01 31 42"),
        (1, Read, "84 00 04 00", "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
        (1, Write, "74 00 00 02 00 00", "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89"),
        (1, Reboot, "", "FF FF FD 00 01 03 00 08 2F 4E"),
        (
            BROADCAST_ID,
            SyncRead,
            "84 00 04 00 01 02",
            "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
        ),
        (
            BROADCAST_ID,
            SyncWrite,
            "74 00 04 00 01 96 00 00 00 02 AA 00 00 00",
            "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
        ),
        (
            BROADCAST_ID,
            BulkRead,
            "01 90 00 02 00 02 92 00 01 00",
            "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
        ),
        (
            BROADCAST_ID,
            BulkWrite,
            "01 20 00 02 00 A0 00 02 1F 00 01 00 50",
            "FF FF FD 00 FE 10 00 93 01 20 00 02 00 A0 00 02 1F 00 01 00 50 B7 68",
        ),
    ] {
        let mut out = Vec::new();
        encode(id, instruction as u8, &hex(parameters), &mut out);
        assert_eq!(out, hex(packet), "{instruction:?}");
    }
}

#[test]
fn status_packets() {
    for (packet, id, body) in [
        ("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D", 1, "55 00 06 04 26"),
        ("FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0", 1, "55 00 A6 00 00 00"),
        ("FF FF FD 00 01 04 00 55 00 A1 0C", 1, "55 00"),
    ] {
        let mut framer = Framer::new();
        framer.push(&hex(packet));
        let frame = framer.next_frame().unwrap();
        assert_eq!((frame.id(), frame.instruction()), (id, STATUS));
        assert_eq!(frame.body(), hex(body));
        assert_eq!(framer.next_frame(), None);
    }
}

#[test]
fn stuffing_by_hand() {
    // FF FF FD in the parameters gets one more FD, and the length counts it: 2 + 2 + 4 + 3 = 11 = 3 + 7 + 1.
    let parameters = hex("74 00 FF FF FD 00 01");
    let mut out = Vec::new();
    encode(1, Instruction::Write as u8, &parameters, &mut out);
    assert_eq!(out[5..7], [11, 0]);
    assert_eq!(out[7..out.len() - 2], hex("03 74 00 FF FF FD FD 00 01"));
    let mut body = out[7..out.len() - 2].to_vec();
    let length = unstuff(&mut body);
    assert_eq!(body[1..length], parameters);
}

#[test]
fn the_common_answer_of_fast_sync_read() {
    // Servo 3 at 166; the CRC behind its share is that of the 14 bytes before it, 0x0884 (worked out bit by
    // bit).
    let shares = [
        (3, StatusError(0), hex("A6 00 00 00")),
        (7, StatusError(0x80), hex("1F 08 00 00")),
        (4, StatusError(0), hex("FF 03 00 00")),
    ];
    let mut out = Vec::new();
    common_answer(&shares, &mut out);
    assert_eq!(out[..16], hex("FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08"));
    // Header, id, length; then per servo error, id, data, CRC.
    assert_eq!(out.len(), 7 + 1 + 3 * 8);
    let mut framer = Framer::new();
    framer.push(&out);
    assert!(framer.next_frame().is_some());
    let group = GroupRead::new(&[3, 7, 4], 132, 4, true);
    assert_eq!(group.answer(0), Answer::Silent);
}

#[test]
fn a_tick_on_the_wire() {
    // 16 servos, 10 bytes read and a goal of 4 bytes written. The question has 30 bytes, each answer 21, the
    // goals 94: 460 bytes. At 1 Mbit/s a byte takes 10 µs: 4.6 ms, and 16 · 500 µs of return delay more; at
    // 57,600 baud 79.9 ms and the same 8 ms.
    assert_eq!(tick_us(16, 10, false, 0, 1_000_000), 4_600);
    assert_eq!(tick_us(16, 10, false, 500, 1_000_000), 12_600);
    assert!((tick_us(16, 10, false, 500, 57_600) as f64 - 87_900.0).abs() < 100.0);
    // One common answer of 232 bytes: 300 + 2,320 + 940 µs.
    assert_eq!(tick_us(16, 10, true, 0, 1_000_000), 3_560);
}
