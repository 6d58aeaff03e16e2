//! Which runs are held out where nobody says.

use std::collections::BTreeMap;

use super::request::Split;
use crate::error::GapError;
use crate::replay::{Data, Replayer, SegmentOptions};
use crate::trial::{Kind, Role, Trial};

/// Sets a third of the trials aside where none are held out: of all trials, in the order of how far the robot as given
/// is off in them, the second of each three. The one that shows most of a gap is fitted, so that it can be found, and
/// one that shows as much as most do is left to judge.
///
/// # Errors
/// As [`Replayer::predict`].
pub fn hold_out(replayer: &Replayer, trials: &mut [Trial]) -> Result<Split, GapError> {
    let held = trials.iter().any(|t| t.role == Role::Holdout);
    let fitted = trials.iter().any(|t| t.role == Role::Fit);
    if held && fitted {
        return Ok(Split::Given);
    }
    for t in trials.iter_mut() {
        t.role = Role::Fit;
    }
    let groups = trials.iter().map(|t| t.group).max().map_or(0, |g| g + 1);
    if groups < 3 {
        return Ok(Split::Same);
    }
    let off = off_by(replayer, trials, groups)?;
    let members = |g: usize| trials.iter().filter(|t| t.group == g).count();
    let repeated: Vec<bool> = (0..groups).map(|g| members(g) > 1).collect();
    let aside = middles(&off, &repeated);
    for t in trials.iter_mut().filter(|t| aside.contains(&t.group)) {
        t.role = Role::Holdout;
    }
    Ok(Split::SetAside)
}

/// How far the robot as given is off in each group of repeats: its share of all errors of a channel (mean squares),
/// mean over the channels. `[G]`
fn off_by(replayer: &Replayer, trials: &[Trial], groups: usize) -> Result<Vec<f64>, GapError> {
    let data = Data::new(replayer.model(), trials.to_vec(), SegmentOptions::default());
    let as_given = replayer.predict(&data, &[Vec::new()])?.swap_remove(0);
    let mut channels: BTreeMap<(Kind, usize), Vec<[f64; 2]>> = BTreeMap::new();
    for (segment, piece) in data.parts() {
        let of =
            channels.entry((piece.kind, piece.index)).or_insert_with(|| vec![[0.0; 2]; groups]);
        let [sum, n] = &mut of[data.trials[segment.trial].group];
        for k in piece.range.clone() {
            let square = (data.value[k] - f64::from(as_given[k])).powi(2);
            if square.is_finite() {
                *sum += square;
                *n += 1.0;
            }
        }
    }
    let mut out = vec![0.0; groups];
    for of in channels.values() {
        let squares: Vec<f64> = of.iter().map(|[sum, n]| sum / f64::max(*n, 1.0)).collect();
        let all = squares.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        out.iter_mut().zip(&squares).for_each(|(out, square)| *out += square / all);
    }
    Ok(out)
}

/// The second of each three, greatest first; of one three the third where no repeat would be left to fit: what runs
/// differ by tells their noise.
fn middles(off: &[f64], repeated: &[bool]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..off.len()).collect();
    order.sort_by(|&a, &b| off[b].total_cmp(&off[a]));
    let mut aside: Vec<usize> = order.chunks_exact(3).map(|three| three[1]).collect();
    let fitted = |aside: &[usize]| (0..off.len()).any(|g| repeated[g] && !aside.contains(&g));
    if let Some(k) = aside.iter().position(|&g| repeated[g]).filter(|_| !fitted(&aside)) {
        aside[k] = order[3 * k + 2];
    }
    aside
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_shows_most_is_fitted_and_a_third_is_held_out() {
        assert_eq!(middles(&[0.1, 0.2, 9.0], &[false; 3]), [1]);
        assert_eq!(middles(&[9.0, 0.2, 0.1, 0.3, 0.15], &[false; 5]), [3]);
        let six = [1.0, 6.0, 2.0, 5.0, 3.0, 4.0];
        assert_eq!(middles(&six, &[false; 6]), [3, 2]);
        // the only repeats are the second of the first three: they stay, and the third is held out
        assert_eq!(middles(&six, &[false, false, false, true, false, false]), [5, 2]);
        assert_eq!(middles(&six, &[false, true, false, true, false, false]), [3, 2]);
    }
}
