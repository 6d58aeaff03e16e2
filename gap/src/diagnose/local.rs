//! What is confined to one run, one joint and a few seconds: a mean over all runs of a joint does not show it.

use std::collections::BTreeMap;

use caudata_model::RobotModel;

use super::judge::Judge;
use super::product::dot;
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

/// The worst window of each run and joint.
fn of_runs(model: &RobotModel, judge: &Judge, on: &On) -> Vec<LocalGap> {
    let data = &judge.data;
    let mut worst: BTreeMap<(usize, usize), LocalGap> = BTreeMap::new();
    for segment in &data.segments {
        let trial = &data.trials[segment.trial];
        for piece in segment.pieces.iter().filter(|p| p.kind == Kind::Position) {
            let mut from = piece.range.start;
            while from < piece.range.end {
                let until_s = data.time_s[from] + LOCAL_WINDOW_S;
                let times = &data.time_s[from..piece.range.end];
                let to = from + times.partition_point(|t| *t < until_s).max(1);
                let n = (to - from) as f64;
                let part = &on.residual[from..to];
                let raw = |k: usize| data.value[k] - f64::from(on.prediction[k]);
                let square: f64 = (from..to).map(|k| raw(k).powi(2)).sum();
                let gap = LocalGap {
                    run: trial.name.clone(),
                    joint: trial.channels[piece.channel].name.clone(),
                    from_s: data.time_s[from],
                    to_s: data.time_s[to - 1],
                    rms_rad: (square / n).sqrt(),
                    unit: piece.kind.unit_at(model, piece.index).to_owned(),
                    ratio: (dot(part, part) / n).sqrt(),
                };
                let own = worst.entry((segment.trial, piece.index));
                let own = own.or_insert_with(|| gap.clone());
                if gap.ratio > own.ratio {
                    *own = gap;
                }
                from = to;
            }
        }
    }
    worst.into_values().collect()
}
