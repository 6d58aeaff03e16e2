//! Round trips, every refusal by its name, and frames that were tampered with.

use proptest::prelude::*;
use prost::Message;

use super::*;
use crate::wire::rollout as pb;

/// A chunk of 3 steps, 2 lanes, 4 observations, 2 actions. Lane 1 runs out of time at step 0,
/// lane 0 fails at step 1, lane 0 runs out of time at step 2.
fn chunk() -> RolloutChunk {
    let numbers = |count: usize, offset: f32| -> Vec<f32> {
        (0..count).map(|i| offset + i as f32 / 8.0).collect()
    };
    let mut terminated = vec![false; 6];
    let mut truncated = vec![false; 6];
    truncated[1] = true;
    terminated[2] = true;
    truncated[4] = true;
    let last =
        |step, lane, offset| FinalObservation { step, lane, observation: numbers(4, offset) };
    let episode = |lane, terminated, reason| EpisodeSummary {
        lane,
        steps: 40,
        return_sum: 12.5,
        terms: vec![1.0, -2.0, 0.5],
        terminated,
        reason,
        mean_speed_mps: 0.25,
    };
    RolloutChunk {
        run_id: "2026-01-01_quick".into(),
        actor_id: 7,
        incarnation: 3,
        sequence: u64::MAX,
        policy_version: 12,
        policy_sha256: [1; 32],
        contract_hash: [2; 32],
        steps: 3,
        lanes: 2,
        obs_dim: 4,
        act_dim: 2,
        observations: numbers(32, -1.0),
        actions: numbers(12, 0.0),
        action_means: numbers(12, 0.5),
        log_std: vec![-0.5, -0.25],
        log_probs: numbers(6, -3.0),
        rewards: numbers(6, 0.1),
        terminated,
        truncated,
        final_observations: vec![last(0, 1, 9.0), last(2, 0, -9.0)],
        episodes: vec![episode(1, false, 0), episode(0, true, 4), episode(0, false, 0)],
        moments: Moments {
            count: 6,
            mean: vec![0.1, 0.2, 0.3, 0.4],
            m2: vec![1.0, 0.0, 2.5, 1e-3],
        },
        action_history: None,
        trace: Some(TraceContext { trace: [0xa5; 16], span: [1, 2, 3, 4, 5, 6, 7, 8] }),
    }
}

fn frame(chunk: &RolloutChunk) -> Vec<u8> {
    encode(&Envelope::Chunk(Box::new(chunk.clone())))
}

fn limits() -> DecodeLimits {
    DecodeLimits::default()
}

/// The reason for which a changed chunk is refused.
fn refused(change: impl FnOnce(&mut RolloutChunk)) -> DecodeError {
    let mut chunk = chunk();
    change(&mut chunk);
    decode(&frame(&chunk), &limits()).unwrap_err()
}

/// The reason for which a chunk is refused that was changed on the wire.
fn refused_on_wire(change: impl FnOnce(&mut pb::RolloutChunk)) -> DecodeError {
    let mut envelope = pb::Envelope::decode(frame(&chunk()).as_slice()).unwrap();
    let Some(pb::envelope::Body::Chunk(chunk)) = &mut envelope.body else { panic!("not a chunk") };
    change(chunk);
    decode(&envelope.encode_to_vec(), &limits()).unwrap_err()
}

#[test]
fn every_kind_of_frame_survives_the_round_trip() {
    let hello = ActorHello {
        run_id: "run".into(),
        actor_id: 1,
        incarnation: 2,
        lanes: 64,
        contract_hash: [3; 32],
        build: "0.1.0 (abc)".into(),
    };
    let bye = ActorBye {
        run_id: "run".into(),
        actor_id: 1,
        incarnation: 2,
        sent: 99,
        reason: "stopped by the learner".into(),
    };
    for envelope in [Envelope::Hello(hello), Envelope::Bye(bye), Envelope::Chunk(Box::new(chunk()))]
    {
        assert_eq!(decode(&encode(&envelope), &limits()).unwrap(), envelope);
    }
}

#[test]
fn a_refused_chunk_still_says_whose_it_is() {
    let mut poisoned = chunk();
    poisoned.rewards[0] = f32::NAN;
    let identity = chunk_identity(&frame(&poisoned)).unwrap();
    assert_eq!(identity.run_id, "2026-01-01_quick");
    let numbers = (identity.actor_id, identity.incarnation, identity.sequence);
    assert_eq!(numbers, (7, 3, u64::MAX));
    assert_eq!(identity.trace, poisoned.trace);
    let cut = &frame(&chunk())[..300];
    assert_eq!(chunk_identity(cut), None);
    poisoned.run_id = "forged\nline".into();
    assert_eq!(chunk_identity(&frame(&poisoned)), None);
}

#[test]
fn frames_are_ordinary_protobuf() {
    let sent = chunk();
    let message = pb::Envelope::decode(frame(&sent).as_slice()).unwrap();
    let Some(pb::envelope::Body::Chunk(wire)) = &message.body else { panic!("not a chunk") };
    // -1.0 is 0xbf800000; the flags of the six cells, lane after lane.
    assert_eq!(wire.observations[..4], [0, 0, 0x80, 0xbf]);
    assert_eq!(wire.truncated, [0, 1, 0, 0, 1, 0]);
    assert_eq!((wire.rewards.len(), wire.log_std.len()), (24, 8));
    // What another writer of the same message puts in another order reads the same.
    let Envelope::Chunk(got) = decode(&message.encode_to_vec(), &limits()).unwrap() else {
        panic!("not a chunk")
    };
    assert_eq!(*got, sent);
}

#[test]
fn denormals_and_negative_zero_keep_their_bits() {
    let mut sent = chunk();
    sent.observations[5] = f32::from_bits(1);
    sent.rewards[0] = -0.0;
    let Envelope::Chunk(got) = decode(&frame(&sent), &limits()).unwrap() else {
        panic!("not a chunk")
    };
    assert_eq!(got.observations[5].to_bits(), 1);
    assert_eq!(got.rewards[0].to_bits(), (-0.0_f32).to_bits());
}

#[test]
fn numbers_that_would_poison_the_learner_are_refused() {
    type Pick = fn(&mut RolloutChunk) -> &mut f32;
    let tensors: [(&str, Pick); 7] = [
        ("observations", |c| &mut c.observations[31]),
        ("actions", |c| &mut c.actions[0]),
        ("action_means", |c| &mut c.action_means[11]),
        ("log_std", |c| &mut c.log_std[1]),
        ("log_probs", |c| &mut c.log_probs[2]),
        ("rewards", |c| &mut c.rewards[5]),
        ("final_observations", |c| &mut c.final_observations[1].observation[3]),
    ];
    for (name, pick) in tensors {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let error = refused(|c| *pick(c) = bad);
            assert!(
                matches!(error, DecodeError::NotFinite { field, .. } if field == name),
                "{name}: {error}"
            );
        }
        let error = refused(|c| *pick(c) = -1.1e6);
        assert!(
            matches!(error, DecodeError::Magnitude { field, .. } if field == name),
            "{name}: {error}"
        );
    }
    for error in [
        refused(|c| c.episodes[0].return_sum = f32::NAN),
        refused(|c| c.episodes[1].mean_speed_mps = f32::INFINITY),
        refused(|c| c.episodes[2].terms[2] = f32::NAN),
    ] {
        assert_eq!(error.reason_id(), "episode");
    }
    for error in [
        refused(|c| c.moments.mean[0] = f64::NAN),
        refused(|c| c.moments.m2[1] = -1e-9),
        refused(|c| c.moments.m2[3] = f64::INFINITY),
        refused(|c| c.moments.count = 5),
    ] {
        assert_eq!(error.reason_id(), "moments");
    }
}

#[test]
fn tensors_must_have_the_length_that_the_dimensions_call_for() {
    type Change = fn(&mut RolloutChunk);
    let changes: [(&str, Change); 10] = [
        ("observations", |c| c.observations.truncate(24)),
        ("actions", |c| c.actions.push(0.0)),
        ("action_means", |c| c.action_means.clear()),
        ("log_std", |c| c.log_std.push(0.0)),
        ("log_probs", |c| c.log_probs.push(0.0)),
        ("rewards", |c| c.rewards.truncate(5)),
        ("terminated", |c| c.terminated.push(false)),
        ("truncated", |c| c.truncated.truncate(5)),
        ("moments.mean", |c| c.moments.mean.push(0.0)),
        ("moments.m2", |c| c.moments.m2.clear()),
    ];
    for (name, change) in changes {
        let error = refused(change);
        assert!(
            matches!(error, DecodeError::Length { field, .. } if field == name),
            "{name}: {error}"
        );
    }
    assert_eq!(refused_on_wire(|c| c.rewards.truncate(7)).reason_id(), "ragged");
}

#[test]
fn dimensions_have_limits_and_their_products_do_not_wrap() {
    for change in [
        (|c| c.steps = 0) as fn(&mut pb::RolloutChunk),
        |c| c.lanes = 0,
        |c| c.obs_dim = 0,
        |c| c.act_dim = 0,
        |c| c.steps = u32::MAX,
        |c| c.lanes = 65_537,
        |c| c.obs_dim = 4097,
        |c| c.act_dim = 257,
    ] {
        assert_eq!(refused_on_wire(change).reason_id(), "dimension");
    }
    // 2^16 · 2^16 · 2^32 is 0 in 64 bits: an empty tensor must still not fit.
    let mut envelope = pb::Envelope::decode(frame(&chunk()).as_slice()).unwrap();
    let Some(pb::envelope::Body::Chunk(c)) = &mut envelope.body else { panic!("not a chunk") };
    (c.steps, c.lanes, c.obs_dim) = (u32::MAX, u32::MAX, u32::MAX);
    c.observations.clear();
    c.final_observations = None;
    let open = DecodeLimits {
        max_steps: usize::MAX,
        max_lanes: usize::MAX,
        max_obs_dim: usize::MAX,
        ..limits()
    };
    let error = decode(&envelope.encode_to_vec(), &open).unwrap_err();
    assert!(
        matches!(error, DecodeError::Length { field: "observations", found: 0, .. }),
        "{error}"
    );
}

#[test]
fn final_observations_are_exactly_those_of_the_truncated_steps() {
    let at = |error: DecodeError| match error {
        DecodeError::FinalObservations { index, expected } => (index, expected),
        other => panic!("{other}"),
    };
    let missing = refused(|c| c.final_observations.truncate(1));
    assert_eq!(at(missing), (1, Some((2, 0))));
    let extra = refused(|c| c.truncated[4] = false);
    assert_eq!(at(extra), (1, None));
    let swapped = refused(|c| c.final_observations.swap(0, 1));
    assert_eq!(at(swapped), (0, Some((0, 1))));
    let elsewhere = refused(|c| c.final_observations[1].lane = 1);
    assert_eq!(at(elsewhere), (1, Some((2, 0))));
    let twice = refused(|c| c.final_observations[1] = c.final_observations[0].clone());
    assert_eq!(at(twice), (1, Some((2, 0))));
}

#[test]
fn flags_are_zero_or_one_and_never_both() {
    let both = refused(|c| c.terminated[4] = true);
    assert_eq!(both, DecodeError::FlagsOverlap { step: 2, lane: 0 });
    let two = refused_on_wire(|c| c.terminated[3] = 2);
    assert_eq!(two, DecodeError::Flag { field: "terminated", index: 3, value: 2 });
}

#[test]
fn episodes_that_cannot_be_are_refused() {
    for change in [
        (|c| c.episodes[2].lane = 2) as fn(&mut RolloutChunk),
        |c| c.episodes[0].steps = 0,
        |c| c.episodes = vec![c.episodes[0].clone(); 7],
    ] {
        assert_eq!(refused(change).reason_id(), "episode");
    }
    // Uneven terms give columns that do not fit each other.
    assert_eq!(refused(|c| c.episodes[1].terms.truncate(2)).reason_id(), "length");
    let many = refused(|c| c.episodes.iter_mut().for_each(|e| e.terms = vec![0.0; 65]));
    assert_eq!(many.reason_id(), "dimension");
}

#[test]
fn what_is_not_a_chunk_of_this_protocol_is_refused() {
    let mut envelope = pb::Envelope::decode(frame(&chunk()).as_slice()).unwrap();
    envelope.protocol = ROLLOUT_PROTOCOL + 1;
    let other = decode(&envelope.encode_to_vec(), &limits()).unwrap_err();
    assert_eq!(
        other,
        DecodeError::Protocol { found: ROLLOUT_PROTOCOL + 1, expected: ROLLOUT_PROTOCOL }
    );
    let empty = pb::Envelope { protocol: ROLLOUT_PROTOCOL, body: None };
    let empty = decode(&empty.encode_to_vec(), &limits()).unwrap_err();
    assert_eq!(empty.reason_id(), "missing");
    assert_eq!(refused_on_wire(|c| c.moments = None).reason_id(), "missing");
    assert_eq!(refused_on_wire(|c| c.trace.truncate(23)).reason_id(), "length");
    assert_eq!(refused_on_wire(|c| c.policy_sha256.truncate(31)).reason_id(), "hash_length");
    assert_eq!(refused_on_wire(|c| c.contract_hash.clear()).reason_id(), "hash_length");
    for bad in ["", "two words", "line\nbreak", "ü", &"x".repeat(129)] {
        assert_eq!(refused(|c| c.run_id = bad.to_owned()).reason_id(), "text", "{bad:?}");
    }
    let small = DecodeLimits { max_frame_bytes: 100, ..limits() };
    let large = decode(&frame(&chunk()), &small).unwrap_err();
    assert_eq!(large.reason_id(), "frame_too_large");
}

#[test]
fn a_frame_cut_anywhere_is_refused() {
    let frame = frame(&chunk());
    for end in 0..frame.len() {
        assert!(decode(&frame[..end], &limits()).is_err(), "cut after {end} bytes");
    }
}

#[test]
fn no_flipped_bit_does_harm() {
    for chunk in [chunk(), with_history()] {
        let good = frame(&chunk);
        let mut accepted = 0;
        for bit in 0..good.len() * 8 {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            // Where a flipped bit still gives a chunk, it is a right one.
            if let Ok(Envelope::Chunk(chunk)) = decode(&bad, &limits()) {
                chunk.check(&limits()).unwrap();
                accepted += 1;
            }
        }
        // The low bits of numbers cannot be told from data; lengths, flags and structure can.
        assert!(accepted > 0 && accepted < good.len() * 8, "{accepted}");
    }
}

prop_compose! {
    fn any_chunk()(steps in 1_usize..4, lanes in 1_usize..4, obs_dim in 1_usize..6, act_dim in 1_usize..4)
        (
            observations in values((steps + 1) * lanes * obs_dim),
            actions in values(steps * lanes * act_dim),
            rewards in values(steps * lanes),
            ends in proptest::collection::vec(0_u8..3, steps * lanes),
            ids in any::<(u32, u64, u64, u64)>(),
            steps in Just(steps), lanes in Just(lanes), obs_dim in Just(obs_dim), act_dim in Just(act_dim),
        ) -> RolloutChunk {
        let truncated: Vec<bool> = ends.iter().map(|&e| e == 2).collect();
        RolloutChunk {
            run_id: "r".into(),
            actor_id: ids.0,
            incarnation: ids.1,
            sequence: ids.2,
            policy_version: ids.3,
            policy_sha256: [7; 32],
            contract_hash: [8; 32],
            steps, lanes, obs_dim, act_dim,
            final_observations: (0..steps * lanes)
                .filter(|&cell| truncated[cell])
                .map(|cell| FinalObservation {
                    step: cell / lanes,
                    lane: cell % lanes,
                    observation: observations[..obs_dim].to_vec(),
                })
                .collect(),
            action_means: actions.clone(),
            log_std: vec![-1.0; act_dim],
            log_probs: rewards.clone(),
            terminated: ends.iter().map(|&e| e == 1).collect(),
            truncated,
            episodes: vec![],
            moments: Moments {
                count: (steps * lanes) as u64,
                mean: vec![0.5; obs_dim],
                m2: vec![0.25; obs_dim],
            },
            action_history: None,
            trace: None,
            observations, actions, rewards,
        }
    }
}

fn values(count: usize) -> impl Strategy<Value = Vec<f32>> {
    proptest::collection::vec(-1e6_f32..1e6, count)
}

proptest! {
    #[test]
    fn any_good_chunk_survives_the_round_trip(chunk in any_chunk()) {
        let envelope = Envelope::Chunk(Box::new(chunk));
        prop_assert_eq!(decode(&encode(&envelope), &limits()).unwrap(), envelope);
    }

    #[test]
    fn random_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..256)) {
        let _ = decode(&bytes, &limits());
    }

    #[test]
    fn a_frame_with_many_random_bytes_never_panics(
        edits in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..20)
    ) {
        let mut bytes = frame(&chunk());
        for (index, value) in edits {
            let at = index.index(bytes.len());
            bytes[at] = value;
        }
        if let Ok(Envelope::Chunk(chunk)) = decode(&bytes, &limits()) {
            prop_assert!(chunk.check(&limits()).is_ok());
        }
    }
}

/// [`chunk`] with the last action in columns 1 and 2 of every observation, within ± 1: 1.375 and 1.25 are cut
/// off.
fn with_history() -> RolloutChunk {
    let mut chunk = chunk();
    chunk.action_history = Some(ActionHistory { first: 1, steps: 1, clip: 1.0 });
    for cell in 0..6 {
        let ended = chunk.terminated[cell] || chunk.truncated[cell];
        for i in 0..2 {
            let action = if ended { 0.0 } else { chunk.actions[2 * cell + i].min(1.0) };
            chunk.observations[4 * (cell + 2) + 1 + i] = action;
        }
    }
    chunk
}

#[test]
fn past_actions_are_left_out_and_put_back() {
    let chunk = with_history();
    let envelope = Envelope::Chunk(Box::new(chunk.clone()));
    let frame = encode(&envelope);
    assert_eq!(decode(&frame, &DecodeLimits::default()).unwrap(), envelope);
    // Six observations without two floats each, and 9 bytes (two headers, 1, 1, 1.0) that say so: the lengths
    // of the tensor, the chunk have one byte or two either way.
    let plain = RolloutChunk { action_history: None, ..chunk };
    let plain = encode(&Envelope::Chunk(Box::new(plain))).len();
    assert!(
        (plain - 48 + 9..=plain - 48 + 13).contains(&frame.len()),
        "{} of {plain}",
        frame.len()
    );
}

#[test]
fn observations_that_do_not_follow_from_the_actions_are_sent_whole() {
    let right = with_history();
    let whole = RolloutChunk { action_history: None, ..right.clone() };
    let whole_len = encode(&Envelope::Chunk(Box::new(whole))).len();
    // One bit of one past action, the sign of a zero after an end, another limit, another column.
    let mut wrong = [right.clone(), right.clone(), right.clone(), right];
    wrong[0].observations[4 * 2 + 1] =
        f32::from_bits(wrong[0].observations[4 * 2 + 1].to_bits() ^ 1);
    wrong[1].observations[4 * 3 + 1] = -0.0;
    wrong[2].action_history.as_mut().unwrap().clip = 0.5;
    wrong[3].action_history.as_mut().unwrap().first = 2;
    for (i, chunk) in wrong.into_iter().enumerate() {
        let frame = encode(&Envelope::Chunk(Box::new(chunk.clone())));
        assert_eq!(frame.len(), whole_len, "{i}");
        let Envelope::Chunk(read) = decode(&frame, &DecodeLimits::default()).unwrap() else {
            unreachable!()
        };
        let bits = |xs: &[f32]| xs.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&read.observations), bits(&chunk.observations), "{i}");
    }
}

#[test]
fn past_actions_that_no_observation_can_have_are_refused() {
    let frame = encode(&Envelope::Chunk(Box::new(with_history())));
    let with = |change: fn(&mut pb::ActionHistory)| {
        let mut message = pb::Envelope::decode(frame.as_slice()).unwrap();
        let Some(pb::envelope::Body::Chunk(chunk)) = &mut message.body else { unreachable!() };
        change(chunk.action_history.as_mut().unwrap());
        decode(&message.encode_to_vec(), &DecodeLimits::default()).unwrap_err()
    };
    let changes: [fn(&mut pb::ActionHistory); 8] = [
        |h| h.steps = 0,
        |h| h.steps = 2,
        |h| h.steps = u32::MAX,
        |h| h.first = 3,
        |h| h.first = u32::MAX,
        |h| h.clip = 0.0,
        |h| h.clip = f32::NAN,
        |h| h.clip = f32::INFINITY,
    ];
    for (i, change) in changes.into_iter().enumerate() {
        assert_eq!(with(change).reason_id(), "action_history", "{i}");
    }
    // Without the word for it the tensor is too short.
    let mut message = pb::Envelope::decode(frame.as_slice()).unwrap();
    let Some(pb::envelope::Body::Chunk(chunk)) = &mut message.body else { unreachable!() };
    chunk.action_history = None;
    let error = decode(&message.encode_to_vec(), &DecodeLimits::default()).unwrap_err();
    assert_eq!(error.reason_id(), "length");
}

#[test]
fn a_small_frame_with_past_actions_cannot_ask_for_a_large_chunk() {
    let frame = encode(&Envelope::Chunk(Box::new(with_history())));
    let with = |change: fn(&mut pb::RolloutChunk), limits: &DecodeLimits| {
        let mut message = pb::Envelope::decode(frame.as_slice()).unwrap();
        let Some(pb::envelope::Body::Chunk(chunk)) = &mut message.body else { unreachable!() };
        change(chunk);
        decode(&message.encode_to_vec(), limits).unwrap_err()
    };
    // Final observations follow from the dimensions, too: without them it is the tensors that are looked at.
    let largest = |c: &mut pb::RolloutChunk| {
        (c.steps, c.lanes, c.obs_dim, c.act_dim) = (4096, 65_536, 4096, 256);
        c.final_observations = None;
    };
    let error = with(largest, &limits());
    let expected = 65_536 * (4096 + 4096 * (4096 - 256));
    assert_eq!(error, DecodeError::Length { field: "observations", found: 8 + 6 * 2, expected });
    for change in [
        (|c| c.steps = 4097) as fn(&mut pb::RolloutChunk),
        |c| c.lanes = 65_537,
        |c| c.obs_dim = 4097,
        |c| c.act_dim = 257,
        |c| c.obs_dim = 0,
        |c| c.act_dim = 0,
    ] {
        assert_eq!(with(change, &limits()).reason_id(), "dimension");
    }
    // Nor does a product wrap into something small.
    let open = DecodeLimits {
        max_steps: usize::MAX,
        max_lanes: usize::MAX,
        max_obs_dim: usize::MAX,
        ..limits()
    };
    let endless = |c: &mut pb::RolloutChunk| {
        (c.steps, c.lanes, c.obs_dim) = (u32::MAX, u32::MAX, u32::MAX);
        c.final_observations = None;
    };
    assert_eq!(with(endless, &open).reason_id(), "length");
    // What is right in itself, but not as long as the others.
    for (field, change) in [
        ("actions", (|c| c.actions.truncate(44)) as fn(&mut pb::RolloutChunk)),
        ("terminated", |c| c.terminated.truncate(5)),
        ("truncated", |c| c.truncated.truncate(5)),
        ("observations", |c| c.observations.truncate(28)),
    ] {
        let error = with(change, &limits());
        assert!(
            matches!(error, DecodeError::Length { field: named, .. } if named == field),
            "{field}: {error}"
        );
    }
}

/// The observations of `chunk` with its past actions where `history` says, straight from the definition:
/// value `a` of the action `k` steps before, unless an episode ended since; before the chunk, whatever is
/// there in its first observation.
fn remember(chunk: &mut RolloutChunk, history: ActionHistory) {
    let (n, d, act) = (chunk.lanes, chunk.obs_dim, chunk.act_dim);
    let ended =
        |t: usize, lane: usize| chunk.terminated[t * n + lane] || chunk.truncated[t * n + lane];
    let first = chunk.observations.clone();
    let mut observations = first.clone();
    for t in 1..=chunk.steps {
        for lane in 0..n {
            for k in 0..history.steps {
                for a in 0..act {
                    // Taken at t − 1 − k; lost where an episode ended at or after it.
                    let at = t as isize - 1 - k as isize;
                    let value = if (at.max(0) as usize..t).any(|s| ended(s, lane)) {
                        0.0
                    } else if at >= 0 {
                        chunk.actions[(at as usize * n + lane) * act + a]
                            .clamp(-history.clip, history.clip)
                    } else {
                        first[lane * d + history.first + (-at - 1) as usize * act + a]
                    };
                    observations[(t * n + lane) * d + history.first + k * act + a] = value;
                }
            }
        }
    }
    chunk.observations = observations;
    chunk.action_history = Some(history);
}

proptest! {
    #[test]
    fn whatever_is_left_out_comes_back_bit_for_bit(
        chunk in any_chunk(),
        steps in 1_usize..4,
        room in 0_usize..4,
        place in 0_usize..100,
        clip in 0.1_f32..3.0,
        noise in values(4 * 3 * 24),
    ) {
        let mut chunk = chunk;
        let len = steps * chunk.act_dim;
        chunk.obs_dim = 2 * len + room;
        chunk.observations = (0..(chunk.steps + 1) * chunk.lanes * chunk.obs_dim).map(|i| noise[i % noise.len()]).collect();
        chunk.moments = Moments {
            mean: vec![0.0; chunk.obs_dim],
            m2: vec![0.0; chunk.obs_dim],
            ..chunk.moments
        };
        for end in &mut chunk.final_observations {
            end.observation = vec![0.5; chunk.obs_dim];
        }
        let plain = frame(&chunk).len();
        let first = place % (chunk.obs_dim - len + 1);
        remember(&mut chunk, ActionHistory { first, steps, clip });
        let sent = frame(&chunk);
        // Up to 16 bytes say what is left out.
        prop_assert!(sent.len() + 4 * chunk.steps * chunk.lanes * len <= plain + 16);
        let Envelope::Chunk(read) = decode(&sent, &limits()).unwrap() else { unreachable!() };
        prop_assert_eq!(*read, chunk);
    }
}
