//! What the replay draws: the robot's shapes and joints, the ground, the water.

use caudata_model::{Geom, JointMotion, Link, Pose, RobotModel, has_shell};
use caudata_sim::Terrain;
use serde::Serialize;

use super::pack::Packed;

/// Ground shown around the way of the robot, m.
const MARGIN_M: f64 = 3.0;
/// Most grid points along an edge that a page takes; wider ground is thinned.
const MOST_POINTS: usize = 161;

/// The robot. Frames as in [`Link`] and [`Joint`](caudata_model::Joint); vectors m, quaternions w x y z.
#[derive(Debug, Serialize)]
pub struct RobotScene {
    links: Vec<LinkScene>,
    joints: Vec<JointScene>,
    /// Joint of each policy index.
    actuated: Vec<usize>,
    /// Feet in policy order.
    feet: Vec<FootScene>,
}

#[derive(Debug, Serialize)]
struct LinkScene {
    name: String,
    parent: Option<usize>,
    pos_m: [f64; 3],
    quat: [f64; 4],
    joints: Vec<usize>,
    /// `body` or `leg`.
    part: &'static str,
    /// Links between it and the base.
    depth: usize,
    geoms: Vec<GeomScene>,
}

#[derive(Debug, Serialize)]
struct GeomScene {
    /// `sphere`, `capsule`, `cylinder`, `box` or `ellipsoid`.
    kind: &'static str,
    /// Radius, half length (capsule, cylinder), half edges or semi-axes, m.
    size_m: Vec<f64>,
    pos_m: [f64; 3],
    quat: [f64; 4],
    foot: Option<usize>,
}

#[derive(Debug, Serialize)]
struct JointScene {
    name: String,
    hinge: bool,
    axis: [f64; 3],
    anchor_m: [f64; 3],
}

#[derive(Debug, Serialize)]
struct FootScene {
    name: String,
    link: usize,
    centre_m: [f64; 3],
    radius_m: f64,
}

impl RobotScene {
    /// The shapes that are to be looked at: shells ([`has_shell`]) and feet; a link without shells shows all it has.
    pub fn of(model: &RobotModel) -> Self {
        let links = model.links().iter().enumerate();
        Self {
            links: links.map(|(l, link)| link_scene(model, l, link)).collect(),
            joints: model
                .joints()
                .iter()
                .map(|j| JointScene {
                    name: j.name.clone(),
                    hinge: j.motion == JointMotion::Hinge,
                    axis: j.axis,
                    anchor_m: j.anchor_m,
                })
                .collect(),
            actuated: model.actuated().to_vec(),
            feet: model
                .feet()
                .iter()
                .map(|f| FootScene {
                    name: f.name.clone(),
                    link: f.link,
                    centre_m: f.centre_m,
                    radius_m: f.radius_m(),
                })
                .collect(),
        }
    }
}

fn link_scene(model: &RobotModel, index: usize, link: &Link) -> LinkScene {
    let has_shell = has_shell(&link.geoms);
    let geoms = link.geoms.iter().enumerate().filter_map(|(g, geom)| {
        let foot = model.foot_of(index, g);
        let shown = foot.is_some() || !has_shell || !geom.collides();
        shown.then(|| geom_scene(geom, foot)).flatten()
    });
    let up = |l: usize| model.links()[l].parent;
    LinkScene {
        name: link.name.clone(),
        parent: link.parent,
        pos_m: link.parent_from_link.pos_m,
        quat: link.parent_from_link.quat_wxyz,
        joints: link.joints.clone(),
        part: if model.leg_of(index).is_some() { "leg" } else { "body" },
        depth: std::iter::successors(link.parent, |&l| up(l)).count(),
        geoms: geoms.collect(),
    }
}

fn geom_scene(geom: &Geom, foot: Option<usize>) -> Option<GeomScene> {
    let (kind, size_m) = geom.shape.mjcf()?;
    let Pose { pos_m, quat_wxyz } = geom.link_from_geom;
    Some(GeomScene { kind, size_m, pos_m, quat: quat_wxyz, foot })
}

/// The ground around a film.
#[derive(Debug, Serialize)]
pub struct GroundScene {
    /// Height of the water's surface, m.
    water_m: Option<f32>,
    /// `None`: the plane z = 0.
    grid: Option<GridScene>,
}

/// Heights on a grid: rows along y, columns along x.
#[derive(Debug, Serialize)]
struct GridScene {
    x0_m: f64,
    y0_m: f64,
    cell_m: f64,
    columns: usize,
    heights_m: Packed,
}

impl GroundScene {
    /// The ground within [`MARGIN_M`] of a way through these world points, m; all of it for none.
    pub fn around(terrain: &Terrain, way_m: &[[f32; 3]]) -> Self {
        Self {
            water_m: terrain.water_level_m,
            grid: terrain.grid().map(|grid| {
                let way = |axis: usize| way_m.iter().map(move |at| at[axis]);
                let half = grid.size_m() / 2.0;
                let index = |x: f64| {
                    let at = (x + half) / grid.cell_m;
                    at.round().clamp(0.0, (grid.points() - 1) as f64) as usize
                };
                let range = |axis: usize| {
                    if way_m.is_empty() {
                        return [0, grid.points() - 1];
                    }
                    let least = way(axis).fold(f32::INFINITY, f32::min);
                    let most = way(axis).fold(f32::NEG_INFINITY, f32::max);
                    [index(f64::from(least) - MARGIN_M), index(f64::from(most) + MARGIN_M)]
                };
                let ([x0, x1], [y0, y1]) = (range(0), range(1));
                let thin = (x1 - x0).max(y1 - y0).div_ceil(MOST_POINTS).max(1);
                let row = |iy: usize| -> Vec<f32> {
                    (x0..=x1).step_by(thin).map(|ix| grid.at(ix, iy)).collect()
                };
                let rows: Vec<Vec<f32>> = (y0..=y1).step_by(thin).map(row).collect();
                GridScene {
                    x0_m: x0 as f64 * grid.cell_m - half,
                    y0_m: y0 as f64 * grid.cell_m - half,
                    cell_m: grid.cell_m * thin as f64,
                    columns: rows.first().map_or(0, Vec::len),
                    heights_m: flat_column(&rows),
                }
            }),
        }
    }
}

/// All heights as one column: they share one resolution.
fn flat_column(rows: &[Vec<f32>]) -> Packed {
    let column: Vec<Vec<f32>> = rows.iter().flatten().map(|&h| vec![h]).collect();
    Packed::of(&column)
}
