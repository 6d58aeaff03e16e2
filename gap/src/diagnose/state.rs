//! What a search carries along: the runs with their metric, and a candidate with its predictions.

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;

use super::folds::{Folds, Free};
use super::judge::Judge;
use super::losses::Losses;
use super::product::widen;
use super::scout::{Scout, WINDOW_S};
use super::stops::Passed;
use crate::calibration::Calibration;
use crate::effects::Effect;
use crate::error::GapError;
use crate::excitation::Excitation;
use crate::replay::{Replayer, Term, Variant};

/// A whitened trace of less than this square is rounding.
const LEAST_SQUARE: f64 = 1e-6;

/// Everything that does not change from candidate to candidate.
pub struct Context {
    /// The simulator.
    pub replayer: Replayer,
    /// Runs to fit to.
    pub fit: Judge,
    /// A few stretches of them that tell most, where all would take minutes.
    pub scout: Option<Scout>,
    /// Parts of the runs to fit to that are left out in turn.
    pub folds: Folds,
    /// Runs held out: touched once, when everything is decided.
    pub holdout: Judge,
    /// Whether there are none, and [`Context::holdout`] are the runs to fit to once more.
    pub same_runs: bool,
    /// Frames that were lost, which the simulator loses as well.
    pub losses: Option<Losses>,
    /// Stops of the robot file that are passed, which the simulator does not have either.
    pub passed: Vec<Passed>,
    /// Effects that are tried.
    pub effects: Vec<&'static Effect>,
    /// What the runs to fit to excite.
    pub excitation: Excitation,
    /// How evidence becomes a probability.
    pub calibration: Calibration,
    /// Seed of every resampling.
    pub seed: u64,
}

/// A candidate on one set of runs.
#[derive(Debug, Clone, Default)]
pub struct On {
    /// What the sensors would have said. `[N]`
    pub prediction: Vec<f32>,
    /// Whitened. `[N]`
    pub residual: Vec<f32>,
    /// Mean square of that.
    pub misfit: f64,
}

impl On {
    /// Judges a prediction.
    pub fn new(judge: &Judge, prediction: Vec<f32>) -> Self {
        let residual = judge.residual(&prediction);
        Self { misfit: judge.misfit(&residual), residual, prediction }
    }
}

/// A candidate.
#[derive(Debug, Clone, Default)]
pub struct State {
    /// Its effects.
    pub terms: Variant,
    /// On the runs it is fitted to.
    pub fit: On,
    /// On the same runs, each part of them with the parameters that the others ask for
    /// ([`super::folds`]); what was predicted is not kept.
    pub cross: On,
    /// On the scout, if there is one.
    pub scout: Option<On>,
    /// On held-out runs; empty until [`Context::judge_held_out`].
    pub holdout: On,
    /// Orthonormal basis of what its parameters can do on the scout (without one: on the runs it is fitted
    /// to), whitened. `[≤ P][N]`
    pub basis: Vec<Vec<f32>>,
}

impl State {
    /// What it is ranked by: its misfit in cross-validation.
    pub fn misfit(&self) -> f64 {
        self.cross.misfit
    }

    /// How it does where candidates are looked at first.
    pub fn on_scout(&self) -> &On {
        self.scout.as_ref().unwrap_or(&self.fit)
    }

    /// Its effects but the one with this number.
    pub fn without(&self, index: usize) -> Variant {
        let mut terms = self.terms.clone();
        terms.remove(index);
        terms
    }

    /// Number of parameters that are not where they are without the effect: one that leaves no trace stays
    /// there.
    pub fn parameters(&self, model: &RobotModel) -> usize {
        let moved = |t: &Term| {
            let neutral = t.neutral(model);
            let same = t.values.iter().zip(neutral).filter(|(v, z)| *v == z);
            t.values.len() - same.count()
        };
        self.terms.iter().map(moved).sum()
    }

    /// Its effects in words.
    pub fn label(&self) -> String {
        self.terms.iter().map(Term::label).collect::<Vec<_>>().join(" + ")
    }

    /// Effects and places, in an order that does not depend on that of discovery.
    pub fn key(&self) -> Vec<String> {
        let mut names: Vec<String> = self.terms.iter().map(Term::label).collect();
        names.sort();
        names
    }
}

/// Whether an effect takes far longer to build up than a stretch of a scout lasts.
pub fn builds_up(effect: &Effect) -> bool {
    let slow = |p: &crate::effects::ParameterSpec| p.unit == "s" && p.high > 12.0 * WINDOW_S;
    effect.parameters.iter().any(slow)
}

/// What each parameter of a model does to all runs.
pub struct Derivatives {
    /// On the runs it is fitted to, whitened, per step. `[P][N]`
    pub fit: Vec<Vec<f32>>,
    /// On held-out runs; empty where there are none. `[P][N]`
    pub holdout: Vec<Vec<f32>>,
    /// The steps, SI. `[P]`
    pub steps: Vec<f64>,
}

impl Context {
    /// Whether the robot is held in all runs that are fitted: there joints hardly move each other.
    pub fn is_held(&self) -> bool {
        self.fit.data.trials.iter().all(|t| t.base == BaseHold::Fixed)
    }

    /// Derivatives by the parameters of `terms`.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn derivatives(&self, terms: &[Term]) -> Result<Derivatives, GapError> {
        let (fit, steps) = self.jacobian(&self.fit, terms)?;
        let holdout = match self.same_runs {
            true => Vec::new(),
            false => self.jacobian(&self.holdout, terms)?.0,
        };
        Ok(Derivatives { fit, holdout, steps })
    }

    /// Where candidates are looked at first: the scout, or the runs to fit to.
    pub fn first_look(&self) -> &Judge {
        self.scout.as_ref().map_or(&self.fit, |s| &s.judge)
    }

    /// Candidates with these effects, simulated on all runs that are fitted.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn states(&self, variants: &[Variant]) -> Result<Vec<State>, GapError> {
        let fit = self.replayer.predict(&self.fit.data, variants)?;
        let mut states: Vec<State> = (variants.iter().zip(fit))
            .map(|(terms, f)| State {
                terms: terms.clone(),
                fit: On::new(&self.fit, f),
                ..State::default()
            })
            .collect();
        self.cross_validate(&mut states.iter_mut().collect::<Vec<_>>())?;
        if let Some(scout) = &self.scout {
            let predictions = self.replayer.predict(&scout.judge.data, variants)?;
            for (state, prediction) in states.iter_mut().zip(predictions) {
                state.scout = Some(On::new(&scout.judge, prediction));
            }
        }
        Ok(states)
    }

    /// Fills in `cross` of `states`.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn cross_validate(&self, states: &mut [&mut State]) -> Result<(), GapError> {
        let terms: Vec<&[Term]> = states.iter().map(|s| &s.terms[..]).collect();
        let jacobians = self.jacobians(&self.fit, &terms)?;
        for (state, (columns, steps)) in states.iter_mut().zip(jacobians) {
            let free = frees(&self.replayer, &state.terms, &steps);
            let residual = self.folds.left_out(&columns, &state.fit.residual, &free);
            state.cross =
                On { prediction: Vec::new(), misfit: self.fit.misfit(&residual), residual };
        }
        Ok(())
    }

    /// Fills in `holdout` of `states`, by tolerances around `terms`.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn judge_held_out(
        &mut self,
        terms: &[Term],
        states: &mut [&mut State],
    ) -> Result<(), GapError> {
        self.holdout.set_base(&self.replayer, terms)?;
        let variants: Vec<Variant> = states.iter().map(|s| s.terms.clone()).collect();
        let predictions = self.replayer.predict(&self.holdout.data, &variants)?;
        for (state, prediction) in states.iter_mut().zip(predictions) {
            state.holdout = On::new(&self.holdout, prediction);
        }
        Ok(())
    }

    /// The robot as its file says, which does not lose the frames of `losses`.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn lossless(&self, losses: &Losses) -> Result<State, GapError> {
        let replayer = self.replayer.except(losses.term.effect);
        let on = |judge: &Judge| -> Result<On, GapError> {
            let prediction = replayer.predict(&judge.data, &[Vec::new()])?.swap_remove(0);
            Ok(On::new(judge, prediction))
        };
        let fit = on(&self.fit)?;
        Ok(State { cross: fit.clone(), fit, holdout: on(&self.holdout)?, ..State::default() })
    }

    /// Fills in `state.basis` from derivatives by its parameters.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn find_basis(&self, state: &mut State) -> Result<(), GapError> {
        state.basis.clear();
        for column in self.jacobian(self.first_look(), &state.terms)?.0 {
            widen(&mut state.basis, column, LEAST_SQUARE);
        }
        Ok(())
    }

    /// Whitened derivatives by each parameter on the runs of `judge`, per step; and the steps, SI.
    /// `([P][N], [P])`
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn jacobian(&self, judge: &Judge, terms: &[Term]) -> Result<Derived, GapError> {
        Ok(self.jacobians(judge, &[terms])?.swap_remove(0))
    }

    /// The same of several models, which share lanes.
    fn jacobians(&self, judge: &Judge, of: &[&[Term]]) -> Result<Vec<Derived>, GapError> {
        let each = of.iter().map(|terms| differences(&self.replayer, terms));
        let (variants, steps): (Vec<Vec<Variant>>, Vec<Vec<f64>>) = each.unzip();
        let predictions = self.replayer.predict(&judge.data, &variants.concat())?;
        let mut pairs = predictions.chunks(2);
        let derivative = |pair: &[Vec<f32>]| {
            let mut d = judge.change(&pair[0], &pair[1]);
            d.iter_mut().for_each(|d| *d *= 0.5);
            d
        };
        let of_one = |steps: Vec<f64>| {
            let own = pairs.by_ref().take(steps.len());
            (own.map(derivative).collect(), steps)
        };
        Ok(steps.into_iter().map(of_one).collect())
    }
}

/// Whitened derivatives by each parameter, per step, and the steps, SI. `([P][N], [P])`
pub type Derived = (Vec<Vec<f32>>, Vec<f64>);

/// How far each parameter of `terms` is from no effect and may go, in `steps` (SI).
pub fn frees(replayer: &Replayer, terms: &[Term], steps: &[f64]) -> Vec<Free> {
    let model = replayer.model();
    let of = |t: &Term, p: usize| {
        let (low, high) = t.bounds(model, p);
        let neutral = t.neutral(model)[p];
        (t.values[p] - neutral, low - t.values[p], high - t.values[p], t.effect.hinge)
    };
    let all = terms.iter().flat_map(|t| (0..t.values.len()).map(move |p| of(t, p)));
    all.zip(steps)
        .map(|((off, down, up, at_a_threshold), step)| Free {
            from_neutral: off / step,
            room: (down / step, up / step),
            at_a_threshold,
        })
        .collect()
}

/// Parameter `p` of `term` up and down by a step, within its bounds, SI.
pub fn up_and_down(replayer: &Replayer, term: &Term, p: usize) -> (f64, f64) {
    let model = replayer.model();
    let scale = term.scale(model, p).abs();
    let neutral = term.neutral(model)[p];
    let step = (0.3 * scale).max(0.02 * (term.values[p] - neutral).abs());
    let (low, high) = term.bounds(model, p);
    ((term.values[p] + step).min(high), (term.values[p] - step).max(low))
}

/// Two candidates per parameter, up and down by a step, and half the distance between them, SI.
pub fn differences(replayer: &Replayer, terms: &[Term]) -> (Vec<Variant>, Vec<f64>) {
    let (mut variants, mut steps) = (Vec::new(), Vec::new());
    for (i, term) in terms.iter().enumerate() {
        for p in 0..term.values.len() {
            let (up, down) = up_and_down(replayer, term, p);
            for value in [up, down] {
                let mut variant = terms.to_vec();
                variant[i].values[p] = value;
                variants.push(variant);
            }
            steps.push(0.5 * (up - down).max(1e-12));
        }
    }
    (variants, steps)
}
