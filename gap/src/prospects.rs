//! What each trial of the battery would tell about what is still possible, by simulating it before it is
//! recorded.
//!
//! What is possible: that nothing is wrong, or one effect of the catalogue, at one joint or at the robot as a
//! whole. Each effect is put into the robot file's robot in a middling size, everywhere at once; what it
//! changes in a trial, in tolerances of each channel, is its trace there. Joints of a robot hardly move each
//! other, so that the trace of an effect at one joint is that joint's part of it.
//!
//! Nobody knows the size beforehand. So what tells two effects apart is what no size of one makes up for in
//! the trace of the other: D² = |a|²·sin²(a, b), the smaller way round; and |a|² from nothing at all. Traces
//! of several trials are one long trace. With probabilities w of what is possible, trials tell at least
//!
//! −Σᵢ wᵢ·ln Σⱼ wⱼ·exp(−D²ᵢⱼ/8) nats
//!
//! (the bound by Bhattacharyya's distances of Kolchinsky and Tracey, "Estimating mixture entropy with pairwise
//! distances", Entropy 19 (2017) 361). The best trial adds most to it per second of motion. What is recorded
//! already adds little, and what leaves no trace on this robot adds nothing.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;

use crate::effects::{self, Domain, Effect, Layer};
use crate::error::GapError;
use crate::excite::{self, DEFAULT_RATE_HZ};
use crate::go_on::GoOn;
use crate::place::Place;
use crate::replay::{Data, Piece, Replayer, SegmentOptions, Term, Variant};
use crate::trial::{Channel, Kind, Steps, Trial};

/// Root mean square over a trial that is one tolerance, in the channel's unit: what careful repeats, and two
/// engines, differ by.
const ONE_TOLERANCE: [(Kind, f64); 6] = [
    (Kind::Position, 0.003),
    (Kind::Velocity, 0.06),
    (Kind::Current, 0.03),
    (Kind::Gyro, 0.15),
    (Kind::BaseAttitude, 0.02),
    (Kind::BaseVelocity, 0.02),
];
/// Longest trial that is considered, s: longer ones are for what takes as long to build up.
pub(crate) const LONGEST_S: f64 = 60.0;
/// Probability, before anything is recorded, that nothing is wrong.
const NOTHING: f64 = 0.5;
/// What leaves less than so many tolerances in every trial cannot matter.
const MATTERS_FROM: f64 = 2.0;
/// A trial that tells less than this is not worth its time, nats.
const WORTH_NATS: f64 = 0.01;
/// So many effects are named in a reason.
const NAMED: usize = 3;

/// Something that may be wrong with the robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Possible {
    /// What.
    pub effect: &'static Effect,
    /// Actuated joint (policy order) at which it acts; none: the robot as a whole.
    pub joint: Option<usize>,
    /// Number of its effect.
    row: usize,
}

/// Inner products of the traces of all effects: by joint, and of the body last. `[A + 1][E·E]`
type Gram = Vec<Vec<f64>>;

struct Prospect {
    trial: excite::Trial,
    gram: Gram,
}

/// What trials would tell.
pub struct Prospects {
    trials: Vec<Prospect>,
    /// All that may be wrong; that nothing is stands before them.
    possible: Vec<Possible>,
    effects: usize,
}

/// A trial and what it is worth.
#[derive(Debug, Clone)]
pub struct Choice<'a> {
    /// The trial.
    pub trial: &'a excite::Trial,
    /// What it tells beyond what is recorded, nats.
    pub nats: f64,
    /// In words.
    pub why: String,
}

/// Probabilities: that nothing is wrong, then of everything that is possible.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights(Vec<f64>);

impl Weights {
    fn normalised(mut self) -> Self {
        let sum: f64 = self.0.iter().sum();
        self.0.iter_mut().for_each(|w| *w /= sum.max(f64::MIN_POSITIVE));
        self
    }

    /// That nothing is wrong.
    pub fn nothing(&self) -> f64 {
        self.0[0]
    }
}

impl Prospects {
    /// Simulates the trials of the battery for `model` that are `asked` for, each with every effect that is
    /// `wanted`. `sees_base`: whether free runs have the base's motion.
    pub fn of(
        model: &Arc<RobotModel>,
        asked: impl Fn(&excite::Trial) -> bool,
        sees_base: bool,
        wanted: impl Fn(&Effect) -> bool,
        threads: usize,
        go_on: GoOn,
    ) -> Result<Self, GapError> {
        let replayer = Replayer::new(Arc::clone(model), threads)?.with_go_on(go_on);
        let mut terms: Vec<(Term, bool)> = Vec::new();
        for &effect in effects::ALL.iter().filter(|e| wanted(e)) {
            let middle = effect.grid.len() / 2;
            let Some(place) = Place::named(model, effect.domain, &[]) else { continue };
            let somewhere = match effect.domain {
                Domain::Robot => true,
                _ => !place.items.is_empty() && effect.may_be(model, &place),
            };
            if somewhere && middle < effect.grid.len() {
                let values = effect.sizes(model, &place, middle);
                let by_joint = matches!(effect.domain, Domain::Joints | Domain::Links);
                terms.push((Term { effect, place, values }, by_joint));
            }
        }
        let battery = excite::battery(model, None, DEFAULT_RATE_HZ).unwrap_or_default();
        let mut trials = Vec::new();
        for trial in battery {
            if trial.duration_s <= LONGEST_S && asked(&trial) {
                let gram = gram(&replayer, &trial, &terms, sees_base)?;
                trials.push(Prospect { trial, gram });
            }
        }
        let joints = model.actuated().len();
        let mut possible = Vec::new();
        for (row, (term, by_joint)) in terms.iter().enumerate() {
            let at = |joint| Possible { effect: term.effect, joint, row };
            match by_joint {
                true => possible.extend((0..joints).map(|a| at(Some(a)))),
                false => possible.push(at(None)),
            }
        }
        let mut all = Self { trials, possible, effects: terms.len() };
        let least = MATTERS_FROM * MATTERS_FROM;
        let shows = |p: &Possible| {
            let mut trials = all.trials.iter();
            trials.any(|t| all.inner(&t.gram, p, p) >= least)
        };
        let matters = all.possible.iter().copied().filter(shows).collect();
        all.possible = matters;
        Ok(all)
    }

    /// Before anything is recorded, and after `recorded` trials of which none showed anything: what would have
    /// shown is improbable.
    pub fn unseen(&self, recorded: &[&str]) -> Weights {
        let gram = self.sum(|t| recorded.contains(&t.name.as_str()));
        let mut weights = vec![NOTHING];
        for p in &self.possible {
            let alike = self.possible.iter().filter(|q| q.row == p.row).count();
            let prior = (1.0 - NOTHING) / (self.effects * alike) as f64;
            weights.push(prior * (-self.inner(&gram, p, p) / 8.0).exp());
        }
        Weights(weights).normalised()
    }

    /// That one of `ids` (any, where there are none) is wrong at one of `joints` (anywhere, where there are
    /// none) or with the robot as a whole, each alike.
    pub fn among(&self, ids: &[&str], joints: &[usize]) -> Weights {
        let is = |p: &Possible| {
            (ids.is_empty() || ids.contains(&p.effect.id))
                && (joints.is_empty() || p.joint.is_none_or(|a| joints.contains(&a)))
        };
        let mut weights = vec![0.0];
        weights.extend(self.possible.iter().map(|p| f64::from(u8::from(is(p)))));
        Weights(weights).normalised()
    }

    /// The trial that is not recorded, of at most `left_s`, that tells most per second. None where none is
    /// worth its time.
    pub fn best(&self, weights: &Weights, recorded: &[&str], left_s: f64) -> Option<Choice<'_>> {
        let before = self.sum(|t| recorded.contains(&t.name.as_str()));
        let known = self.doubts(&before, weights);
        let mut best: Option<(f64, Choice<'_>)> = None;
        for prospect in &self.trials {
            let trial = &prospect.trial;
            if recorded.contains(&trial.name.as_str()) || trial.duration_s > left_s {
                continue;
            }
            let mut gram = before.clone();
            add(&mut gram, &prospect.gram);
            let then = self.doubts(&gram, weights);
            let gains: Vec<f64> = known.iter().zip(&then).map(|(a, b)| a - b).collect();
            let nats: f64 = gains.iter().sum();
            let pace = nats / trial.duration_s;
            if nats >= WORTH_NATS && best.as_ref().is_none_or(|b| pace > b.0) {
                let why = self.reason(&gains, trial);
                best = Some((pace, Choice { trial, nats, why }));
            }
        }
        best.map(|(_, choice)| choice)
    }

    /// Effects that matter, and that `recorded` trials would not have shown anywhere.
    pub fn dark(&self, recorded: &[&str]) -> Vec<&'static str> {
        let gram = self.sum(|t| recorded.contains(&t.name.as_str()));
        let shows = |p: &&Possible| self.inner(&gram, p, p) >= MATTERS_FROM * MATTERS_FROM;
        let seen: Vec<&str> = (self.possible.iter().filter(shows)).map(|p| p.effect.id).collect();
        let mut dark: Vec<&'static str> = self.possible.iter().map(|p| p.effect.id).collect();
        dark.retain(|id| !seen.contains(id));
        dark.dedup();
        dark
    }

    /// The trial with this name.
    pub fn find(&self, name: &str) -> Option<&excite::Trial> {
        let mut all = self.trials.iter().map(|p| &p.trial);
        all.find(|t| t.name == name)
    }

    fn reason(&self, gains: &[f64], trial: &excite::Trial) -> String {
        let mut by_effect: Vec<(&str, f64)> = Vec::new();
        for (p, gain) in self.possible.iter().zip(&gains[1..]) {
            match by_effect.iter_mut().find(|(id, _)| *id == p.effect.id) {
                Some((_, sum)) => *sum += gain,
                None => by_effect.push((p.effect.id, *gain)),
            }
        }
        by_effect.sort_by(|a, b| b.1.total_cmp(&a.1));
        let named: Vec<&str> = by_effect.iter().take(NAMED).map(|e| e.0).collect();
        format!(
            "{:.2} nats in {:.0} s, most about {}",
            gains.iter().sum::<f64>(),
            trial.duration_s,
            named.join(", ")
        )
    }

    fn sum(&self, of: impl Fn(&excite::Trial) -> bool) -> Gram {
        let groups = self.trials.first().map_or(0, |p| p.gram.len());
        let mut total = vec![vec![0.0; self.effects * self.effects]; groups];
        for p in self.trials.iter().filter(|p| of(&p.trial)) {
            add(&mut total, &p.gram);
        }
        total
    }

    /// Inner product of two traces, in tolerances².
    fn inner(&self, gram: &Gram, a: &Possible, b: &Possible) -> f64 {
        let at = |group: usize| gram[group][a.row * self.effects + b.row];
        match (a.joint, b.joint) {
            (Some(i), Some(j)) if i != j => 0.0,
            (Some(i), _) | (None, Some(i)) => at(i),
            (None, None) => (0..gram.len()).map(at).sum(),
        }
    }

    /// wᵢ·ln Σⱼ wⱼ·exp(−D²ᵢⱼ/8) of nothing and of everything that is possible: how much of each is confused
    /// with the rest, negative.
    fn doubts(&self, gram: &Gram, weights: &Weights) -> Vec<f64> {
        let own: Vec<f64> = (self.possible.iter()).map(|p| self.inner(gram, p, p)).collect();
        let w = &weights.0;
        let mut overlap = vec![0.0; w.len()];
        overlap[0] += w[0];
        for (i, p) in self.possible.iter().enumerate() {
            if w[i + 1] == 0.0 {
                continue;
            }
            overlap[i + 1] += w[i + 1];
            let alike = (-own[i] / 8.0).exp();
            overlap[0] += w[i + 1] * alike;
            overlap[i + 1] += w[0] * alike;
            for (j, q) in self.possible.iter().enumerate().skip(i + 1) {
                if w[j + 1] == 0.0 {
                    continue;
                }
                let both = own[i].max(own[j]).max(f64::MIN_POSITIVE);
                let along = self.inner(gram, p, q).powi(2) / both;
                let apart = (own[i].min(own[j]) - along).max(0.0);
                let alike = (-apart / 8.0).exp();
                overlap[i + 1] += w[j + 1] * alike;
                overlap[j + 1] += w[i + 1] * alike;
            }
        }
        let doubt = |(w, o): (&f64, &f64)| if *w > 0.0 { w * o.ln() } else { 0.0 };
        w.iter().zip(&overlap).map(doubt).collect()
    }
}

fn add(total: &mut Gram, more: &Gram) {
    for (t, m) in total.iter_mut().zip(more) {
        t.iter_mut().zip(m).for_each(|(t, m)| *t += m);
    }
}

/// One tolerance of the channel that `piece` is of, in its unit.
pub(crate) fn tolerance(model: &RobotModel, piece: &Piece) -> Option<f64> {
    let of = ONE_TOLERANCE.iter().find(|t| t.0 == piece.kind);
    let moves = matches!(piece.kind, Kind::Position | Kind::Velocity);
    of.map(|t| if moves { t.1 * model.per_radian(piece.index) } else { t.1 })
}

/// Kinds of channels that a lab records in `trial`.
pub(crate) fn measured(model: &RobotModel, trial: &excite::Trial, sees_base: bool) -> Vec<Kind> {
    let free = trial.base != BaseHold::Fixed;
    let of_base = |kind: Kind| match kind {
        Kind::Gyro => model.sensors().imu.is_some(),
        _ => sees_base,
    };
    let seen = |kind: &Kind| kind.of_joint() || free && of_base(*kind);
    ONE_TOLERANCE.iter().map(|t| t.0).filter(seen).collect()
}

/// Traces of all `terms` in `trial`, multiplied with each other.
fn gram(
    replayer: &Replayer,
    trial: &excite::Trial,
    terms: &[(Term, bool)],
    sees_base: bool,
) -> Result<Gram, GapError> {
    let model = replayer.model();
    let whole = SegmentOptions {
        free_s: f64::INFINITY,
        swimming_s: f64::INFINITY,
        loose_s: f64::INFINITY,
        ..SegmentOptions::default()
    };
    let kinds = measured(model, trial, sees_base);
    let data = Data::new(model, vec![as_run(trial, &kinds)], whole);
    let acts = |effect: &Effect| match effect.layer {
        Layer::Water => trial.base == BaseHold::Water,
        Layer::Contact => trial.base == BaseHold::Free,
        _ => true,
    };
    let acting: Vec<usize> = (0..terms.len()).filter(|&e| acts(terms[e].0.effect)).collect();
    let mut variants: Vec<Variant> = vec![Vec::new()];
    variants.extend(acting.iter().map(|&e| vec![terms[e].0.clone()]));
    let predictions = replayer.predict(&data, &variants)?;
    let (joints, count) = (model.actuated().len(), terms.len());
    let mut gram = vec![vec![0.0; count * count]; joints + 1];
    for piece in data.pieces() {
        let Some(tolerance) = tolerance(model, piece) else { continue };
        let group = if piece.kind.of_joint() { piece.index } else { joints };
        let scale = (1.0 / (tolerance * (piece.range.len().max(1) as f64).sqrt())) as f32;
        let own = &predictions[0][piece.range.clone()];
        let trace = |of: &Vec<f32>| -> Vec<f32> {
            let changed = of[piece.range.clone()].iter().zip(own);
            changed.map(|(a, b)| scale * (a - b)).collect()
        };
        let traces: Vec<Vec<f32>> = predictions[1..].iter().map(trace).collect();
        for (k, a) in traces.iter().enumerate() {
            for (l, b) in traces.iter().enumerate().skip(k) {
                let dot: f32 = a.iter().zip(b).map(|(x, y)| x * y).sum();
                // a candidate that cannot be simulated leaves no trace
                if dot.is_finite() {
                    let (i, j) = (acting[k], acting[l]);
                    gram[group][i * count + j] += f64::from(dot);
                    if i != j {
                        gram[group][j * count + i] += f64::from(dot);
                    }
                }
            }
        }
    }
    Ok(gram)
}

/// A trial of the battery as a run with channels of these kinds, in which every joint is where it was sent and
/// the base is level and at rest.
pub(crate) fn as_run(trial: &excite::Trial, kinds: &[Kind]) -> Trial {
    let time_s: Vec<f64> =
        (0..trial.commands_rad.len()).map(|k| k as f64 / trial.rate_hz).collect();
    let column = |a: usize| trial.commands_rad.iter().map(move |row| row[a]).collect();
    let still = |x: f64| vec![x; time_s.len()];
    let joints = trial.columns.len();
    let mut channels = Vec::new();
    for &kind in kinds {
        let count = match kind {
            Kind::BaseAttitude => 4,
            _ if kind.of_joint() => joints,
            _ => 3,
        };
        channels.extend((0..count).map(|index| Channel {
            kind,
            index,
            name: String::new(),
            time_s: time_s.clone(),
            value: match (kind, index) {
                (Kind::Position, a) => column(a),
                // gravity points along −z of the base
                (Kind::BaseAttitude, 3) => still(-1.0),
                _ => still(0.0),
            },
        }));
    }
    let mut run = Trial::bare(trial.base, trial.duration_s, channels);
    let steps =
        |value: Vec<f64>| Steps { time_s: time_s.clone(), value, frame_s: 1.0 / trial.rate_hz };
    run.commands = (0..joints).map(|a| steps(column(a))).collect();
    run.enabled = (0..joints)
        .map(|a| {
            let on = trial.on.iter().map(|row| f64::from(u8::from(row[a])));
            (!trial.on.is_empty()).then(|| steps(on.collect()))
        })
        .collect();
    run
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pendulum() -> Prospects {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        let model = Arc::new(RobotModel::load(file.as_ref()).unwrap());
        let few = ["kp_error", "command_delay", "measurement_delay", "contact_friction"];
        let wanted = |e: &Effect| few.contains(&e.id);
        Prospects::of(&model, |_| true, true, wanted, 1, GoOn::default()).unwrap()
    }

    #[test]
    fn what_cannot_show_on_a_robot_is_not_asked_for() {
        let prospects = pendulum();
        let ids: Vec<&str> = prospects.possible.iter().map(|p| p.effect.id).collect();
        assert!(ids.contains(&"kp_error") && !ids.contains(&"contact_friction"), "{ids:?}");
    }

    #[test]
    fn trials_tell_until_nothing_is_open_and_none_is_asked_for_twice() {
        let prospects = pendulum();
        let mut recorded: Vec<&str> = Vec::new();
        let mut nothing = vec![prospects.unseen(&recorded).nothing()];
        while let Some(best) = prospects.best(&prospects.unseen(&recorded), &recorded, 60.0) {
            assert!(!recorded.contains(&best.trial.name.as_str()));
            recorded.push(&best.trial.name);
            nothing.push(prospects.unseen(&recorded).nothing());
        }
        assert!(nothing.windows(2).all(|w| w[0] <= w[1]), "{nothing:?}");
        assert!(nothing[nothing.len() - 1] > 0.95, "{nothing:?} {recorded:?}");
        assert!(recorded.len() <= 4, "{recorded:?}");
    }
}
