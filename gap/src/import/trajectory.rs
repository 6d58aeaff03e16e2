//! What trajectories ask of a joint over time: points far apart, which a controller connects.

use std::collections::BTreeMap;

use caudata_runlog::ros::messages::{JointTrajectory, TrajectoryPoint};

/// What a trajectory asks for is written this often, ns.
const TRAJECTORY_STEP_NS: i64 = 10_000_000;
/// Longest trajectory, ns.
const MAX_TRAJECTORY_NS: i64 = 3_600_000_000_000;

/// A trajectory, and when it begins: by its stamp, by its receipt, ns.
pub struct Asked {
    pub from_ns: [i64; 2],
    pub trajectory: JointTrajectory,
}

/// A trajectory as its controller follows it until it has another one after `until_ns`: rows by the time since its
/// start, ns. Between points cubic where they have speeds, else straight; from where the one before was (`last`,
/// by joint) to the first.
pub fn followed(
    trajectory: &JointTrajectory,
    until_ns: i64,
    last: &mut BTreeMap<String, f64>,
) -> Vec<(i64, Vec<(String, f64)>)> {
    let mut points: Vec<(i64, &TrajectoryPoint)> =
        trajectory.points.iter().map(|p| (after_ns(p), p)).collect();
    points.sort_by_key(|p| p.0);
    let Some(end_ns) = points.last().map(|p| p.0.min(until_ns.saturating_sub(1)).max(0)) else {
        return Vec::new();
    };
    let steps = end_ns / TRAJECTORY_STEP_NS;
    let times = (0..=steps).map(|k| k * TRAJECTORY_STEP_NS);
    // one more row where the end is between two steps
    let times = times.chain((end_ns % TRAJECTORY_STEP_NS != 0).then_some(end_ns));
    let rows: Vec<(i64, Vec<(String, f64)>)> = times
        .map(|t| {
            let next = points.partition_point(|p| p.0 < t).min(points.len() - 1);
            let before = next.checked_sub(1).map(|k| points[k]);
            let joints = trajectory.name.iter().enumerate();
            let row = joints.filter_map(|(j, name)| {
                let start = last.get(name).copied();
                let value = between(before, points[next], j, t, start)?;
                Some((format!("position/{name}"), value))
            });
            (t, row.collect())
        })
        .collect();
    for (column, value) in rows.iter().flat_map(|r| &r.1) {
        if let Some((_, name)) = column.split_once('/') {
            last.insert(name.to_owned(), *value);
        }
    }
    rows
}

/// How many values [`followed`] gives at most.
pub fn most_values(trajectory: &JointTrajectory, until_ns: i64) -> usize {
    let end_ns = trajectory.points.iter().map(after_ns).max();
    let steps = end_ns.unwrap_or(0).min(until_ns) / TRAJECTORY_STEP_NS;
    let rows = usize::try_from(steps).unwrap_or(0) + 2;
    rows.saturating_mul(trajectory.name.len())
}

/// Time of a point since the start of its trajectory.
fn after_ns(point: &TrajectoryPoint) -> i64 {
    let ns = i64::from(point.after.0) * 1_000_000_000 + i64::from(point.after.1);
    ns.clamp(0, MAX_TRAJECTORY_NS)
}

/// Where joint `j` is at time `t_ns` between two points; before the first point, from `start` on.
fn between(
    before: Option<(i64, &TrajectoryPoint)>,
    (to_ns, to): (i64, &TrajectoryPoint),
    j: usize,
    t_ns: i64,
    start: Option<f64>,
) -> Option<f64> {
    let b = to.position.get(j).copied()?;
    let (from_ns, from) = before.map_or((0, None), |(ns, p)| (ns, Some(p)));
    let a = from.map_or(start, |p| p.position.get(j).copied()).unwrap_or(b);
    let span_s = (to_ns - from_ns) as f64 * 1e-9;
    if span_s <= 0.0 || t_ns >= to_ns {
        return Some(b);
    }
    let u = (t_ns - from_ns) as f64 * 1e-9 / span_s;
    let speeds = from.and_then(|p| Some((*p.velocity.get(j)?, *to.velocity.get(j)?)));
    let Some((va, vb)) = speeds else { return Some(a + u * (b - a)) };
    // the cubic with these ends and these speeds there
    let (u2, u3) = (u * u, u * u * u);
    Some(
        (2.0 * u3 - 3.0 * u2 + 1.0) * a
            + (u3 - 2.0 * u2 + u) * span_s * va
            + (3.0 * u2 - 2.0 * u3) * b
            + (u3 - u2) * span_s * vb,
    )
}
