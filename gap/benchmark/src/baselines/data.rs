//! A case as a baseline sees it: its runs, the noise that repeats show, residuals of candidates in the engine.

use std::path::Path;
use std::sync::Arc;

use caudata_gap::effects::Effect;
use caudata_gap::excitation::Excitation;
use caudata_gap::place::{Domain, Place};
use caudata_gap::replay::{Data, Piece, Replayer, SegmentOptions, Term, Variant};
use caudata_gap::trial::{Kind, Role, Trial};
use caudata_gap::{GapError, effects, reading, repeats};
use caudata_model::RobotModel;

use crate::examinee::{self, ExamineeError, Read};

/// Why a case cannot be read, or simulated.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// The case.
    #[error("{0}")]
    Case(#[from] ExamineeError),
    /// A run, or the engine.
    #[error("{0}")]
    Gap(#[from] GapError),
}

/// Runs of one role, each the mean of its repeats.
pub struct Part {
    /// The runs.
    pub data: Data,
    /// What repeats differ by, standard deviation of each sample, SI; infinite where a channel does not count.
    /// `[N]`
    sigma: Vec<f64>,
}

/// Fit and held-out runs of a case.
pub struct CaseData {
    /// The engine.
    pub replayer: Replayer,
    /// Runs to fit to.
    pub fit: Part,
    /// Held-out runs.
    pub holdout: Part,
    excitation: Excitation,
}

impl Part {
    fn of(model: &RobotModel, trials: &[Trial], role: Role) -> Self {
        let own: Vec<Trial> = trials.iter().filter(|t| t.role == role).cloned().collect();
        let data = Data::new(model, repeats::collapse(&own), SegmentOptions::default());
        let mut sigma = vec![f64::INFINITY; data.len()];
        for segment in &data.segments {
            for piece in segment.pieces.iter().filter(counts) {
                let trial = &data.trials[segment.trial];
                let times_s = &data.time_s[piece.range.clone()];
                sigma[piece.range.clone()].fill(apart(trial, piece, times_s).max(1e-4));
            }
        }
        Self { data, sigma }
    }

    /// Channels that count, with where their samples are.
    fn channels(&self) -> Vec<(Kind, usize, Vec<&Piece>)> {
        let mut out: Vec<(Kind, usize, Vec<&Piece>)> = Vec::new();
        for piece in (self.data.segments.iter()).flat_map(|s| s.pieces.iter().filter(counts)) {
            match out.iter_mut().find(|c| (c.0, c.1) == (piece.kind, piece.index)) {
                Some(channel) => channel.2.push(piece),
                None => out.push((piece.kind, piece.index, vec![piece])),
            }
        }
        out
    }

    /// Geometric mean over channels of the root mean square of `after` over that of `before`. `[N]` each.
    pub fn ratio(&self, before: &[f64], after: &[f64]) -> f64 {
        let channels = self.channels();
        let log = |(_, _, pieces): &(Kind, usize, Vec<&Piece>)| {
            let of = |r: &[f64]| pieces.iter().map(|p| square(&r[p.range.clone()])).sum::<f64>();
            0.5 * (of(after).max(1e-12) / of(before).max(1e-12)).ln()
        };
        (channels.iter().map(log).sum::<f64>() / channels.len().max(1) as f64).exp()
    }
}

/// Whether baselines look at a channel.
fn counts(piece: &&Piece) -> bool {
    matches!(piece.kind, Kind::Position | Kind::Velocity | Kind::Current)
}

/// Standard deviation of the repeats of `trial` in a channel, SI.
fn apart(trial: &Trial, piece: &Piece, times_s: &[f64]) -> f64 {
    let of = |m: &Trial, t: f64| Some(m.channel(piece.kind, piece.index)?.at(m.span_s.0 + t));
    let (mut sum, mut count) = (0.0, 0.0);
    for pair in trial.members.windows(2) {
        for t in times_s.iter().map(|t| t - trial.span_s.0) {
            if let (Some(x), Some(y)) = (of(&pair[0], t), of(&pair[1], t)) {
                sum += 0.5 * (x - y) * (x - y);
                count += 1.0;
            }
        }
    }
    f64::sqrt(sum / f64::max(count, 1.0))
}

/// Sum of squares.
pub(super) fn square(r: &[f64]) -> f64 {
    r.iter().map(|x| x * x).sum()
}

impl CaseData {
    /// Reads a case folder.
    pub fn read(folder: &Path) -> Result<Self, DataError> {
        let Read { model, runs, .. } = examinee::read(folder)?;
        let model = Arc::new(model);
        let trials = runs.iter().map(|run| reading::trial(&model, run));
        let mut trials: Vec<Trial> = trials.collect::<Result<_, _>>()?;
        repeats::group(&model, &mut trials);
        let [fit, holdout] = [Role::Fit, Role::Holdout].map(|r| Part::of(&model, &trials, r));
        if fit.data.is_empty() || holdout.data.is_empty() {
            let (folder, what) = (folder.to_owned(), "fit or holdout runs");
            return Err(ExamineeError::Missing { folder, what }.into());
        }
        let excitation = Excitation::of(&model, &fit.data.trials.iter().collect::<Vec<_>>());
        Ok(Self { replayer: Replayer::new(model, 1)?, fit, holdout, excitation })
    }

    /// The robot.
    pub fn model(&self) -> &RobotModel {
        self.replayer.model()
    }

    /// Measured less predicted of every variant on the runs of `part`, in standard deviations of repeats.
    /// `[V][N]`
    ///
    /// # Errors
    /// [`DataError::Gap`].
    pub fn residuals(&self, part: &Part, variants: &[Variant]) -> Result<Vec<Vec<f64>>, DataError> {
        let predictions = self.replayer.predict(&part.data, variants)?;
        let off = |((m, p), sigma): ((&f64, &f32), &f64)| {
            let r = (m - f64::from(*p)) / sigma;
            if r.is_nan() { 1e3 } else { r }
        };
        let of = |p: &Vec<f32>| {
            let pairs = part.data.value.iter().zip(p).zip(&part.sigma);
            pairs.map(off).collect()
        };
        Ok(predictions.iter().map(of).collect())
    }

    /// Error on held-out runs of `variant` over that of the robot as given.
    ///
    /// # Errors
    /// [`DataError::Gap`].
    pub fn holdout_ratio(&self, variant: &Variant) -> Result<f64, DataError> {
        let both = self.residuals(&self.holdout, &[Variant::new(), variant.clone()])?;
        Ok(self.holdout.ratio(&both[0], &both[1]))
    }

    /// Effect `id` at each joint by itself, or at each of the places that it has, with nothing of it.
    pub fn each(&self, id: &str) -> Variant {
        effects::find(id).map_or_else(Vec::new, |effect| self.everywhere(effect))
    }

    /// Every effect of the catalogue that the runs can show, at every single place, with nothing of it.
    pub fn candidates(&self) -> Variant {
        let all = effects::ALL.iter().flat_map(|e| self.everywhere(e));
        all.filter(|t| (t.effect.unseen)(&self.excitation, &t.place).is_none()).collect()
    }

    fn everywhere(&self, effect: &'static Effect) -> Variant {
        let alone = |p: &Place| p.items.len() <= 1 || effect.domain == Domain::Robot;
        let places = effect.places(self.model()).into_iter().filter(alone);
        places.map(|place| Term::nothing(self.model(), effect, place)).collect()
    }
}
