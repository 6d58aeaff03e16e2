//! Which policies the robot holds and trusts: a pure state machine, kept in `state.json`.
//!
//! ```text
//! offered ──▶ fetched and verified ──▶ active ──▶ ran well ──▶ last good
//!     └──────────── refused, or misbehaved ──▶ quarantined (with the reason)
//! ```

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use caudata_declare::settings;
use caudata_proto::checks::Check;
use caudata_proto::hex::{from_hex, hex};
use caudata_proto::registry::Manifest;
use serde::{Deserialize, Serialize};

/// `format` of the state file.
pub const STATE_FORMAT: &str = "caudata.robot_state.v1";
/// Quarantined policies that are remembered; older ones are forgotten.
pub const QUARANTINE_MAX: usize = 64;
/// How far a version may be above the highest one seen: a jump to the end of all numbers would shut every
/// later policy out.
pub const VERSION_JUMP_MAX: u64 = 1_000_000;
/// How often a policy may be begun with before it must have gone through its trial: one that takes the
/// program down with it is not tried for ever.
pub const ATTEMPTS_MAX: u32 = 3;
/// Streams whose highest version is remembered; with more, the ones that nothing on this robot is from are
/// forgotten.
pub const STREAMS_MAX: usize = 256;

/// A SHA-256, written as 64 lower-case hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Sha256Digest(pub [u8; 32]);

impl fmt::Display for Sha256Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&hex(&self.0))
    }
}

impl fmt::Debug for Sha256Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for Sha256Digest {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let lower = |text: &&str| !text.contains(char::is_uppercase);
        let bytes = Some(text).filter(lower).and_then(from_hex);
        let digest = bytes.and_then(|bytes| bytes.try_into().ok());
        digest
            .map(Self)
            .ok_or_else(|| format!("`{text}` is not a SHA-256 of 64 lower-case hexadecimal digits"))
    }
}

impl TryFrom<String> for Sha256Digest {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Sha256Digest> for String {
    fn from(digest: Sha256Digest) -> Self {
        digest.to_string()
    }
}

/// One published policy: where it is from, and which bytes it is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyRef {
    /// Stream on the policy server.
    pub stream: String,
    /// Version in that stream.
    pub version: u64,
    /// SHA-256 of the file.
    pub sha256: Sha256Digest,
    /// The version that the file itself bears, where an older one was published again under a higher number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reverts_to: Option<u64>,
}

impl PolicyRef {
    /// The version that the file must bear.
    pub fn file_version(&self) -> u64 {
        self.reverts_to.unwrap_or(self.version)
    }
}

/// Which policy a manifest announces.
impl From<&Manifest> for PolicyRef {
    fn from(manifest: &Manifest) -> Self {
        Self {
            stream: manifest.stream.to_string(),
            version: manifest.version,
            sha256: Sha256Digest(manifest.sha256),
            reverts_to: manifest.reverts_to,
        }
    }
}

/// A policy that has not yet shown that it walks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trial {
    /// Which bytes.
    pub sha256: Sha256Digest,
    /// How often it was made ready to drive the robot.
    pub attempts: u32,
}

impl fmt::Display for PolicyRef {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} version {}", self.stream, self.version)
    }
}

/// A policy that must not run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Quarantined {
    /// Which one.
    pub policy: PolicyRef,
    /// Why, in one line.
    pub reason: String,
    /// False: the bytes were damaged on their way or wrongly announced, another try may bring the right ones.
    pub for_good: bool,
    /// Hash of the robot model that it does not fit; another robot file may take it. Absent: it is the policy
    /// itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<Sha256Digest>,
}

/// What a refusal is about, and so how far it reaches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blame {
    /// The policy itself: it never runs again, and is trusted no longer where it was.
    Policy,
    /// The way it came: another try may go well.
    Transfer,
    /// It does not fit the robot model with this hash; nothing is wrong with it on its own robot.
    Robot(Sha256Digest),
}

impl Quarantined {
    /// Whether it is refused unseen on the robot model with hash `robot`.
    fn holds_on(&self, robot: Sha256Digest) -> bool {
        self.for_good && self.robot.is_none_or(|found| found == robot)
    }
}

/// What to do about a policy that the server offers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Unknown: fetch and verify it.
    Fetch,
    /// It is the active one.
    HaveIt,
    /// Older than the active one of the same stream: streams only grow.
    Older {
        /// Version that is active.
        have: u64,
    },
    /// Refused before.
    Refused {
        /// Why.
        reason: String,
    },
    /// The state was lost, and no server proved yet what is newest.
    StateLost,
}

/// A policy that the server offers, and what this robot knows.
#[derive(Clone, Copy, Debug)]
pub struct Offer<'a> {
    /// What the robot knows.
    pub state: &'a RobotState,
    /// Whether it lost what it knew.
    pub lost: bool,
    /// The policy.
    pub policy: &'a PolicyRef,
    /// Hash of the robot's model.
    pub robot: Sha256Digest,
}

/// Looks at an offer; the error is what to do instead of taking it.
pub type OfferCheck = fn(&Offer<'_>) -> Result<(), Decision>;

/// What keeps an offered policy from being fetched.
pub const OFFER: &[Check<OfferCheck>] = &[
    // A robot whose state is lost takes nothing before a server proved what is newest.
    Check::new("lost state", |offer| if offer.lost { Err(Decision::StateLost) } else { Ok(()) }),
    // It was not refused before.
    Check::new("quarantine", |offer| {
        let of_it =
            |e: &&Quarantined| e.policy.sha256 == offer.policy.sha256 && e.holds_on(offer.robot);
        match offer.state.quarantined.iter().find(of_it) {
            Some(entry) => Err(Decision::Refused { reason: entry.reason.clone() }),
            None => Ok(()),
        }
    }),
    // It is not older than what this robot has.
    Check::new("older", |offer| match offer.active_version() {
        Some(have) if have > offer.policy.version => Err(Decision::Older { have }),
        _ => Ok(()),
    }),
    // It is not older than anything this robot has seen.
    Check::new("seen", |offer| match offer.seen_version() {
        Some(have) if have > offer.policy.version && !offer.state.needs(offer.policy.sha256) => {
            Err(Decision::Older { have })
        }
        _ => Ok(()),
    }),
    // Its version does not shut out all later ones.
    Check::new("jump", |offer| {
        let known = offer.seen_version().max(offer.active_version());
        match offer.policy.version.saturating_sub(known.unwrap_or(0)) > VERSION_JUMP_MAX {
            true => Err(Decision::Refused {
                reason: format!("its version is more than {VERSION_JUMP_MAX} above any seen"),
            }),
            false => Ok(()),
        }
    }),
];

impl Offer<'_> {
    fn active_version(&self) -> Option<u64> {
        let active = self.state.active.as_ref();
        let same = active.filter(|active| active.stream == self.policy.stream);
        same.map(|active| active.version)
    }

    fn seen_version(&self) -> Option<u64> {
        self.state.seen.get(&self.policy.stream).copied()
    }

    /// What to do about it, by these checks.
    pub fn decide(&self, checks: &[Check<OfferCheck>]) -> Decision {
        match checks.iter().try_for_each(|check| (check.refuse)(self)) {
            Err(decision) => decision,
            Ok(()) if self.state.active.as_ref() == Some(self.policy) => Decision::HaveIt,
            Ok(()) => Decision::Fetch,
        }
    }
}

/// Looks at how often a policy on trial was begun with.
pub type TrialCheck = fn(u32) -> bool;

/// What keeps a policy from being begun with once more.
pub const TRIAL: &[Check<TrialCheck>] =
    &[Check { name: "attempts", refuse: |attempts| attempts >= ATTEMPTS_MAX }];

/// Looks at the highest version of a trust file that was in force, and at the one that is to be.
pub type TrustCheck = fn(u64, u64) -> bool;

/// What keeps a trust file from being in force.
pub const TRUST: &[Check<TrustCheck>] =
    &[Check { name: "trust version", refuse: |seen, version| version < seen }];

settings! {
    /// What the robot knows about policies; `state.json`.
    #[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct RobotState {
        /// [`STATE_FORMAT`].
        pub format: String = STATE_FORMAT.to_owned(),
        /// Grows with every change.
        pub generation: u64 = 0,
        /// Verified, and the one to run.
        pub active: Option<PolicyRef>,
        /// Ran well; what is run when the active one turns out bad.
        pub last_good: Option<PolicyRef>,
        /// Refused, oldest first.
        pub quarantined: Vec<Quarantined>,
        /// Highest version of each stream that was taken or found bad: nothing older is taken any more, also
        /// where the robot went back.
        #[serde(default)]
        pub seen: BTreeMap<String, u64>,
        /// The policy on trial, if there is one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub trial: Option<Trial>,
        /// Highest version of a trust file that was in force here; 0 where none above version 1 was, see
        /// [`RobotState::saw_trust`]. A lower one would bring back keys that were given up.
        #[serde(default, skip_serializing_if = "is_zero")]
        pub trust_version: u64 = 0,
    }
}

fn is_zero(number: &u64) -> bool {
    *number == 0
}

impl RobotState {
    fn saw(&mut self, policy: &PolicyRef) {
        if self.seen.len() >= STREAMS_MAX && !self.seen.contains_key(&policy.stream) {
            let held: Vec<String> = self.on_disk().into_iter().map(|p| p.stream).collect();
            self.seen.retain(|stream, _| held.contains(stream));
        }
        let seen = self.seen.entry(policy.stream.clone()).or_default();
        *seen = policy.version.max(*seen);
    }

    /// `policy` passed every check: it is the one to run from now on.
    pub fn adopt(&mut self, policy: PolicyRef) {
        self.quarantined.retain(|e| e.policy.sha256 != policy.sha256);
        self.saw(&policy);
        self.active = Some(policy);
        self.generation += 1;
    }

    /// Counts that the policy with these bytes is made ready to drive the robot; one that ran well before
    /// needs no counting. Answers how often that was, with this time.
    pub fn begin(&mut self, sha256: Sha256Digest) -> u32 {
        if self.is_proved(sha256) {
            return 0;
        }
        let before = self.attempts(sha256);
        let attempts = before + 1;
        self.trial = Some(Trial { sha256, attempts });
        self.generation += 1;
        attempts
    }

    /// How often the policy with these bytes was made ready to drive the robot and had not yet gone through
    /// its trial.
    pub fn attempts(&self, sha256: Sha256Digest) -> u32 {
        let same = self.trial.as_ref().filter(|trial| trial.sha256 == sha256);
        same.map_or(0, |trial| trial.attempts)
    }

    /// Whether the policy with these bytes was begun with too often.
    pub fn is_worn_out(&self, sha256: Sha256Digest) -> bool {
        let attempts = self.attempts(sha256);
        TRIAL.iter().any(|check| (check.refuse)(attempts))
    }

    /// A run with the policy ended in order before its trial was over: that says nothing against it.
    pub fn end_in_order(&mut self, sha256: Sha256Digest) {
        if self.trial.take_if(|trial| trial.sha256 == sha256).is_some() {
            self.generation += 1;
        }
    }

    /// Whether the policy with these bytes ran well here.
    pub fn is_proved(&self, sha256: Sha256Digest) -> bool {
        self.last_good.as_ref().is_some_and(|p| p.sha256 == sha256)
    }

    /// Whether a trust file of this version may be in force: not where a newer one was.
    pub fn takes_trust(&self, version: u64) -> bool {
        !TRUST.iter().any(|check| (check.refuse)(self.trust_version, version))
    }

    /// The trust file of this version is in force. Version 1 is not written down: there is none below it, and
    /// programs that do not know `trust_version` take no state that has one.
    pub fn saw_trust(&mut self, version: u64) {
        if version > self.trust_version.max(1) {
            self.trust_version = version;
            self.generation += 1;
        }
    }

    /// Begins anew after everything was forgotten: nothing below `floor` is taken from `stream`, and no trust
    /// file below `trust_version`.
    pub fn recovered(stream: &str, floor: u64, trust_version: u64) -> Self {
        let mut state = Self {
            seen: BTreeMap::from([(stream.to_owned(), floor)]),
            generation: 1,
            ..Self::default()
        };
        state.saw_trust(trust_version);
        state
    }

    /// The policy with these bytes ran well.
    pub fn confirm(&mut self, sha256: Sha256Digest) {
        self.trial.take_if(|trial| trial.sha256 == sha256);
        if let Some(active) = self.active.clone().filter(|a| a.sha256 == sha256) {
            self.last_good = Some(active);
            self.generation += 1;
        }
    }

    /// `policy` must not run. Where it is to blame itself and was active, the last good one is active again;
    /// a robot file that does not fit it takes nothing away from what its own robot holds.
    pub fn quarantine(&mut self, policy: PolicyRef, reason: String, blame: Blame) {
        let sha256 = policy.sha256;
        if blame == Blame::Policy {
            self.saw(&policy);
        }
        let robot = match blame {
            Blame::Robot(robot) => Some(robot),
            Blame::Policy | Blame::Transfer => None,
        };
        self.quarantined
            .retain(|e| e.policy.sha256 != sha256 || (blame != Blame::Policy && e.robot != robot));
        if self.quarantined.len() >= QUARANTINE_MAX {
            self.quarantined.remove(0);
        }
        self.quarantined.push(Quarantined {
            policy,
            reason,
            for_good: blame != Blame::Transfer,
            robot,
        });
        self.generation += 1;
        if blame != Blame::Policy {
            return;
        }
        self.last_good.take_if(|p| p.sha256 == sha256);
        self.trial.take_if(|trial| trial.sha256 == sha256);
        if self.active.as_ref().is_some_and(|p| p.sha256 == sha256) {
            self.active = self.last_good.clone();
        }
    }

    /// What may be run without a server, best first.
    pub fn on_disk(&self) -> Vec<PolicyRef> {
        let mut all: Vec<PolicyRef> = self.active.iter().chain(&self.last_good).cloned().collect();
        all.dedup();
        all
    }

    /// Whether the file with these bytes is still needed.
    pub fn needs(&self, sha256: Sha256Digest) -> bool {
        self.on_disk().iter().any(|p| p.sha256 == sha256)
    }
}

#[cfg(test)]
mod tests {
    use caudata_proto::checks::each_left_out;

    use super::*;

    fn policy(version: u64) -> PolicyRef {
        PolicyRef {
            stream: "flat".to_owned(),
            version,
            sha256: Sha256Digest([version as u8; 32]),
            reverts_to: None,
        }
    }

    const HERE: Sha256Digest = Sha256Digest([7; 32]);

    /// Version 1 ran well, version 2 is active.
    fn state() -> RobotState {
        let mut state = RobotState::default();
        state.adopt(policy(1));
        state.confirm(policy(1).sha256);
        state.adopt(policy(2));
        state
    }

    #[test]
    fn each_step_and_no_other_keeps_a_bad_offer_out() {
        let mut state = RobotState::default();
        state.adopt(policy(1));
        state.adopt(policy(3));
        state.quarantine(policy(3), "falls".to_owned(), Blame::Policy);
        // Of a state written before versions were remembered by stream.
        let mut unseen = RobotState::default();
        unseen.adopt(policy(3));
        unseen.seen.clear();
        let offers = each_left_out(OFFER, |name, checks| {
            let offer = |state, policy: &PolicyRef| {
                let lost = name == "lost state";
                let robot = HERE;
                let offer = Offer { state, lost, policy, robot };
                match offer.decide(checks) {
                    Decision::Fetch | Decision::HaveIt => Ok(()),
                    other => Err(other),
                }
            };
            match name {
                "lost state" => offer(&RobotState::default(), &policy(1)),
                "quarantine" => offer(&state, &policy(3)),
                "older" => offer(&unseen, &policy(2)),
                "seen" => offer(&state, &policy(2)),
                "jump" => offer(&state, &policy(u64::MAX)),
                other => panic!("no attempt at {other}"),
            }
        });
        let refused = |refused| if refused { Err("refused") } else { Ok(()) };
        let trials = each_left_out(TRIAL, |_, checks| {
            refused(checks.iter().any(|c| (c.refuse)(ATTEMPTS_MAX)))
        });
        let trust =
            each_left_out(TRUST, |_, checks| refused(checks.iter().any(|c| (c.refuse)(2, 1))));
        // Seen with --nocapture: `make mutants`.
        for table in [offers, trials, trust] {
            eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
        }
    }

    fn decide(state: &RobotState, policy: &PolicyRef, robot: Sha256Digest) -> Decision {
        let offer = Offer { state, lost: false, policy, robot };
        offer.decide(OFFER)
    }

    #[test]
    fn new_ones_are_fetched_old_and_known_ones_are_not() {
        let state = state();
        assert_eq!(decide(&state, &policy(3), HERE), Decision::Fetch);
        assert_eq!(decide(&state, &policy(2), HERE), Decision::HaveIt);
        assert_eq!(decide(&state, &policy(1), HERE), Decision::Older { have: 2 });
        let mut elsewhere = policy(1);
        elsewhere.stream = "rough".to_owned();
        assert_eq!(decide(&state, &elsewhere, HERE), Decision::Fetch);
        assert_eq!(decide(&RobotState::default(), &policy(1), HERE), Decision::Fetch);
    }

    #[test]
    fn a_policy_is_trusted_once_it_ran_well() {
        let mut state = state();
        assert_eq!(state.last_good, Some(policy(1)));
        state.confirm(policy(9).sha256);
        assert_eq!(state.last_good, Some(policy(1)), "something else ran");
        state.confirm(policy(2).sha256);
        assert_eq!(state.last_good, Some(policy(2)));
        assert_eq!(state.on_disk(), [policy(2)]);
    }

    #[test]
    fn a_bad_one_gives_way_to_the_last_good_one_and_stays_out() {
        let mut state = state();
        state.quarantine(policy(2), "joint 3 differs".to_owned(), Blame::Policy);
        assert_eq!(state.active, Some(policy(1)));
        assert_eq!(
            decide(&state, &policy(2), HERE),
            Decision::Refused { reason: "joint 3 differs".to_owned() }
        );
        // Even the good one can turn out bad: then there is nothing.
        state.quarantine(policy(1), "not finite".to_owned(), Blame::Policy);
        assert_eq!(state.on_disk(), []);
    }

    #[test]
    fn a_wrong_robot_file_takes_nothing_away_from_the_right_one() {
        let mut state = state();
        state.confirm(policy(2).sha256);
        let wrong = Sha256Digest([8; 32]);
        state.quarantine(policy(2), "other model".to_owned(), Blame::Robot(wrong));
        assert_eq!((&state.active, &state.last_good), (&Some(policy(2)), &Some(policy(2))));
        assert!(matches!(decide(&state, &policy(2), wrong), Decision::Refused { .. }));
        assert_eq!(decide(&state, &policy(2), HERE), Decision::HaveIt);
        // Each robot model has an entry of its own; the policy's own fault replaces them all.
        state.quarantine(policy(2), "other model".to_owned(), Blame::Robot(HERE));
        assert_eq!(state.quarantined.len(), 2);
        state.quarantine(policy(2), "not finite".to_owned(), Blame::Policy);
        assert_eq!((state.quarantined.len(), state.active.clone()), (1, None));
        // A file of before knows no robots.
        let text = serde_json::to_string(&state).unwrap();
        assert!(!text.contains("robot\":"), "{text}");
        assert_eq!(serde_json::from_str::<RobotState>(&text).unwrap(), state);
    }

    #[test]
    fn an_offer_that_is_refused_leaves_the_active_one_alone() {
        let mut state = state();
        state.quarantine(policy(3), "wrong robot".to_owned(), Blame::Policy);
        assert_eq!(state.on_disk(), [policy(2), policy(1)]);
    }

    #[test]
    fn bytes_damaged_on_the_way_may_come_again() {
        let mut state = state();
        state.quarantine(policy(3), "other bytes".to_owned(), Blame::Transfer);
        assert_eq!(decide(&state, &policy(3), HERE), Decision::Fetch);
        state.adopt(policy(3));
        assert!(state.quarantined.is_empty());
    }

    #[test]
    fn the_quarantine_is_bounded_and_forgets_the_oldest() {
        let mut state = RobotState::default();
        for version in 0..100 {
            state.quarantine(policy(version), String::new(), Blame::Policy);
        }
        assert_eq!(state.quarantined.len(), QUARANTINE_MAX);
        assert_eq!(state.quarantined[0].policy, policy(36));
    }

    #[test]
    fn digests_read_back_and_paths_are_not_digests() {
        let text = "00ff".repeat(16);
        assert_eq!(text.parse::<Sha256Digest>().unwrap().to_string(), text);
        for bad in ["", "../state", &"0".repeat(63), &"G".repeat(64), &"0F".repeat(32)] {
            assert!(bad.parse::<Sha256Digest>().is_err(), "{bad}");
        }
    }

    #[test]
    fn fault_14_an_older_version_stays_refused_after_going_back() {
        let mut state = state();
        // Version 2 turns out bad: back to 1. Neither 1 under other bytes nor anything below 2 is taken
        // again.
        state.quarantine(policy(2), "falls".into(), Blame::Policy);
        assert_eq!(state.active, Some(policy(1)));
        let older = PolicyRef { sha256: Sha256Digest([9; 32]), ..policy(1) };
        assert_eq!(decide(&state, &older, HERE), Decision::Older { have: 2 });
        assert_eq!(decide(&state, &policy(1), HERE), Decision::HaveIt);
        assert_eq!(decide(&state, &policy(3), HERE), Decision::Fetch);
    }

    #[test]
    fn fault_19_a_version_at_the_end_of_all_numbers_is_refused() {
        let last = PolicyRef { version: u64::MAX, ..policy(3) };
        assert!(matches!(decide(&state(), &last, HERE), Decision::Refused { .. }));
        let far = PolicyRef { version: 2 + VERSION_JUMP_MAX, ..policy(3) };
        assert_eq!(decide(&state(), &far, HERE), Decision::Fetch);
    }

    #[test]
    fn fault_33_attempts_are_counted_until_the_trial_is_over() {
        let mut state = state();
        assert_eq!(state.begin(policy(1).sha256), 0, "it ran well before");
        assert_eq!([1, 2, 3].map(|_| state.begin(policy(2).sha256)), [1, 2, 3]);
        let text = serde_json::to_string(&state).unwrap();
        let mut after: RobotState = serde_json::from_str(&text).unwrap();
        assert_eq!(after.attempts(policy(2).sha256), 3);
        let mut calm = after.clone();
        calm.end_in_order(policy(2).sha256);
        assert_eq!(calm.attempts(policy(2).sha256), 0);
        after.confirm(policy(2).sha256);
        assert_eq!((after.attempts(policy(2).sha256), after.trial.clone()), (0, None));
        // Another one begins from nothing.
        state.adopt(policy(3));
        assert_eq!(state.begin(policy(3).sha256), 1);
    }
}
