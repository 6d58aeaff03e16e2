//! Runs of one trial against each other: what happened once and not again.

use caudata_runlog::Signal;
use serde::{Deserialize, Serialize};

use super::channels::Channels;
use super::finding::{Finding, Run};
use super::series::{Grid, median, smooth};
use crate::reading::is_beside;
use crate::repeats::same_conditions;

/// Commands of repeats may differ by this much, rad.
const SAME_RAD: f64 = 2e-3;
/// Deviations are looked at as means over so long, s: a hand pushes to one side, what differs in fast motion
/// swings about zero.
const SMOOTH_S: f64 = 0.3;
/// A deviation counts from so many times what repeats otherwise differ by.
const TIMES: f64 = 8.0;
/// And from so large a share of the servo's greatest torque, as the error would ask for.
const ODD_TORQUE_SHARE: f64 = 0.2;
/// Where no other repeats say what they differ by, one that is off throughout counts from so large a share.
const LITTLE_TORQUE_SHARE: f64 = 0.05;
/// And from so large a share of how far the joint moves about that time: where it moves most, repeats differ
/// most.
const MOTION_SHARE: f64 = 0.2;
/// "About that time", s.
const NEARBY_S: f64 = 1.0;
/// It lasts at least, s.
const SHORTEST_S: f64 = 0.15;
/// A run that is off for longer than this share is another run, not a touched one.
const LONGEST_SHARE: f64 = 0.3;

/// A stretch of a run in which something happened that its repeats do not show.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OddSpan {
    /// Name of the run.
    pub run: String,
    /// Start, s, in the run's time.
    pub from_s: f64,
    /// End, s.
    pub to_s: f64,
    /// The joint that shows it most.
    pub joint: String,
    /// Greatest deviation from the repeats, rad.
    pub peak_rad: f64,
}

/// Groups of runs that were sent the same commands: indices into `runs`, in order.
pub(super) fn groups(runs: &[Run<'_>], channels: &[Vec<Channels>]) -> Vec<Vec<usize>> {
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for i in 0..runs.len() {
        let found = groups.iter_mut().find(|g| alike(runs, channels, g[0], i));
        match found {
            Some(group) => group.push(i),
            None => groups.push(vec![i]),
        }
    }
    groups
}

fn alike(runs: &[Run<'_>], channels: &[Vec<Channels>], a: usize, b: usize) -> bool {
    let (ca, cb) = (&channels[a], &channels[b]);
    let length = |r: &Run<'_>| r.grid.len as f64 * r.grid.step_s;
    let (la, lb) = (length(&runs[a]), length(&runs[b]));
    if ca.len() != cb.len() || ca.is_empty() || (la / lb - 1.0).abs() > 0.03 {
        return false;
    }
    if !same_conditions(runs[a].robot, &runs[a].log.meta, &runs[b].log.meta) {
        return false;
    }
    if !alike_beside(&runs[a], &runs[b]) {
        return false;
    }
    ca.iter().zip(cb).all(|(x, y)| {
        let (Some(u), Some(v)) = (&x.cmd, &y.cmd) else {
            return x.cmd.is_none() && y.cmd.is_none();
        };
        // grids differ a little from run to run: compare at equal times, the nearest point or one beside it
        let n = u.len();
        let ratio = runs[a].grid.step_s / runs[b].grid.step_s;
        let mut off = 0usize;
        for (i, &u) in u.iter().enumerate() {
            let k = (i as f64 * ratio).round() as usize;
            // a row may fall between two grid points of one run and not of the other: compare with what is
            // passed through near by
            let near = &v[k.saturating_sub(2).min(v.len())..(k + 3).min(v.len())];
            let (low, high) = near
                .iter()
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
            let same = SAME_RAD * x.per_radian;
            let close = (low - same..=high + same).contains(&u)
                || (u.is_nan() && near.iter().any(|v| v.is_nan()));
            if !close && !near.is_empty() {
                off += 1;
            }
        }
        off * 100 <= n
    })
}

/// What was commanded beside positions, or pushed, differs by no more than this share of itself, rms.
const ALIKE_BESIDE: f64 = 0.2;

/// Whether two runs were sent the same beside the positions, and pushed alike.
fn alike_beside(a: &Run<'_>, b: &Run<'_>) -> bool {
    let beside = |run: &Run<'_>| -> Vec<Signal> {
        let signals = run.log.table.signals().iter();
        signals.filter(|s| is_beside(s)).cloned().collect()
    };
    let (own, other) = (beside(a), beside(b));
    own.len() == other.len()
        && own.iter().all(|signal| {
            let (u, v) = (a.grid.linear(&a.log.table, signal), b.grid.linear(&b.log.table, signal));
            let (Some(u), Some(v)) = (u, v) else { return false };
            let ratio = a.grid.step_s / b.grid.step_s;
            let there = |i: usize| v.get((i as f64 * ratio).round() as usize).copied();
            let pairs = u.iter().enumerate().filter_map(|(i, u)| Some((*u, there(i)?)));
            let known = pairs.filter(|(u, v)| u.is_finite() && v.is_finite());
            let (off, all) = known
                .fold((0.0, 0.0), |(off, all), (u, v)| (off + (u - v).powi(2), all + u.powi(2)));
            off <= ALIKE_BESIDE * ALIKE_BESIDE * all
        })
}

/// A run with more odd spans than this is not one that was touched: play and stiction let repeats come to
/// rest in different places.
const MOST_SPANS: usize = 1;

/// Odd spans of a group of repeats: with three or more, of the run that is off; with two, of both.
pub(super) fn odd_spans(
    runs: &[Run<'_>],
    channels: &[Vec<Channels>],
    group: &[usize],
) -> Vec<OddSpan> {
    if group.len() < 2 {
        return Vec::new();
    }
    let grid = &runs[group[0]].grid;
    let mut found: Vec<OddSpan> = Vec::new();
    for j in 0..channels[group[0]].len() {
        let Some(off) = Off::of(runs, channels, group, j) else { continue };
        // of two nobody knows which one was disturbed: both
        let members = if group.len() == 2 { 1..2 } else { 0..group.len() };
        for m in members {
            for (from, to) in off.spans(m, grid) {
                let peak_rad = off.rad[m][from..to].iter().fold(0.0, |a: f64, b| a.max(*b));
                let both: &[usize] = if group.len() == 2 { &[0, 1] } else { &[m] };
                found.extend(both.iter().map(|&m| {
                    let start_s = runs[group[m]].grid.start_s;
                    OddSpan {
                        run: runs[group[m]].name.clone(),
                        from_s: start_s + from as f64 * grid.step_s,
                        to_s: start_s + to as f64 * grid.step_s,
                        joint: channels[group[0]][j].name.clone(),
                        peak_rad,
                    }
                }));
            }
        }
    }
    let mut all = merge(found);
    let counts: Vec<usize> =
        all.iter().map(|s| all.iter().filter(|x| x.run == s.run).count()).collect();
    let mut counts = counts.iter();
    all.retain(|_| counts.next().is_some_and(|n| *n <= MOST_SPANS));
    all
}

/// Smoothed positions of joint `j` of the runs in `group`, at equal times; none where it is not logged in all of them.
/// The median step of rows, and with it the grid, differs a little from run to run. `[repeats][N]`
fn positions(
    runs: &[Run<'_>],
    channels: &[Vec<Channels>],
    group: &[usize],
    j: usize,
) -> Option<Vec<Vec<f64>>> {
    let grid = &runs[group[0]].grid;
    let span_s = |&i: &usize| runs[i].grid.len.saturating_sub(1) as f64 * runs[i].grid.step_s;
    let shared_s = group.iter().map(span_s).fold(f64::INFINITY, f64::min);
    let len = (shared_s / grid.step_s + 1e-6).floor() as usize + 1;
    let width = grid.points(SMOOTH_S);
    let position = |&i: &usize| {
        let own = smooth(channels[i][j].pos.as_ref()?, width);
        Some(on_grid(&own, grid.step_s / runs[i].grid.step_s, len))
    };
    group.iter().map(position).collect()
}

/// A run of a group of repeats that is as far off all others throughout.
struct Apart {
    run: usize,
    other: usize,
    joint: usize,
    /// Root mean square, rad.
    off_rad: f64,
    /// Standard deviation of what the joint does in it, rad.
    moves_rad: f64,
}

/// Runs that were sent what others were, under the same notes, and that differ from all of them throughout: far more
/// than repeats otherwise do, or as much as they move. Something is not noted.
pub(super) fn unlike(
    runs: &[Run<'_>],
    channels: &[Vec<Channels>],
    groups: &[Vec<usize>],
) -> Vec<Finding> {
    let repeated = groups.iter().filter(|g| g.len() > 1);
    let joints = |g: &&Vec<usize>| 0..channels[g[0]].len();
    let each = repeated.flat_map(|g| joints(&g).map(move |j| (g, j)));
    let apart: Vec<Apart> = each.flat_map(|(g, j)| nearest(runs, channels, g, j)).collect();
    let usual = |joint: usize| {
        let own: Vec<f64> = apart.iter().filter(|a| a.joint == joint).map(|a| a.off_rad).collect();
        (own.len() > 2).then(|| median(own)).flatten()
    };
    let odd = |a: &&Apart| {
        let index = channels[a.run][a.joint].index;
        let (servo, kp) = (runs[a.run].robot.servo(index), runs[a.run].gains(index).0);
        let lsb_rad = servo.encoder_lsb_rad();
        // by how much repeats can come to rest apart, where no others say it
        let rest_nm = (4.0 * servo.friction_loss_nm).max(LITTLE_TORQUE_SHARE * servo.tau_max_nm);
        let far = match usual(a.joint) {
            Some(usual) => a.off_rad > TIMES * usual,
            None => a.off_rad * kp > rest_nm,
        };
        let as_much = a.off_rad > a.moves_rad && a.moves_rad > 10.0 * lsb_rad;
        a.off_rad > 3.0 * lsb_rad && (far || as_much)
    };
    let mut odd: Vec<&Apart> = apart.iter().filter(odd).collect();
    // of a run the joint that shows it most; of two that part nobody knows which one is the other
    odd.sort_by(|a, b| b.off_rad.total_cmp(&a.off_rad));
    let mut told: Vec<usize> = Vec::new();
    odd.retain(|a| {
        let new = !told.contains(&a.run) && !told.contains(&a.other);
        told.push(a.run);
        new
    });
    odd.into_iter().map(|a| a.finding(runs, channels)).collect()
}

/// How far joint `j` of each run in `group` is off the run that comes nearest.
fn nearest(runs: &[Run<'_>], channels: &[Vec<Channels>], group: &[usize], j: usize) -> Vec<Apart> {
    let Some(all) = positions(runs, channels, group, j) else { return Vec::new() };
    let rms = |x: &mut dyn Iterator<Item = f64>| {
        let (sum, n) =
            x.filter(|d| d.is_finite()).fold((0.0, 0.0), |(s, n), d| (s + d * d, n + 1.0));
        (sum / f64::max(n, 1.0)).sqrt()
    };
    let of = |m: usize| {
        let off = |k: usize| rms(&mut all[m].iter().zip(&all[k]).map(|(a, b)| a - b));
        let others = (0..group.len()).filter(|&k| k != m).map(|k| (off(k), k));
        let (off_rad, other) = others.min_by(|a, b| a.0.total_cmp(&b.0))?;
        let finite = || all[m].iter().copied().filter(|x| x.is_finite());
        let mean = finite().sum::<f64>() / finite().count().max(1) as f64;
        let moves_rad = rms(&mut finite().map(|x| x - mean));
        Some(Apart { run: group[m], other: group[other], joint: j, off_rad, moves_rad })
    };
    (0..group.len()).filter_map(of).collect()
}

impl Apart {
    fn finding(&self, runs: &[Run<'_>], channels: &[Vec<Channels>]) -> Finding {
        let joint = &channels[self.run][self.joint].name;
        Finding::note(
            "repeats",
            format!("{} {joint}", runs[self.run].name),
            format!(
                "was sent what {} was, under the same notes, and is {:.3} rad off it throughout, where it moves by {:.3} rad (root mean square): is a weight, a gain or a supply not noted, or a command not logged?",
                runs[self.other].name, self.off_rad, self.moves_rad
            ),
        )
    }
}

/// How far one joint of each repeat is off the middle of them.
struct Off {
    /// rad; 0 where it is within what repeats differ by when they move so. `[repeats][N]`
    rad: Vec<Vec<f64>>,
    /// From when on it counts, rad.
    threshold_rad: f64,
}

impl Off {
    /// How far joint `j` is off among the runs in `group`; none where its position is not logged in all of
    /// them.
    fn of(runs: &[Run<'_>], channels: &[Vec<Channels>], group: &[usize], j: usize) -> Option<Self> {
        let first = &runs[group[0]];
        let grid = &first.grid;
        let all = positions(runs, channels, group, j)?;
        let len = all[0].len();
        let middle = |t: usize| match all.as_slice() {
            [one, _] => one[t],
            _ => median(all.iter().map(|x| x[t]).collect()).unwrap_or(f64::NAN),
        };
        let middle: Vec<f64> = (0..len).map(middle).collect();
        let nearby = grid.points(NEARBY_S);
        let mean = smooth(&middle, nearby);
        let square = |(x, m): (&f64, &f64)| (x - m).powi(2);
        let squares: Vec<f64> = middle.iter().zip(&mean).map(square).collect();
        let motion = smooth(&squares, nearby);
        let apart =
            |x: &Vec<f64>| -> Vec<f64> { (0..len).map(|t| (x[t] - middle[t]).abs()).collect() };
        let apart: Vec<Vec<f64>> = all.iter().map(apart).collect();
        // what repeats differ by: the middle over everything that is not zero because it is the median itself
        let usual = apart.iter().flatten().copied().filter(|d| *d > 0.0);
        let scale = 1.5 * median(usual.collect()).unwrap_or(0.0);
        let moved = |d: Vec<f64>| {
            let pairs = d.into_iter().zip(&motion);
            let moves = |s: &f64| MOTION_SHARE * (2.0 * s).sqrt();
            pairs.map(|(d, s)| if d > moves(s) { d } else { 0.0 }).collect()
        };
        let index = channels[group[0]][j].index;
        let (servo, kp) = (first.robot.servo(index), first.gains(index).0);
        Some(Self {
            rad: apart.into_iter().map(moved).collect(),
            threshold_rad: (TIMES * scale)
                .max(ODD_TORQUE_SHARE * servo.tau_max_nm / kp.max(1e-6))
                .max(3.0 * servo.encoder_lsb_rad()),
        })
    }

    /// Stretches in which repeat `m` is off, and no other is as far: points from, to.
    fn spans(&self, m: usize, grid: &Grid) -> Vec<(usize, usize)> {
        let own = &self.rad[m];
        let alone = |t: usize| {
            let mut others = self.rad.iter().enumerate();
            others.all(|(k, d)| k == m || d[t].is_nan() || d[t] <= 0.5 * own[t])
        };
        let mut all = spans(own, self.threshold_rad, grid.points(SHORTEST_S), grid.points(0.3));
        all.retain(|&(from, to)| {
            let short = ((to - from) as f64) < LONGEST_SHARE * own.len() as f64;
            short && (from..to).filter(|&t| alone(t)).count() * 3 >= (to - from) * 2
        });
        all
    }
}

/// `len` points of `x`, `step` of its points apart, on the line between them.
fn on_grid(x: &[f64], step: f64, len: usize) -> Vec<f64> {
    (0..len)
        .map(|i| {
            let at = i as f64 * step;
            let k = (at.floor() as usize).min(x.len().saturating_sub(1));
            let next = (k + 1).min(x.len().saturating_sub(1));
            let share = (at - k as f64).clamp(0.0, 1.0);
            match (x.get(k), x.get(next)) {
                (Some(a), Some(_)) if share < 1e-9 => *a,
                (Some(a), Some(b)) => a + share * (b - a),
                _ => f64::NAN,
            }
        })
        .collect()
}

/// Stretches above `threshold` of at least `shortest` points; pauses up to `pause` points belong to them.
fn spans(x: &[f64], threshold: f64, shortest: usize, pause: usize) -> Vec<(usize, usize)> {
    let mut out: Vec<(usize, usize)> = Vec::new();
    for (i, _) in x.iter().enumerate().filter(|(_, v)| **v > threshold) {
        match out.last_mut() {
            Some(last) if i <= last.1 + pause => last.1 = i + 1,
            _ => out.push((i, i + 1)),
        }
    }
    out.retain(|(a, b)| b - a >= shortest);
    out
}

/// One span per run and time: of the joints that show it, the one that shows it most.
fn merge(mut all: Vec<OddSpan>) -> Vec<OddSpan> {
    all.sort_by(|a, b| a.run.cmp(&b.run).then(a.from_s.total_cmp(&b.from_s)));
    let mut out: Vec<OddSpan> = Vec::new();
    for span in all {
        match out.last_mut() {
            Some(last) if last.run == span.run && span.from_s <= last.to_s + 0.5 => {
                last.to_s = last.to_s.max(span.to_s);
                if span.peak_rad > last.peak_rad {
                    last.peak_rad = span.peak_rad;
                    last.joint = span.joint;
                }
            }
            _ => out.push(span),
        }
    }
    out
}

/// As findings.
pub(super) fn finding(span: &OddSpan, repeats: usize) -> Finding {
    let who = if repeats == 2 {
        "two repeats part here and nowhere else; record a third to know which one was disturbed"
    } else {
        "its repeats agree with each other; leave the stretch out or record the run again"
    };
    Finding::note(
        "touch",
        format!("{} {}", span.run, span.joint),
        format!(
            "is off by up to {:.3} rad from t = {:.2} to {:.2} s, as if touched: {who}",
            span.peak_rad, span.from_s, span.to_s
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_finer_grid_is_read_at_equal_times() {
        // a ramp of 1 a second, sampled every 10 ms and every 10.1 ms
        let fine: Vec<f64> = (0..200).map(|i| 0.0101 * f64::from(i)).collect();
        let read = on_grid(&fine, 0.01 / 0.0101, 190);
        for (i, x) in read.iter().enumerate() {
            assert!((x - 0.01 * i as f64).abs() < 1e-12, "{i}: {x}");
        }
    }

    #[test]
    fn spans_join_over_pauses_and_short_ones_fall() {
        let mut x = vec![0.0; 100];
        x[10..20].fill(1.0);
        x[23..30].fill(1.0);
        x[60] = 1.0;
        assert_eq!(spans(&x, 0.5, 5, 5), [(10, 30)]);
        assert_eq!(spans(&x, 0.5, 5, 2), [(10, 20), (23, 30)]);
    }
}
