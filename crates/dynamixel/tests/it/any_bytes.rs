//! Whatever arrives: no panic, no frame with a wrong CRC, and the parser is back in step as soon as good
//! bytes come.

use caudata_dynamixel::crc::crc16;
use caudata_dynamixel::emulator::{EmulatedBus, EmulatedServo};
use caudata_dynamixel::frame::{FRAME_MAX, Framer, Instruction, STATUS, encode, unstuff};
use caudata_dynamixel::xm430;
use proptest::prelude::*;

/// Bytes in which headers, lengths and stuffing are frequent.
fn spiteful() -> impl Strategy<Value = Vec<u8>> {
    let piece = prop_oneof![
        Just(vec![0xFF, 0xFF, 0xFD, 0x00]),
        Just(vec![0xFF, 0xFF, 0xFD, 0xFD]),
        Just(vec![0xFF, 0xFF, 0xFD, 0x00, 0x01, 0xFF, 0xFF]),
        Just(vec![0xFF]),
        proptest::collection::vec(any::<u8>(), 0..40),
    ];
    proptest::collection::vec(piece, 0..40).prop_map(|pieces| pieces.concat())
}

fn frames(framer: &mut Framer) -> Vec<Vec<u8>> {
    let mut found = Vec::new();
    while let Some(frame) = framer.next_frame() {
        let (whole, crc) = frame.raw.split_at(frame.raw.len() - 2);
        assert_eq!(crc16(whole).to_le_bytes(), crc);
        found.push(frame.raw.to_vec());
    }
    found
}

proptest! {
    #[test]
    fn parameters_come_back(id in 0..=252_u8, parameters in spiteful()) {
        let parameters = &parameters[..parameters.len().min(400)];
        let mut out = Vec::new();
        encode(id, STATUS, parameters, &mut out);
        let mut framer = Framer::new();
        framer.push(&out);
        let frame = framer.next_frame().unwrap();
        let mut body = frame.body().to_vec();
        let length = unstuff(&mut body);
        prop_assert_eq!(&body[1..length], parameters);
    }

    #[test]
    fn a_header_never_appears_inside_what_is_stuffed(parameters in spiteful()) {
        let mut out = Vec::new();
        encode(1, Instruction::Write as u8, &parameters, &mut out);
        let inside = &out[7..out.len() - 2];
        prop_assert!(!inside.windows(4).any(|w| w == [0xFF, 0xFF, 0xFD, 0x00]));
    }

    #[test]
    fn garbage_in_any_pieces_never_panics_and_a_good_frame_is_found_after_it(
        garbage in spiteful(), step in 1..64_usize,
    ) {
        let mut framer = Framer::new();
        for piece in garbage.chunks(step) {
            framer.push(piece);
            frames(&mut framer);
        }
        // The garbage may announce a frame of up to FRAME_MAX that never comes; zeros bring that to its end.
        framer.push(&[0; FRAME_MAX]);
        frames(&mut framer);
        let mut good = Vec::new();
        encode(9, STATUS, &[0, 1, 2, 3], &mut good);
        framer.push(&good);
        prop_assert_eq!(frames(&mut framer).pop(), Some(good));
    }

    #[test]
    fn bytes_one_at_a_time_are_the_same_as_all_at_once(garbage in spiteful()) {
        let garbage = &garbage[..garbage.len().min(FRAME_MAX)];
        let (mut once, mut slow) = (Framer::new(), Framer::new());
        once.push(garbage);
        let all = frames(&mut once);
        let mut one_by_one = Vec::new();
        for byte in garbage {
            slow.push(std::slice::from_ref(byte));
            one_by_one.extend(frames(&mut slow));
        }
        prop_assert_eq!(all, one_by_one);
    }

    #[test]
    fn an_emulated_servo_takes_anything(garbage in spiteful(), asked in any::<u8>(), parameters in spiteful()) {
        let mut bus = EmulatedBus::new(vec![EmulatedServo::new(1, xm430::MODEL_W210)], 1);
        bus.host_baud = 57_600;
        bus.hear(&garbage, 0);
        for id in [1, 0xFE] {
            let mut question = Vec::new();
            encode(id, asked, &parameters, &mut question);
            bus.hear(&question, 1000);
        }
        let mut out = Vec::new();
        bus.collect(u64::MAX, &mut out);
    }
}
