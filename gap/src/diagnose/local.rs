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
                let raw = data.value[k] - f64::from(on.prediction[k]);
                add(own, data.time_s[k], f64::from(on.residual[k]), raw);
            }
        }
    }
    let gap = |((trial, channel), windows): (&(usize, usize), &Vec<Window>)| {
        let trial = &data.trials[*trial];
        let channel = &trial.channels[*channel];
        let (worst, ratio) = worst(windows)?;
        Some(LocalGap {
            run: trial.name.clone(),
            joint: channel.name.clone(),
            from_s: worst.from_s,
            to_s: worst.until_s,
            rms_rad: (worst.raw / worst.samples).sqrt(),
            unit: channel.kind.unit_at(model, channel.index).to_owned(),
            ratio,
        })
    };
    windows.iter().filter_map(gap).collect()
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

/// Adds a sample, whitened and raw, to the last window, or to a new one.
fn add(windows: &mut Vec<Window>, time_s: f64, whitened: f64, raw: f64) {
    let (square, raw) = (whitened.powi(2), raw.powi(2));
    match windows.last_mut().filter(|w| time_s < w.from_s + LOCAL_WINDOW_S) {
        Some(w) => {
            w.until_s = time_s;
            w.samples += 1.0;
            w.square += square;
            w.raw += raw;
        }
        None => {
            windows.push(Window { from_s: time_s, until_s: time_s, samples: 1.0, square, raw });
        }
    }
}

/// The worst of them, and its root mean square. What is left at the end of a run counts as if the rest of its window
/// agreed.
fn worst(windows: &[Window]) -> Option<(&Window, f64)> {
    let whole = windows.iter().map(|w| w.samples).fold(1.0, f64::max);
    let worst = windows.iter().max_by(|a, b| a.square.total_cmp(&b.square))?;
    Some((worst, (worst.square / whole).sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ten tolerances in one of three stretches of 0.7 s, at 50 Hz: 10²·35/100 in the mean of the 2 s that begin with
    /// the first. Twenty in the 0.1 s that are left are 20²·5/100.
    #[test]
    fn a_window_goes_on_over_stretches_and_what_is_left_is_no_whole_one() {
        let of = |at: std::ops::Range<u32>, off: f64| {
            let mut windows = Vec::new();
            for k in 0..105 {
                let whitened = if at.contains(&k) { off } else { 0.0 };
                add(&mut windows, 0.02 * f64::from(k), whitened, 0.0);
            }
            assert_eq!(windows.iter().map(|w| w.samples).collect::<Vec<_>>(), [100.0, 5.0]);
            let (worst, ratio) = worst(&windows).unwrap();
            (worst.from_s, ratio)
        };
        assert_eq!(of(35..70, 10.0), (0.0, 35.0_f64.sqrt()));
        assert_eq!(of(100..105, 20.0), (2.0, 20.0_f64.sqrt()));
    }
}
