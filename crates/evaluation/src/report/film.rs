//! One episode and the velocities of all, as the page takes them.

use serde::Serialize;

use super::pack::Packed;
use super::scene::GroundScene;
use crate::{Outcome, Track};

/// Time over which velocities of single episodes are averaged before bands are drawn, s: a stride, in which a
/// salamander's trunk sways.
const STRIDE_S: f64 = 0.7;
/// Time between two points of a curve, s.
const CURVE_STEP_S: f64 = 0.1;
/// Every how many frames speeds and torques are kept.
const EFFORT_EVERY: usize = 2;

/// An episode that can be replayed.
#[derive(Debug, Serialize)]
pub struct FilmData {
    period_s: f64,
    fell: Option<&'static str>,
    ground: GroundScene,
    /// As [`pose_row`].
    pose: Packed,
    /// As [`motion_row`].
    motion: Packed,
    /// Torque (16), then speed (16) of the actuated joints, every [`EFFORT_EVERY`] frames.
    effort: Packed,
}

impl FilmData {
    /// Packs the film of an outcome; `None` where there is none.
    pub fn of(outcome: &Outcome) -> Option<Self> {
        let film = outcome.film.as_ref().filter(|f| !f.poses.is_empty())?;
        let frames = &film.trace.frames;
        let effort = |f: &crate::Frame| [&f.torque_nm[..], &f.joint_vel_radps[..]].concat();
        let thinned = frames.iter().step_by(EFFORT_EVERY);
        Some(Self {
            period_s: film.trace.period_s,
            fell: film.trace.fell,
            ground: GroundScene::around(
                &outcome.terrain,
                &frames.iter().map(|f| f.com_m).collect::<Vec<_>>(),
            ),
            pose: Packed::of(&film.poses.iter().map(pose_row).collect::<Vec<_>>()),
            motion: Packed::of(&frames.iter().map(motion_row).collect::<Vec<_>>()),
            effort: Packed::of(&thinned.map(effort).collect::<Vec<_>>()),
        })
    }
}

/// Commanded vx, vy, yaw rate; achieved; centre of mass (3); heading; power; height of each foot; force on each
/// foot; trunk and tail force.
pub fn motion_row(frame: &crate::Frame) -> Vec<f32> {
    let mut row = frame.command.to_vec();
    row.extend(frame.velocity_mps);
    row.push(frame.yaw_rate_radps);
    row.extend(frame.com_m);
    row.push(frame.heading_rad);
    row.push(frame.power_w.iter().map(|p| p.abs()).sum());
    row.extend(frame.foot_height_m);
    row.extend(frame.foot_force_n);
    row.extend([frame.trunk_force_n, frame.tail_force_n]);
    row
}

/// Base position (3) and quaternion (4), then all joints.
pub fn pose_row(pose: &crate::RobotPose) -> Vec<f32> {
    let mut row = pose.base_pos_m.to_vec();
    row.extend(pose.base_quat_wxyz);
    row.extend(&pose.joint_pos_rad);
    row
}

/// Commanded and achieved velocity over time, over all episodes of a scenario with one command.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Curves {
    step_s: f64,
    /// vx, vy, yaw rate.
    signals: [Curve; 3],
}

/// One signal.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
struct Curve {
    command: Vec<f32>,
    mean: Vec<f32>,
    /// Tenth and ninetieth percentile over the episodes that last so long.
    low: Vec<f32>,
    high: Vec<f32>,
}

impl Curves {
    /// `None` without tracks.
    pub fn of(tracks: &[Track], period_s: f64) -> Option<Self> {
        let longest = tracks.iter().map(|t| t.rows.len()).max().unwrap_or(0);
        if longest == 0 {
            return None;
        }
        let every = (CURVE_STEP_S / period_s).round().max(1.0) as usize;
        let half = (STRIDE_S / period_s / 2.0).round() as usize;
        let smooth: Vec<Vec<[f32; 6]>> =
            tracks.iter().map(|t| smoothed(&t.rows, half, every)).collect();
        let signal = |s: usize| {
            let mut curve = Curve::default();
            for k in 0..longest.div_ceil(every) {
                let rows: Vec<&[f32; 6]> = smooth.iter().filter_map(|t| t.get(k)).collect();
                let mean =
                    |i: usize| rows.iter().map(|r| r[i]).sum::<f32>() / rows.len().max(1) as f32;
                let mut values: Vec<f32> = rows.iter().map(|r| r[3 + s]).collect();
                values.sort_by(f32::total_cmp);
                curve.command.push(rounded(mean(s)));
                curve.mean.push(rounded(mean(3 + s)));
                curve.low.push(rounded(percentile(&values, 0.1)));
                curve.high.push(rounded(percentile(&values, 0.9)));
            }
            curve
        };
        Some(Self { step_s: every as f64 * period_s, signals: std::array::from_fn(signal) })
    }
}

/// Commanded and achieved velocity per command, mean over its episodes after settling, where there are
/// several.
pub fn grid(tracks: &[Track], commands: usize, period_s: f64, settle_s: f64) -> Vec<[f32; 6]> {
    if commands < 2 {
        return Vec::new();
    }
    let first = (settle_s / period_s).round() as usize;
    let of_command = |c: usize| {
        let rows = tracks.iter().skip(c).step_by(commands);
        let settled: Vec<&[f32; 6]> = rows.flat_map(|t| t.rows.iter().skip(first)).collect();
        let n = settled.len().max(1) as f64;
        let mean = |i: usize| settled.iter().map(|r| f64::from(r[i])).sum::<f64>() / n;
        std::array::from_fn(|i| rounded(mean(i) as f32))
    };
    (0..commands).map(of_command).collect()
}

/// Means over `half` rows on both sides (of as many as there are), of every `every`-th row; commands as they
/// are.
fn smoothed(rows: &[[f32; 6]], half: usize, every: usize) -> Vec<[f32; 6]> {
    let around = |k: usize| {
        let near = &rows[k.saturating_sub(half)..rows.len().min(k + half + 1)];
        let mean = |i: usize| near.iter().map(|r| r[i]).sum::<f32>() / near.len() as f32;
        std::array::from_fn(|i| if i < 3 { rows[k][i] } else { mean(i) })
    };
    (0..rows.len()).step_by(every).map(around).collect()
}

/// Nearest rank; 0 for no values.
fn percentile(sorted: &[f32], share: f64) -> f32 {
    let last = sorted.len().saturating_sub(1) as f64;
    let rank = (share * last).round() as usize;
    sorted.get(rank).copied().unwrap_or(0.0)
}

/// A tenth of a millimetre per second: shorter text.
fn rounded(x: f32) -> f32 {
    (x * 1e4).round() / 1e4
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ten episodes of 4 s at 0.3 m/s commanded; number e does 0.01·e more than 0.2 m/s.
    fn tracks() -> Vec<Track> {
        let row = |e: usize| [0.3, 0.0, 0.0, 0.2 + 0.01 * e as f32, 0.0, 0.1];
        (0..11).map(|e| Track { rows: vec![row(e); 200] }).collect()
    }

    #[test]
    fn bands_by_hand() {
        let curves = Curves::of(&tracks(), 0.02).unwrap();
        let vx = &curves.signals[0];
        assert_eq!((vx.mean.len(), curves.step_s), (40, 0.1));
        // 0.20 … 0.30 in eleven steps: tenth percentile 0.21, ninetieth 0.29
        assert_eq!([vx.command[20], vx.mean[20], vx.low[20], vx.high[20]], [0.3, 0.25, 0.21, 0.29]);
        assert_eq!(curves.signals[2].mean[0], 0.1);
        assert_eq!(Curves::of(&[], 0.02), None);
    }

    #[test]
    fn episodes_that_fall_leave_the_band() {
        let mut tracks = tracks();
        tracks[10].rows.truncate(100);
        let curves = Curves::of(&tracks, 0.02).unwrap();
        // 0.20 … 0.29
        assert_eq!(curves.signals[0].mean[39], 0.245);
    }

    #[test]
    fn a_grid_takes_every_command_for_itself() {
        // two commands in turn: episodes 0, 2, … 10 and 1, 3, … 9
        let grid = grid(&tracks(), 2, 0.02, 2.0);
        assert_eq!(grid.len(), 2);
        assert_eq!([grid[0][3], grid[1][3]], [0.25, 0.25]);
        assert!(super::grid(&tracks(), 1, 0.02, 2.0).is_empty());
    }
}
