//! Which cases make up a set. Sets are drawn by seed; nobody diagnosing knows it.

use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::BaseHold;
use clap::ValueEnum;
use serde::Serialize;

use crate::battery::Amount;
use crate::case::Block;
use crate::decoy::Decoy;
use crate::hidden::{CATALOGUE, Hidden, OUTSIDE, Scope, find};
use crate::salamander::Hides;
use crate::truth::free::Channels;

/// A case to be made.
#[derive(Clone)]
pub struct Plan {
    /// Block.
    pub block: Block,
    /// `pendulum` or `arm`.
    pub rig: &'static str,
    /// Seed of its nuisances.
    pub seed: u64,
    /// Length.
    pub amount: Amount,
    /// Effect, joint, d.
    pub effects: Vec<(&'static Hidden, usize, f64)>,
    /// Decoy.
    pub decoy: Option<Decoy>,
    /// Left out of the catalogue.
    pub without: Vec<String>,
    /// The salamander instead of a bench rig.
    pub salamander: Option<(BaseHold, Hides, Channels)>,
    /// Whether the robot also follows, faintly, laws that no catalogue has.
    pub other_laws: bool,
}

impl Plan {
    /// One in which nothing is hidden.
    pub fn new(block: Block, rig: &'static str, seed: u64, amount: Amount) -> Self {
        Self {
            block,
            rig,
            seed,
            amount,
            effects: Vec::new(),
            decoy: None,
            without: Vec::new(),
            salamander: None,
            other_laws: false,
        }
    }
}

/// The sets of cases.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SetName {
    /// A dozen short cases
    Quick,
    /// About 150: every effect once at d = 4, half of them at another size, and some of all other blocks
    Pr,
    /// About 1,200
    Nightly,
}

struct Counts {
    nulls: usize,
    pairs: usize,
    decoys: usize,
    outside: usize,
    left_out: usize,
    starved: usize,
    changes: usize,
    ground: usize,
    water: usize,
}

impl Counts {
    /// Those of a set, and how long its runs are.
    fn of(set: SetName) -> (Self, Amount) {
        let (counts, amount) = match set {
            SetName::Quick => ([3, 1, 2, 1, 0, 0, 0, 0, 0], Amount::Short),
            SetName::Pr => ([20, 20, 16, 12, 4, 8, 4, 4, 7], Amount::Full),
            SetName::Nightly => ([200, 120, 96, 60, 60, 48, 24, 60, 28], Amount::Full),
        };
        let [nulls, pairs, decoys, outside, left_out, starved, changes, ground, water] = counts;
        let counts =
            Self { nulls, pairs, decoys, outside, left_out, starved, changes, ground, water };
        (counts, amount)
    }
}

/// Pairs that look alike in poor data (GAP.md 2.7).
const LOOK_ALIKE: &[(&str, &str)] = &[
    ("command_low_pass", "command_delay"),
    ("kd_error", "kp_error"),
    ("armature", "link_com"),
    ("link_mass", "link_com"),
    ("encoder_gain", "viscous_friction"),
    ("winding_resistance", "load_dependent_friction"),
    ("load_dependent_friction", "viscous_friction"),
    ("coulomb_friction", "controller_dead_band"),
];

/// Effects that another one holds as a special case: who is left out takes the wider one along.
/// (`stale_gains` and `kp_error` together are any two gains: a `kd_error` that was left out would still be
/// explained exactly. `link_com` goes with an inertia because a mass and its centre together are any inertia
/// with the same moment of gravity.)
const WIDER: &[(&str, &str)] = &[
    ("kd_error", "stale_gains"),
    ("load_dependent_friction", "drive_asymmetry"),
    ("coulomb_friction", "friction_drift"),
    ("link_inertia", "link_com"),
    // a lag that is short against the motion is an inertia less
    ("damping_lag", "armature"),
];

/// The same on a rig with one joint. Of a hanging link two numbers show, its moment of gravity and its
/// inertia about the hinge: any two of its mass, its centre and an inertia are the third one, and a weight on it,
/// whose mass and lever are free, is any of them, or is beside another.
const WIDER_OF_ONE: &[(&str, &str)] = &[
    ("armature", "link_com"),
    ("link_mass", "link_com"),
    ("link_com", "link_mass"),
    ("armature", "point_mass"),
    ("link_inertia", "point_mass"),
    ("link_mass", "point_mass"),
    ("link_com", "point_mass"),
];

/// Effects whose starved data leave them among look-alikes.
const STARVABLE: &[&str] = &[
    "command_low_pass",
    "command_delay",
    "kd_error",
    "armature",
    "viscous_friction",
    "link_mass",
    "kp_error",
    "link_com",
];

/// Decoys, in the order in which small sets take them.
const DECOYS: [Decoy; 8] = Decoy::ALL;

/// The plans of a set drawn by `seed`, in an order that tells nothing. `most` cuts it short.
pub fn plan(set: SetName, seed: u64, most: Option<usize>) -> Vec<Plan> {
    let mut s = Stream::new(Key::for_run(seed), Purpose::Command);
    let (counts, amount) = Counts::of(set);
    let mut plans = singles(set, amount, &mut s);
    let case = |block, rig, s: &mut Stream| Plan::new(block, rig, s.next_u64(), amount);
    let rig = |i: usize| {
        if set == SetName::Quick || i % 3 != 2 { "pendulum" } else { "arm" }
    };
    for i in 0..counts.nulls {
        plans.push(case(Block::Null, rig(i), &mut s));
    }
    for i in 0..counts.decoys {
        let mut p = case(Block::Decoy, rig(i), &mut s);
        p.decoy = Some(DECOYS[i % DECOYS.len()]);
        plans.push(p);
    }
    for i in 0..counts.outside {
        let mut p = case(Block::Outside, rig(i), &mut s);
        let d = [4.0, 8.0][i / OUTSIDE.len() % 2];
        p.effects = vec![(&OUTSIDE[i % OUTSIDE.len()], joint(p.rig, &mut s), d)];
        plans.push(p);
    }
    for i in 0..counts.left_out {
        let mut p = case(Block::Outside, rig(i), &mut s);
        let h = any(&mut s, &|h| h.scope == Scope::Joint && h.layer != "sensing");
        p.effects = vec![(h, joint(p.rig, &mut s), 4.0)];
        p.without = left_out_with(h, p.rig);
        plans.push(p);
    }
    for i in 0..counts.pairs {
        let mut p = case(Block::Pair, rig(i), &mut s);
        p.effects = pair(i, p.rig, &mut s);
        plans.push(p);
    }
    for i in 0..counts.starved {
        let mut p = case(Block::Starved, rig(i), &mut s);
        if let Some(h) = find(STARVABLE[i % STARVABLE.len()]) {
            p.effects = vec![(h, joint(p.rig, &mut s), 4.0)];
            plans.push(p);
        }
    }
    for i in 0..counts.changes {
        let mut p = case(Block::HoldoutChange, rig(i), &mut s);
        p.effects = vec![(
            any(&mut s, &|h| h.scope == Scope::Joint && h.layer != "sensing"),
            joint(p.rig, &mut s),
            8.0,
        )];
        plans.push(p);
    }
    for i in 0..counts.ground {
        let mut p = case(Block::Ground, "polymander", &mut s);
        p.salamander = Some(on_ground(i, &mut s));
        plans.push(p);
    }
    for i in 0..counts.water {
        let mut p = case(Block::Water, "polymander", &mut s);
        p.salamander = Some(in_water(i, &mut s));
        plans.push(p);
    }
    s.shuffle(&mut plans);
    if let Some(most) = most {
        plans.truncate(most);
    }
    plans
}

/// What the diagnosis has to do without where `h` is left out of its catalogue: it, and whatever says the
/// same or more.
pub(crate) fn left_out_with(h: &Hidden, rig: &str) -> Vec<String> {
    let of_one: &[(&str, &str)] = if rig == "pendulum" { WIDER_OF_ONE } else { &[] };
    let wider = WIDER.iter().chain(of_one).filter(|(id, _)| *id == h.id);
    let same = h.equivalent.0.iter().chain(h.equivalent.1).copied();
    let all = std::iter::once(h.id).chain(same).chain(wider.map(|(_, wider)| *wider));
    all.map(str::to_owned).collect()
}

/// Two effects of d = 4: three in ten pairs look alike, six in ten are at one joint.
pub(crate) fn pair(i: usize, rig: &str, s: &mut Stream) -> Vec<(&'static Hidden, usize, f64)> {
    let first_joint = joint(rig, s);
    let (a, b) = match i % 10 {
        0..3 => LOOK_ALIKE[below(s, LOOK_ALIKE.len())],
        _ => {
            let a = any(s, &|h| h.scope == Scope::Joint);
            let apart = |h: &Hidden| {
                h.scope != Scope::Chain && h.id != a.id && !h.equivalent.0.contains(&a.id)
            };
            (a.id, any(s, &apart).id)
        }
    };
    let second_joint = match i % 10 < 6 {
        true => first_joint,
        false => joint(rig, s),
    };
    let both = [(find(a), first_joint), (find(b), second_joint)].into_iter();
    both.filter_map(|(h, j)| Some((h?, j, 4.0))).collect()
}

fn singles(set: SetName, amount: Amount, s: &mut Stream) -> Vec<Plan> {
    let one = |h: &'static Hidden, rig: &'static str, j: usize, d: f64, s: &mut Stream| Plan {
        effects: vec![(h, j, d)],
        ..Plan::new(Block::Single, rig, s.next_u64(), amount)
    };
    let mut plans = Vec::new();
    match set {
        SetName::Quick => {
            // effects of every layer, large enough that missing one is a defect
            for id in ["command_delay", "kp_error", "coulomb_friction", "velocity_lag", "armature"]
            {
                if let Some(h) = find(id) {
                    plans.push(one(h, "pendulum", 0, 8.0, s));
                }
            }
        }
        SetName::Pr => {
            for (i, h) in CATALOGUE.iter().enumerate() {
                let rig = if h.scope == Scope::Chain || i % 3 == 2 { "arm" } else { "pendulum" };
                plans.push(one(h, rig, joint(rig, s), 4.0, s));
                if i % 2 == 0 && h.scope != Scope::Chain {
                    plans.push(one(h, "pendulum", 0, [1.0, 2.0, 8.0][i / 2 % 3], s));
                }
            }
        }
        SetName::Nightly => {
            for h in CATALOGUE {
                for d in super::score::summary::LADDER {
                    for (rig, j) in [("pendulum", 0), ("arm", 0), ("arm", 1)] {
                        let one_is_enough = h.scope != Scope::Joint && j == 1;
                        if one_is_enough || (h.scope == Scope::Chain && rig == "pendulum") {
                            continue;
                        }
                        plans.push(one(h, rig, j, d, s));
                    }
                }
            }
        }
    }
    plans
}

/// Cases on the ground in turn: play at each hinge, the paper's robot, slippery feet, a payload, a slope,
/// nothing.
fn on_ground(i: usize, s: &mut Stream) -> (BaseHold, Hides, Channels) {
    let half_width_deg = between(s, 2.0, 5.0);
    let paper = Hides::Paper {
        half_width_deg: 4.0,
        low_pass_s: between(s, 0.02, 0.05),
        torque: between(s, 0.6, 0.8),
    };
    let play = |hinge| Hides::Play { hinge, half_width_deg };
    let without_mocap = Channels { mocap: false, ..Channels::ALL };
    let (hidden, channels) = match i % 10 {
        hinge @ 0..4 => (play(hinge), Channels::ALL),
        4 => (paper, Channels::ALL),
        5 => (paper, without_mocap),
        6 => (Hides::Friction(between(s, 0.4, 0.7)), Channels::ALL),
        7 => (Hides::Payload(between(s, 0.2, 0.5)), Channels::ALL),
        8 => (Hides::Slope(between(s, 2.0, 6.0)), Channels::ALL),
        _ => (Hides::Nothing, Channels::ALL),
    };
    (BaseHold::Free, hidden, channels)
}

/// Cases in water in turn (a current below 0.1 m/s is within what is allowed of a pool that stirs): drag,
/// buoyancy, added mass, a current, heave damping, the centre of buoyancy, nothing.
fn in_water(i: usize, s: &mut Stream) -> (BaseHold, Hides, Channels) {
    let hidden = match i % 7 {
        0 => Hides::Drag(between(s, 1.4, 2.0)),
        1 => Hides::Buoyancy(between(s, 1.08, 1.2)),
        2 => Hides::AddedMass(between(s, 0.5, 1.0)),
        3 => Hides::Current(between(s, 0.1, 0.2)),
        4 => Hides::Heave(between(s, 1.0, 3.0)),
        5 => Hides::BuoyancyCentre(between(s, 0.005, 0.015)),
        _ => Hides::Nothing,
    };
    (BaseHold::Water, hidden, Channels::ALL)
}

/// A draw, in one place: inlined at every call, draws are most of what plans take in a program.
#[inline(never)]
pub(crate) fn below(s: &mut Stream, n: usize) -> usize {
    s.below(n as u64) as usize
}

/// The same of a number.
#[inline(never)]
pub(crate) fn between(s: &mut Stream, low: f64, high: f64) -> f64 {
    s.uniform_f64(low, high)
}

pub(crate) fn joint(rig: &str, s: &mut Stream) -> usize {
    if rig == "arm" { below(s, 2) } else { 0 }
}

pub(crate) fn any(s: &mut Stream, fits: &dyn Fn(&Hidden) -> bool) -> &'static Hidden {
    let all: Vec<&'static Hidden> = CATALOGUE.iter().filter(|h| fits(h)).collect();
    all[below(s, all.len())]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn same_seed_same_set_and_blocks_are_all_there() {
        let ids = |p: &[Plan]| p.iter().map(|p| (p.block, p.seed)).collect::<Vec<_>>();
        assert_eq!(ids(&plan(SetName::Pr, 1, None)), ids(&plan(SetName::Pr, 1, None)));
        assert_ne!(ids(&plan(SetName::Pr, 1, None)), ids(&plan(SetName::Pr, 2, None)));
        let nightly = plan(SetName::Nightly, 1, None);
        for block in [
            Block::Null,
            Block::Single,
            Block::Pair,
            Block::Decoy,
            Block::Outside,
            Block::Starved,
            Block::HoldoutChange,
            Block::Ground,
            Block::Water,
        ] {
            assert!(nightly.iter().any(|p| p.block == block), "{block:?}");
        }
        assert_eq!(nightly.iter().filter(|p| p.block == Block::Null).count(), 200);
        assert_eq!(plan(SetName::Quick, 1, Some(4)).len(), 4);
    }
}
