//! A scout: the few stretches of long recordings that tell most. Screening and the first fits of many
//! candidates look at these alone; whoever does well there is fitted to everything.
//!
//! Stretches are chosen one by one so that together they show as much as possible of every nuisance at every
//! joint, and of what the robot as given fails to explain: each adds the logarithm of what it shows to what
//! the others show already, so that ten stretches of the same motion are not worth ten times one.

use super::judge::{Judge, group};
use super::levels::MANY_JOINTS;
use crate::error::GapError;
use crate::replay::{Data, Replayer, Segment, SegmentOptions};

/// Simulated time per candidate of a scout, s: about what one joint's whole battery has.
const LENGTH_S: f64 = 40.0;
/// Stretches of a held robot, s. Effects that take longer than this to build up are not left to a scout.
pub const WINDOW_S: f64 = 6.0;
/// Time that is simulated before each, s: a joint at rest is where friction left it.
const LEAD_S: f64 = 2.5;
/// What is left unexplained counts so many times what a nuisance would do.
const RESIDUAL_WEIGHT: f64 = 3.0;

/// A few stretches with their metric.
pub struct Scout {
    /// The stretches.
    pub judge: Judge,
    /// What a sample of all runs shows over what one of these shows: at most about 1.
    pub dilution: f64,
}

impl Scout {
    /// Out of the runs of `whole`; none where they are short or the robot is small.
    ///
    /// # Errors
    /// As [`Replayer::predict`].
    pub fn new(
        replayer: &Replayer,
        whole: &Judge,
        options: SegmentOptions,
    ) -> Result<Option<Self>, GapError> {
        let joints = replayer.model().actuated().len();
        if joints < MANY_JOINTS || whole.data.duration_s() <= LENGTH_S {
            return Ok(None);
        }
        let windows = Data::new(
            replayer.model(),
            whole.data.trials.clone(),
            SegmentOptions { fixed_s: WINDOW_S, lead_s: LEAD_S, ..options },
        );
        let shown = shown(replayer, whole, &windows)?;
        let keep = chosen(&windows, &shown);
        let judge = Judge::part_of(whole, replayer, &windows, &keep)?;
        let energy = |of: &mut dyn Iterator<Item = usize>| -> f64 {
            let nuisances = of.flat_map(|w| shown[w].iter().take(shown[w].len() - joints - 1));
            nuisances.sum()
        };
        let all = energy(&mut (0..shown.len())) / whole.data.len().max(1) as f64;
        let here = energy(&mut keep.iter().copied()) / judge.data.len().max(1) as f64;
        Ok(Some(Self { judge, dilution: if here > 0.0 { (all / here).min(1.0) } else { 1.0 } }))
    }
}

/// What each window shows: of each nuisance at each joint, and, in the last places, of what is left at each
/// joint and at the body. `[W][F]`
fn shown(replayer: &Replayer, whole: &Judge, windows: &Data) -> Result<Vec<Vec<f64>>, GapError> {
    let joints = replayer.model().actuated().len();
    let count = windows.segments.len();
    let mut window = vec![usize::MAX; whole.data.len()];
    let mut residuals = vec![vec![0.0; joints + 1]; count];
    let prediction = replayer.predict(&whole.data, &[Vec::new()])?.swap_remove(0);
    let residual = whole.residual(&prediction);
    for (segment, piece) in whole.data.parts() {
        let group = group(joints, piece);
        for k in piece.range.clone() {
            let t = whole.data.time_s[k];
            let of = windows.segments.partition_point(|w| (w.trial, w.end_s) <= (segment.trial, t));
            let inside = |w: &Segment| w.trial == segment.trial && w.start_s <= t;
            if windows.segments.get(of).is_some_and(inside) {
                window[k] = of;
                residuals[of][group] += RESIDUAL_WEIGHT * f64::from(residual[k]).powi(2);
            }
        }
    }
    let nuisances = whole.sensitivities(&window, count, joints).into_iter();
    Ok(nuisances.zip(residuals).map(|(of, residual)| [of, residual].concat()).collect())
}

/// The windows that show most together, in order of recording.
fn chosen(windows: &Data, shown: &[Vec<f64>]) -> Vec<usize> {
    let features = shown.first().map_or(0, Vec::len);
    let mut seen = vec![0.0_f64; features];
    let mut keep: Vec<usize> = Vec::new();
    let mut length_s = 0.0;
    while length_s < LENGTH_S {
        let adds = |w: usize| -> f64 {
            let each = shown[w].iter().zip(&seen);
            let sum: f64 = each.map(|(x, s)| (1.0 + x / (1.0 + s)).ln()).sum();
            sum / windows.segments[w].duration_s().max(1e-3)
        };
        let best = (0..shown.len())
            .filter(|w| !keep.contains(w) && !windows.segments[*w].range.is_empty())
            .map(|w| (w, adds(w)))
            .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
        let Some((w, _)) = best else { break };
        for (s, x) in seen.iter_mut().zip(&shown[w]) {
            *s += x;
        }
        length_s += windows.segments[w].duration_s();
        keep.push(w);
    }
    keep.sort_unstable();
    keep
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::Start;

    /// Windows of 5 s, one after the other.
    fn windows(count: usize) -> Data {
        let segments = (0..count).map(|k| Segment {
            trial: 0,
            start_s: 5.0 * k as f64,
            end_s: 5.0 * (k + 1) as f64,
            range: 10 * k..10 * (k + 1),
            pieces: Vec::new(),
            start: Start::default(),
            again: None,
        });
        Data { segments: segments.collect(), ..Data::default() }
    }

    #[test]
    fn what_nobody_shows_yet_comes_before_more_of_the_same() {
        // eleven windows shake one joint, each as hard as can be; one moves the other joint a little: ln(1 +
        // 20/1) = 3.0 for it against ln(1 + 1000/1001) = 0.7 for the second of the loud ones
        let mut shown = vec![vec![1000.0, 0.0]; 12];
        shown[6] = vec![0.0, 20.0];
        let keep = chosen(&windows(12), &shown);
        // 40 s are eight windows of 5 s
        assert_eq!(keep.len(), 8);
        assert!(keep.contains(&6), "{keep:?}");
        assert!(keep.windows(2).all(|w| w[0] < w[1]), "{keep:?}");
    }

    #[test]
    fn short_recordings_are_taken_whole() {
        assert_eq!(chosen(&windows(3), &vec![vec![1.0]; 3]), [0, 1, 2]);
    }
}
