//! What is accepted, refused, dropped and waited for.

use super::*;
use caudata_proto::{ActorBye, ActorHello, FinalObservation, Moments, encode};

const CONTRACT: [u8; 32] = [7; 32];

fn settings(max_lead: u32) -> CollectorSettings {
    CollectorSettings {
        run_id: "run".into(),
        contract_hash: CONTRACT,
        steps: 2,
        lanes: 1,
        obs_dim: 1,
        act_dim: 1,
        actors: 2,
        chunks_per_version: 1,
        max_lead,
        lockstep: false,
        max_lag: 4,
        min_share: 0.5,
        limits: DecodeLimits::default(),
    }
}

fn sha(version: u64) -> [u8; 32] {
    [version as u8; 32]
}

fn collector(max_lead: u32) -> Collector {
    let mut collector = Collector::new(settings(max_lead), Accounting::default());
    collector.policy_published(0, sha(0));
    collector
}

fn chunk(actor_id: u32, sequence: u64, policy_version: u64) -> RolloutChunk {
    RolloutChunk {
        run_id: "run".into(),
        actor_id,
        incarnation: 0,
        sequence,
        policy_version,
        policy_sha256: sha(policy_version),
        contract_hash: CONTRACT,
        steps: 2,
        lanes: 1,
        obs_dim: 1,
        act_dim: 1,
        observations: vec![0.0, 2.0, 5.0],
        actions: vec![0.0; 2],
        action_means: vec![0.0; 2],
        log_std: vec![0.0],
        log_probs: vec![0.0; 2],
        rewards: vec![0.0; 2],
        terminated: vec![false; 2],
        truncated: vec![false, true],
        final_observations: vec![FinalObservation { step: 1, lane: 0, observation: vec![9.0] }],
        episodes: Vec::new(),
        moments: Moments { count: 2, mean: vec![1.0], m2: vec![2.0] },
        action_history: None,
        trace: None,
    }
}

fn offer(collector: &mut Collector, chunk: RolloutChunk) -> Outcome {
    collector.offer(&encode(&Envelope::Chunk(Box::new(chunk))))
}

fn bye(actor_id: u32, incarnation: u64, sent: u64) -> Vec<u8> {
    let run_id = "run".into();
    encode(&Envelope::Bye(ActorBye { run_id, actor_id, incarnation, sent, reason: "test".into() }))
}

fn hello(actor_id: u32, incarnation: u64) -> Vec<u8> {
    encode(&Envelope::Hello(ActorHello {
        run_id: "run".into(),
        actor_id,
        incarnation,
        lanes: 1,
        contract_hash: CONTRACT,
        build: "test".into(),
    }))
}

fn reason(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Rejected(_, reason, _) => reason,
        Outcome::Dropped(_, reason) => reason.name(),
        Outcome::Duplicate(_) => "duplicate",
        Outcome::Waiting(_) => "waiting",
        Outcome::Hello(_) => "hello",
        Outcome::Bye(_) => "bye",
    }
}

#[test]
fn a_batch_is_complete_when_all_have_sent_and_its_order_is_not_that_of_arrival() {
    let mut forward = collector(0);
    assert_eq!(reason(offer(&mut forward, chunk(0, 0, 0))), "waiting");
    assert!(!forward.is_ready());
    assert_eq!(reason(offer(&mut forward, chunk(1, 0, 0))), "waiting");
    assert!(forward.is_ready());
    let mut backward = collector(0);
    offer(&mut backward, chunk(1, 0, 0));
    offer(&mut backward, chunk(0, 0, 0));
    assert_eq!(forward.take(), backward.take());
    assert_eq!(forward.accounting().report().accepted, 2);
}

#[test]
fn in_sync_only_chunks_of_the_current_version_are_used() {
    let mut collector = collector(0);
    collector.policy_published(1, sha(1));
    assert_eq!(reason(offer(&mut collector, chunk(0, 0, 0))), "stale");
    assert_eq!(reason(offer(&mut collector, chunk(0, 1, 1))), "waiting");
    // A second one of the same version and actor is beyond its quota: a restarted actor collects again.
    let again = RolloutChunk { incarnation: 1, ..chunk(0, 0, 1) };
    assert_eq!(reason(offer(&mut collector, again)), "surplus");
    // What waits when the next version comes is too old.
    collector.policy_published(2, sha(2));
    assert_eq!(collector.waiting(), 0);
    assert_eq!(collector.accounting().summary().reasons["stale"], 2);
    assert!(collector.accounting().holds());
}

#[test]
fn with_a_lead_older_chunks_are_used_up_to_the_lag_oldest_first() {
    let mut collector = collector(1);
    for version in 1..=5 {
        collector.policy_published(version, sha(version));
    }
    assert_eq!(reason(offer(&mut collector, chunk(0, 0, 0))), "stale");
    offer(&mut collector, chunk(0, 1, 5));
    offer(&mut collector, chunk(0, 2, 4));
    offer(&mut collector, chunk(1, 0, 3));
    let versions: Vec<u64> = collector.take().iter().map(|c| c.policy_version).collect();
    assert_eq!(versions, [3, 4]);
    assert_eq!(collector.waiting(), 1);
}

#[test]
fn what_no_honest_actor_sends_is_refused_by_name_and_three_times_is_enough() {
    type Change = fn(&mut RolloutChunk);
    let changes: [(&str, Change); 6] = [
        ("contract", |c| c.contract_hash = [8; 32]),
        ("dimensions", |c| {
            c.obs_dim = 2;
            c.observations = vec![0.0; 6];
            c.final_observations[0].observation = vec![0.0; 2];
            c.moments = Moments { count: 2, mean: vec![0.0; 2], m2: vec![0.0; 2] };
        }),
        ("policy_hash", |c| c.policy_sha256 = [9; 32]),
        ("quarantined", |_| {}),
        ("wrong_run", |c| c.run_id = "other".into()),
        ("sequence", |c| c.sequence = u64::MAX),
    ];
    let mut collector = collector(0);
    for (sequence, (expected, change)) in changes.into_iter().enumerate() {
        let mut bad = chunk(0, sequence as u64, 0);
        change(&mut bad);
        assert_eq!(reason(offer(&mut collector, bad)), expected);
    }
    // Actor 0 is not waited for any more: actor 1's chunk completes the batch.
    offer(&mut collector, chunk(1, 0, 0));
    assert!(collector.is_ready());
    assert!(collector.accounting().holds());
    // A new incarnation of it is heard again.
    let reborn = RolloutChunk { incarnation: 1, ..chunk(0, 0, 0) };
    assert_eq!(reason(offer(&mut collector, reborn)), "waiting");
}

#[test]
fn a_poisoned_frame_is_put_down_to_its_actor() {
    let mut collector = collector(0);
    let mut bad = chunk(0, 0, 0);
    bad.rewards[1] = f32::NAN;
    assert_eq!(reason(offer(&mut collector, bad)), "not_finite");
    assert_eq!(reason(collector.offer(b"not a frame")), "malformed");
    assert_eq!(reason(offer(&mut collector, chunk(0, 1, 0))), "waiting");
    let report = collector.accounting().report();
    assert_eq!(report.actors[0].rejected["not_finite"], 1);
    assert_eq!(report.unattributed["malformed"], 1);
    assert!(report.holds);
}

#[test]
fn replayed_and_reordered_frames_count_once() {
    let mut collector = collector(1);
    assert_eq!(reason(offer(&mut collector, chunk(0, 1, 0))), "waiting");
    assert_eq!(reason(offer(&mut collector, chunk(0, 0, 0))), "waiting");
    assert_eq!(reason(offer(&mut collector, chunk(0, 1, 0))), "duplicate");
    let report = collector.accounting().report();
    assert_eq!((report.sent, report.waiting, report.duplicates), (2, 2, 1));
}

#[test]
fn actors_that_left_or_fell_silent_are_not_waited_for() {
    let mut collector = collector(0);
    offer(&mut collector, chunk(0, 0, 0));
    assert!(!collector.is_ready() && collector.has_enough());
    assert_eq!(collector.take().len(), 1); // the time-out struck: actor 1 sent nothing
    collector.policy_published(1, sha(1));
    offer(&mut collector, chunk(0, 1, 1));
    assert!(collector.is_ready(), "actor 1 is not waited for");
    collector.take();
    collector.policy_published(2, sha(2));
    collector.offer(&hello(1, 1));
    offer(&mut collector, chunk(0, 2, 2));
    assert!(!collector.is_ready(), "it is back");
    // The goodbye of its former incarnation comes late and changes nothing; its own does.
    collector.offer(&bye(1, 0, 0));
    assert!(!collector.is_ready());
    collector.offer(&bye(1, 1, 0));
    assert!(collector.is_ready());
}

#[test]
fn chunks_of_a_learner_that_got_further_are_not_held_against_the_actor() {
    let mut collector = collector(0);
    for sequence in 0..5 {
        assert_eq!(reason(offer(&mut collector, chunk(0, sequence, 40))), "unknown_policy");
    }
    assert_eq!(reason(offer(&mut collector, chunk(0, 5, 0))), "waiting");
}

#[test]
fn at_the_end_what_is_left_over_is_counted() {
    let mut collector = collector(0);
    offer(&mut collector, chunk(0, 0, 0));
    collector.close();
    assert_eq!(reason(offer(&mut collector, chunk(1, 0, 0))), "at_shutdown");
    collector.offer(&bye(0, 0, 1));
    assert!(!collector.all_gone());
    collector.offer(&bye(1, 0, 3));
    assert!(collector.all_gone());
    let report = collector.accounting().report();
    assert_eq!((report.sent, report.accepted, report.dropped, report.waiting), (4, 0, 4, 0));
    assert_eq!(report.actors[1].dropped["lost"], 2);
    assert!(report.holds);
}

#[test]
fn a_run_without_the_bad_actor_is_the_same_run() {
    let mut clean =
        Collector::new(CollectorSettings { min_share: 0.4, ..settings(0) }, Accounting::default());
    let mut dirty =
        Collector::new(CollectorSettings { min_share: 0.4, ..settings(0) }, Accounting::default());
    let mut batches = (Vec::new(), Vec::new());
    for version in 0..6 {
        clean.policy_published(version, sha(version));
        dirty.policy_published(version, sha(version));
        offer(&mut clean, chunk(0, version, version));
        let mut bad = chunk(1, version, version);
        bad.observations[0] = f32::INFINITY;
        offer(&mut dirty, bad);
        offer(&mut dirty, chunk(0, version, version));
        batches.0.push(super::super::Batch::new(clean.take()));
        batches.1.push(super::super::Batch::new(dirty.take()));
    }
    assert_eq!(batches.0, batches.1);
    assert_eq!(dirty.accounting().summary().reasons["quarantined"], 3);
}

/// FAULTS.md, 61: 63 of 64 actors have sent. Without a lead all are waited for, with one the batch goes
/// ahead, and the slow actor's chunk is used when it comes.
#[test]
fn fault_61_one_slow_actor_of_sixty_four_holds_up_nobody() {
    for (max_lead, ready) in [(0, false), (1, true)] {
        let many = CollectorSettings { actors: 64, ..settings(max_lead) };
        let mut collector = Collector::new(many, Accounting::default());
        collector.policy_published(0, sha(0));
        for actor in 0..63 {
            assert_eq!(reason(offer(&mut collector, chunk(actor, 0, 0))), "waiting");
        }
        assert_eq!(collector.is_ready(), ready, "max_lead {max_lead}");
    }
    let many = CollectorSettings { actors: 64, ..settings(1) };
    let mut collector = Collector::new(many, Accounting::default());
    for version in 0..10 {
        collector.policy_published(version, sha(version));
        for actor in 0..63 {
            offer(&mut collector, chunk(actor, version, version));
        }
        if version % 4 == 3 {
            // Three versions old, which is within the lag.
            let late = chunk(63, version / 4, version - 3);
            assert_eq!(reason(offer(&mut collector, late)), "waiting");
        }
        assert!(collector.is_ready());
        assert!(collector.take().len() >= 63);
    }
    let report = collector.accounting().report();
    assert_eq!((report.accepted, report.dropped), (63 * 10 + 2, 0));
}

#[test]
fn in_lockstep_every_actor_gives_the_same_share_and_nothing_goes_ahead_of_the_slowest() {
    let lockstep = CollectorSettings { lockstep: true, ..settings(1) };
    let mut collector = Collector::new(lockstep, Accounting::default());
    collector.policy_published(0, sha(0));
    // Actor 0 sends both of its quotas before actor 1 sends its first.
    offer(&mut collector, chunk(0, 0, 0));
    offer(&mut collector, chunk(0, 1, 0));
    assert!(!collector.is_ready());
    offer(&mut collector, chunk(1, 0, 0));
    assert!(collector.is_ready());
    let taken: Vec<_> = collector.take().iter().map(|c| (c.actor_id, c.sequence)).collect();
    assert_eq!(taken, [(0, 0), (1, 0)]);
    assert!(!collector.is_ready());
    offer(&mut collector, chunk(1, 1, 0));
    let taken: Vec<_> = collector.take().iter().map(|c| (c.actor_id, c.sequence)).collect();
    assert_eq!(taken, [(0, 1), (1, 1)]);
    // Lanes are numbered through: there is no place for a third actor.
    assert_eq!(reason(offer(&mut collector, chunk(2, 0, 0))), "actor_number");
}

#[test]
fn nobody_waits_for_the_goodbye_of_an_actor_that_never_came() {
    // Two actors are expected; one comes, and one with a name of its own.
    let mut collector = collector(1);
    let named = 0x8000_0001;
    collector.offer(&hello(0, 0));
    collector.offer(&hello(named, 7));
    assert!(!collector.all_gone());
    collector.offer(&bye(0, 0, 0));
    assert!(!collector.all_gone());
    collector.offer(&bye(named, 7, 0));
    assert!(collector.all_gone());
}
