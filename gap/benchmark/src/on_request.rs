//! Robots that are recorded trial by trial, as a diagnosis asks for them: one effect of the catalogue is
//! hidden in each, or nothing.
//!
//! What is hidden acts on physics alone, since the Rapier engine and its sensors are the truth. Its size is any
//! of the catalogue's sizes for it, times 0.85 to 1.15, that is at least as large as asked for in detectability
//! units (d): the whitened norm of what it changes in reference trials over that of what the nominal simulation
//! gets wrong there anyway, both on the channels that it acts on.

use std::path::Path;
use std::sync::Arc;

use caudata_gap::effects::{self, Effect};
use caudata_gap::place::{Domain, Place};
use caudata_gap::plant::Plant;
use caudata_gap::replay::{Data, Replayer, SegmentOptions, Term, Variant};
use caudata_gap::{Role, Run, excite, reading};
use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::RunLog;
use caudata_sim::LaneParams;

use crate::battery::RATE_HZ;
use crate::case::{Answer, Block, TrueEffect, TrueValue};
use crate::generate::GenerateError;
use crate::hidden;
use crate::simulated::{self, Robot};

/// Trials in which sizes are measured: frequencies, steps, walking, rocking.
const REFERENCE: [&str; 4] = ["chirp_medium", "steps_medium", "gait", "rock_y"];
/// So often an effect is drawn for a case before the case is left out.
const DRAWS: usize = 40;
/// Factors on a size of the catalogue, so that no truth is one of its values.
const FACTORS: (f64, f64) = (0.85, 1.15);

/// What the nominal simulation of a robot gets wrong in the reference trials.
pub struct Null {
    replayer: Replayer,
    data: Data,
    nominal: Vec<f32>,
    /// By what repeats differ by. `[N]`
    sigma: Vec<f64>,
}

/// A robot with something hidden.
#[derive(Clone, Debug)]
pub struct Unknown {
    /// Its physics.
    pub lane: LaneParams,
    /// What is hidden.
    pub answer: Answer,
}

impl Null {
    /// Records a healthy `model` twice in each reference trial, in folders of `folder`.
    pub fn record(
        model: &Arc<RobotModel>,
        seed: u64,
        folder: &Path,
    ) -> Result<Self, GenerateError> {
        let lane = LaneParams::nominal(model);
        let robot = Robot { lab: model, model, lane: &lane, seed, payload: &[] };
        let mut repeats = [Vec::new(), Vec::new()];
        let known = excite::names(model, None);
        for (number, name) in (0..).zip(REFERENCE.iter().filter(|n| known.contains(n))) {
            let trial = excite::trial(model, name, None, RATE_HZ)?;
            for (repeat, of) in (0..).zip(&mut repeats) {
                let dir = folder.join(format!("{name}_{repeat}"));
                simulated::record(&robot, &trial, 10 * number + repeat, &dir)?;
                let run = Run {
                    name: (*name).to_owned(),
                    log: RunLog::read(&dir)?,
                    role: Role::Fit,
                    sha256: String::new(),
                };
                of.push(reading::trial(model, &run)?);
            }
        }
        let [first, second] =
            repeats.map(|trials| Data::new(model, trials, SegmentOptions::default()));
        let replayer = Replayer::new(Arc::clone(model), 1)?;
        let nominal = replayer.predict(&first, &[Vec::new()])?.swap_remove(0);
        let mut sigma = vec![1.0; first.len()];
        for (s, t) in first.segments.iter().zip(&second.segments) {
            for (p, q) in s.pieces.iter().zip(&t.pieces) {
                let pairs = first.value[p.range.clone()].iter().zip(&second.value[q.range.clone()]);
                let square: f64 = pairs.map(|(a, b)| 0.5 * (a - b) * (a - b)).sum();
                let own = (square / p.range.len().max(1) as f64).sqrt().max(1e-6);
                sigma[p.range.clone()].fill(own);
            }
        }
        Ok(Self { replayer, data: first, nominal, sigma })
    }

    /// Sizes of candidates of one effect at one place, d.
    fn sizes(&self, place: &Place, variants: &[Variant]) -> Result<Vec<f64>, GenerateError> {
        let predictions = self.replayer.predict(&self.data, variants)?;
        let concerned = |index: usize, of_joint: bool| match place.domain {
            Domain::Joints => of_joint && place.items.contains(&index),
            _ => true,
        };
        let (mut missed, mut changed) = (0.0, vec![0.0; variants.len()]);
        for p in self.data.pieces() {
            if !concerned(p.index, p.kind.of_joint()) {
                continue;
            }
            for k in p.range.clone() {
                let nominal = f64::from(self.nominal[k]);
                let off = (self.data.value[k] - nominal) / self.sigma[k];
                // a stretch that broke down says nothing
                if off.is_finite() {
                    missed += off * off;
                }
                for (sum, of) in changed.iter_mut().zip(&predictions) {
                    let by = (f64::from(of[k]) - nominal) / self.sigma[k];
                    if by.is_finite() {
                        *sum += by * by;
                    }
                }
            }
        }
        let d = |sum: f64| (sum / f64::max(missed, 1e-12)).sqrt();
        Ok(changed.into_iter().map(d).collect())
    }

    /// Draws a robot with one effect of at least `least_d`. None where [`DRAWS`] draws gave none.
    pub fn hide(&self, seed: u64, least_d: f64) -> Result<Option<Unknown>, GenerateError> {
        let model = self.replayer.model();
        let key = Key { env: 1, ..Key::for_run(seed) };
        let mut s = Stream::new(key, Purpose::Excitation);
        for _ in 0..DRAWS {
            let effect = effects::ALL[s.below(effects::ALL.len() as u64) as usize];
            let places = effect.places(model);
            if places.is_empty() {
                continue;
            }
            let place = places[s.below(places.len() as u64) as usize].clone();
            let factor = s.uniform_f64(FACTORS.0, FACTORS.1);
            let neutral = effect.neutral(model, &place);
            let sized = |k: usize| -> Vec<f64> {
                let grid = effect.sizes(model, &place, k);
                let scaled = grid.iter().zip(&neutral).map(|(x, n)| n + factor * (x - n));
                scaled
                    .enumerate()
                    .map(|(p, x)| {
                        let (low, high) = effect.bounds(model, &place, p);
                        x.clamp(low, high)
                    })
                    .collect()
            };
            let term = |values| Term { effect, place: place.clone(), values };
            let hidden = (0..effect.grid.len()).map(|k| term(sized(k)));
            let hidden: Vec<Term> = hidden.filter(|t| self.is_physics(t)).collect();
            let variants: Vec<Variant> = hidden.iter().map(|t| vec![t.clone()]).collect();
            let sizes = self.sizes(&place, &variants)?;
            let large = hidden.iter().zip(sizes).filter(|(_, d)| *d >= least_d);
            let large: Vec<(&Term, f64)> = large.collect();
            if let Some(&(term, d)) = large.get(s.below(large.len().max(1) as u64) as usize) {
                return Ok(Some(Unknown {
                    lane: lane_of(model, term, 0.0).lane,
                    answer: answer(seed, Some((true_effect(model, term, d), d))),
                }));
            }
        }
        Ok(None)
    }

    /// A healthy one.
    pub fn healthy(&self, seed: u64) -> Unknown {
        Unknown { lane: LaneParams::nominal(self.replayer.model()), answer: answer(seed, None) }
    }

    /// Whether it changes the robot's physics, and those alone: nothing in sensors and clocks, nothing that
    /// depends on when a run is, nothing that the log tells.
    fn is_physics(&self, term: &Term) -> bool {
        let model = self.replayer.model();
        let plain = Plant::nominal(model);
        let [early, late] = [0.0, 1.0].map(|session| lane_of(model, term, session));
        let joints_run_in = early.run_in.iter().all(|r| r.extra_nm == 0.0);
        early.lane != plain.lane
            && early.lane == late.lane
            && early.lane.supply_v == plain.lane.supply_v
            && early.sensing == plain.sensing
            && joints_run_in
    }
}

/// The robot with an effect, `session` of the way through a day.
fn lane_of(model: &Arc<RobotModel>, term: &Term, session: f64) -> Plant {
    let mut plant = Plant::nominal(model);
    plant.session = session;
    (term.effect.apply)(&mut plant, &term.place, &term.values);
    plant
}

fn answer(seed: u64, hidden: Option<(TrueEffect, f64)>) -> Answer {
    Answer {
        block: match hidden {
            Some(_) => Block::Single,
            None => Block::Null,
        },
        seed,
        together_d: hidden.as_ref().map_or(0.0, |h| h.1),
        effects: hidden.into_iter().map(|h| h.0).collect(),
        ..Answer::default()
    }
}

fn true_effect(model: &RobotModel, term: &Term, d: f64) -> TrueEffect {
    let Term { effect, place, values } = term;
    let same = |of: &Effect| hidden::find(of.id).map_or(&[][..], |h| h.equivalent.1);
    let neutral = effect.neutral(model, place);
    TrueEffect {
        effect: effect.id.to_owned(),
        layer: effect.layer.name().to_owned(),
        joint: place.names.join("+"),
        size: values[0],
        d,
        equivalent: same(effect).iter().map(|s| (*s).to_owned()).collect(),
        equivalent_beside: Vec::new(),
        parameters: (effect.parameters.iter().zip(values).zip(neutral))
            .map(|((p, &value), nominal)| TrueValue {
                names: vec![p.name.to_owned()],
                unit: p.unit.to_owned(),
                value,
                nominal,
            })
            .collect(),
    }
}
