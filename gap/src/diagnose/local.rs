//! What is confined to one run, one joint and a few seconds: a mean over all runs of a joint does not show it.

use std::collections::BTreeMap;

use caudata_model::RobotModel;

use super::judge::Judge;
use super::state::{Context, On};
use crate::report::LocalGap;
use crate::trial::Kind;

/// Length of a window, s.
const LOCAL_WINDOW_S: f64 = 2.0;
/// Mean square of a window, floors, that is a gap wherever else there is none: see
/// `docs/reference/diagnosis-method.md` for what healthy robots have.
const LOCAL: f64 = 6.0;
/// Most that are reported.
const MOST: usize = 5;

/// Windows of angles in which a model is off by far more than the floor, worst first; one of each run and
/// joint.
pub fn local_gaps(context: &Context, fit: &On, holdout: &On) -> Vec<LocalGap> {
    let model = context.replayer.model();
    let mut out = of_runs(model, &context.fit, fit);
    if !context.same_runs {
        out.extend(of_runs(model, &context.holdout, holdout));
    }
    out.retain(|g| g.ratio > LOCAL.sqrt());
    out.sort_by(|a, b| b.ratio.total_cmp(&a.ratio));
    out.truncate(MOST);
    out
}

/// The worst window of each run and joint. A window goes on over the stretches that a free robot is replayed in.
fn of_runs(model: &RobotModel, judge: &Judge, on: &On) -> Vec<LocalGap> {
    let data = &judge.data;
    let mut windows: BTreeMap<(usize, usize), Vec<Window>> = BTreeMap::new();
    for segment in &data.segments {
        for piece in segment.pieces.iter().filter(|p| p.kind == Kind::Position) {
            let own = windows.entry((segment.trial, piece.channel)).or_default();
            for k in piece.range.clone() {
                let time_s = data.time_s[k];
                match own.last_mut().filter(|w| time_s < w.from_s + LOCAL_WINDOW_S) {
                    Some(window) => window.until_s = time_s,
                    None => own.push(Window::at(time_s)),
                }
                if let Some(window) = own.last_mut() {
                    window.samples += 1.0;
                    window.square += f64::from(on.residual[k]).powi(2);
                    window.raw += (data.value[k] - f64::from(on.prediction[k])).powi(2);
                }
            }
        }
    }
    let worst = |((trial, channel), windows): (&(usize, usize), &Vec<Window>)| {
        let trial = &data.trials[*trial];
        let channel = &trial.channels[*channel];
        // what is left at the end of a run counts as much as it would in a whole window
        let whole = windows.iter().map(|w| w.samples).fold(1.0, f64::max);
        let worst = windows.iter().max_by(|a, b| a.square.total_cmp(&b.square))?;
        Some(LocalGap {
            run: trial.name.clone(),
            joint: channel.name.clone(),
            from_s: worst.from_s,
            to_s: worst.until_s,
            rms_rad: (worst.raw / worst.samples).sqrt(),
            unit: channel.kind.unit_at(model, channel.index).to_owned(),
            ratio: (worst.square / whole).sqrt(),
        })
    };
    windows.iter().filter_map(worst).collect()
}

/// Samples of one joint in a run, one after the other.
struct Window {
    from_s: f64,
    until_s: f64,
    samples: f64,
    /// Σ of squares, in floors, and in rad² (m²).
    square: f64,
    raw: f64,
}

impl Window {
    fn at(time_s: f64) -> Self {
        Self { from_s: time_s, until_s: time_s, samples: 0.0, square: 0.0, raw: 0.0 }
    }
}
