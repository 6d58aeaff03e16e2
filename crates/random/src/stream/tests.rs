//! Worked examples of streams.

use super::*;

fn key() -> Key {
    Key { seed: 7, actor: 1, env: 2, episode: 3 }
}

fn words(key: Key, purpose: Purpose) -> Vec<u32> {
    let mut stream = Stream::new(key, purpose);
    (0..8).map(|_| stream.next_u32()).collect()
}

#[test]
fn golden_first_values() {
    // Saved runs depend on these bits: a change here breaks resuming and every golden hash.
    // The words are those of an independent ChaCha8 (key 7, 1, 2, 3; block counter 0; nonce 3):
    // 501440786 1510439254 685500871 2482589990 26898862 4154091974 2553122813 3741648086 …
    let mut stream = Stream::new(key(), Purpose::Reset);
    assert_eq!(stream.next_u32(), 501_440_786);
    assert_eq!(stream.next_u32(), 1_510_439_254);
    assert_eq!(stream.next_u32(), 685_500_871);
    // Low word first.
    assert_eq!(stream.next_u64(), 2_482_589_990 + (26_898_862 << 32));
    // 4154091974 >> 8 = 16226921; −1 + 4·16226921/2^24.
    assert_eq!(stream.uniform(-1.0, 3.0), -1.0 + 4.0 * (16_226_921.0 / 16_777_216.0));
    // (2553122813 + 3741648086·2^32) >> 11 = 7846804768097713.
    assert_eq!(
        stream.uniform_f64(-1.0, 3.0),
        -1.0 + 4.0 * (7_846_804_768_097_713.0 / 9_007_199_254_740_992.0)
    );
    assert_eq!(stream.normal(), -2.397_217_5);
    assert_eq!(stream.below(1000), 351);
}

#[test]
fn key_bytes_are_the_four_numbers_little_endian() {
    let bytes = Key { seed: 0x0102, actor: 3, env: 4, episode: 5 }.to_bytes();
    let mut expected = [0u8; 32];
    expected[0] = 0x02;
    expected[1] = 0x01;
    expected[8] = 3;
    expected[16] = 4;
    expected[24] = 5;
    assert_eq!(bytes, expected);
    assert_eq!(Key::for_run(9).to_bytes()[0], 9);
}

#[test]
fn same_key_and_purpose_give_the_same_bits() {
    assert_eq!(words(key(), Purpose::Push), words(key(), Purpose::Push));
}

#[test]
fn every_field_of_the_key_and_the_purpose_change_the_bits() {
    let base = words(key(), Purpose::Push);
    let others = [
        words(Key { seed: 8, ..key() }, Purpose::Push),
        words(Key { actor: 0, ..key() }, Purpose::Push),
        words(Key { env: 0, ..key() }, Purpose::Push),
        words(Key { episode: 0, ..key() }, Purpose::Push),
        words(key(), Purpose::Sensor),
    ];
    for other in others {
        assert_ne!(base, other);
    }
}

#[test]
fn purposes_are_independent() {
    // Correlation of two purposes over n = 40,000 uniforms: standard error 1/√n = 0.005; 4.5 of them.
    let (mut a, mut b) = (Stream::new(key(), Purpose::Sensor), Stream::new(key(), Purpose::Action));
    let n = 40_000;
    let mut sum = 0.0;
    for _ in 0..n {
        sum += a.uniform_f64(-1.0, 1.0) * b.uniform_f64(-1.0, 1.0);
    }
    // Var(U(−1, 1)) = 1/3.
    let correlation = 3.0 * sum / f64::from(n);
    assert!(correlation.abs() < 0.0225, "{correlation}");
}

#[test]
fn restored_mid_stream_goes_on_with_the_same_bits() {
    // Odd word counts and counts beyond ChaCha's buffer of 64 words.
    for taken in [0, 1, 15, 16, 17, 63, 64, 65, 127, 128, 1001] {
        let mut stream = Stream::new(key(), Purpose::Command);
        for _ in 0..taken {
            stream.next_u32();
        }
        assert_eq!(stream.word_position(), taken);
        let text = serde_json::to_string(&stream).unwrap();
        let mut restored: Stream = serde_json::from_str(&text).unwrap();
        assert_eq!(restored, stream);
        for _ in 0..200 {
            assert_eq!(restored.next_u64(), stream.next_u64(), "after {taken}");
            assert_eq!(restored.normal().to_bits(), stream.normal().to_bits());
        }
        assert_eq!(restored, stream);
    }
}

#[test]
fn damaged_saves_are_refused() {
    for text in [
        "{}",
        r#"{"key":{"seed":1,"actor":0,"env":0,"episode":0},"purpose":"Nothing","word_position":0}"#,
        r#"{"key":{"seed":1,"actor":0,"env":0,"episode":0},"purpose":"Push","word_position":-1}"#,
    ] {
        assert!(serde_json::from_str::<Stream>(text).is_err(), "{text}");
    }
}

#[test]
fn uniform_has_the_right_bounds_and_moments() {
    // U(−2, 4): mean 1, variance 36/12 = 3. n = 100,000: standard error of the mean √(3/n) = 0.0055.
    let mut stream = Stream::new(key(), Purpose::Init);
    let n = 100_000;
    let (mut sum, mut squares) = (0.0, 0.0);
    for _ in 0..n {
        let x = f64::from(stream.uniform(-2.0, 4.0));
        assert!((-2.0..=4.0).contains(&x));
        sum += x;
        squares += (x - 1.0) * (x - 1.0);
    }
    assert!((sum / f64::from(n) - 1.0).abs() < 0.025);
    assert!((squares / f64::from(n) - 3.0).abs() < 0.05);
    assert_eq!(stream.uniform(0.3, 0.3), 0.3);
    let reversed = stream.uniform(1.0, 0.0);
    assert!((0.0..=1.0).contains(&reversed));
}

#[test]
fn normal_has_the_right_moments() {
    // N(0, 1): moments 0, 1, 0, 3. n = 200,000: standard errors 0.0022, 0.0032, 0.0087, 0.022.
    let mut stream = Stream::new(key(), Purpose::Action);
    let n = 200_000;
    let mut moments = [0.0f64; 4];
    for _ in 0..n {
        let x = f64::from(stream.normal());
        for (power, moment) in moments.iter_mut().enumerate() {
            *moment += x.powi(power as i32 + 1) / f64::from(n);
        }
    }
    for (found, (expected, error)) in
        moments.into_iter().zip([(0.0, 0.0022), (1.0, 0.0032), (0.0, 0.0087), (3.0, 0.022)])
    {
        assert!((found - expected).abs() < 4.5 * error, "{moments:?}");
    }
}

#[test]
fn bell_noise_is_the_sum_of_four_bytes() {
    // The first word is 501440786 = 0x1DE3_6112: 0x1D + 0xE3 + 0x61 + 0x12 = 29 + 227 + 97 + 18 = 371;
    // 371 − 510 = −139; √21845 = 147.80; 1 + 2·(−139/147.80) = −0.88091
    let mut stream = Stream::new(key(), Purpose::Reset);
    let mut values = [1.0];
    stream.add_bell_noise(&mut values, 2.0);
    assert!((values[0] + 0.880_91).abs() < 1e-5, "{}", values[0]);
    assert_eq!(stream.word_position(), 1);
}

#[test]
fn bell_noise_has_the_right_moments() {
    // Mean 0, variance 1, kurtosis 3 − 1.2/4 = 2.7; n = 200,000: standard errors 0.0022, 0.0029, 0.016.
    let mut stream = Stream::new(key(), Purpose::Sensor);
    let n = 200_000;
    let mut values = vec![0.0f32; n];
    stream.add_bell_noise(&mut values, 1.0);
    let moment = |power| values.iter().map(|x| f64::from(*x).powi(power)).sum::<f64>() / n as f64;
    assert!(moment(1).abs() < 0.01);
    assert!((moment(2) - 1.0).abs() < 0.013);
    assert!((moment(4) - 2.7).abs() < 0.08);
    assert!(values.iter().all(|x| x.abs() < 3.46));
}

#[test]
fn below_is_unbiased_and_in_range() {
    // 6 faces, n = 60,000: 10,000 each, standard deviation √(n·1/6·5/6) = 91.
    let mut stream = Stream::new(key(), Purpose::Minibatch);
    let mut counts = [0i64; 6];
    for _ in 0..60_000 {
        counts[stream.below(6) as usize] += 1;
    }
    for count in counts {
        assert!((count - 10_000).abs() < 411, "{counts:?}");
    }
    assert_eq!(stream.below(0), 0);
    assert_eq!(stream.below(1), 0);
    // 3·2^62: a plain modulo of 64 bits would give the first third twice as often as the others.
    let (n, mut low) = (3u64 << 62, 0);
    for _ in 0..30_000 {
        low += i64::from(stream.below(n) < 1 << 62);
    }
    // A third of 30,000, standard deviation √(n·1/3·2/3) = 82.
    assert!((low - 10_000).abs() < 367, "{low}");
}

#[test]
fn chance_follows_p() {
    let mut stream = Stream::new(key(), Purpose::Push);
    let hits = (0..40_000).filter(|_| stream.chance(0.25)).count() as i64;
    // 10,000 expected, standard deviation √(40,000·0.25·0.75) = 87.
    assert!((hits - 10_000).abs() < 390, "{hits}");
    for _ in 0..100 {
        assert!(stream.chance(1.0));
        assert!(!stream.chance(0.0));
        assert!(!stream.chance(f32::NAN));
    }
}

#[test]
fn shuffle_keeps_the_items_and_every_place_is_equally_likely() {
    let mut stream = Stream::new(key(), Purpose::Minibatch);
    let mut first = [0i64; 5];
    for _ in 0..25_000 {
        let mut items = [0usize, 1, 2, 3, 4];
        stream.shuffle(&mut items);
        first[items[0]] += 1;
        items.sort_unstable();
        assert_eq!(items, [0, 1, 2, 3, 4]);
    }
    // 5,000 each, standard deviation √(25,000·0.2·0.8) = 63.
    for count in first {
        assert!((count - 5_000).abs() < 285, "{first:?}");
    }
    stream.shuffle::<u8>(&mut []);
}
