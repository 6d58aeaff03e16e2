//! Policies that say which they are, and short ways to read.

use std::time::Duration;

use caudata_transport::{ActorLink, Control, LearnerLink, PolicyUpdate};

use super::frames::{Label, Ledger, PATIENCE, recv};

pub fn label(sender: u64, number: u64) -> Label {
    Label { sender, incarnation: 1, number }
}

pub fn policy(version: u64, bytes: usize, control: Control) -> PolicyUpdate {
    let body: Vec<u8> = (0..bytes).map(|i| (i as u64 * 7 + version) as u8).collect();
    PolicyUpdate { version, sha256: [version as u8; 32], bytes: body.into(), control }
}

pub fn next_policy(actor: &mut dyn ActorLink) -> PolicyUpdate {
    actor.next_policy(PATIENCE).unwrap().expect("a policy within the patience of the test")
}

/// Reads until the learner has `total` frames.
pub fn read(learner: &mut dyn LearnerLink, ledger: &mut Ledger, total: u64) {
    while ledger.total() < total {
        ledger.take(&recv(learner));
    }
}

/// Nothing more comes, given a few heartbeats.
pub fn assert_nothing_more(learner: &mut dyn LearnerLink) {
    assert!(learner.recv(Duration::from_millis(100)).unwrap().is_none());
}
