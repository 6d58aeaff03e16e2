//! Sun, sky, shadow, water.

use caudata_model::pose::{add, dot};

use crate::ground;
use crate::scene::Scene;
use crate::solid::Ray;
use crate::vector::{Vec3, mix, scale, unit};

/// Towards the sun: high, from the front right.
const SUN: Vec3 = [0.371_390_7, -0.472_679_1, 0.799_110_1];
const SUNLIGHT: Vec3 = [1.55, 1.48, 1.36];
const SKYLIGHT: Vec3 = [0.46, 0.52, 0.60];
const HORIZON: Vec3 = [0.68, 0.76, 0.84];
const ZENITH: Vec3 = [0.30, 0.48, 0.74];
/// Distance at which the ground has half become haze, m.
const HAZE_M: f64 = 28.0;

/// Water: what it looks like where it is deep, how fast it swallows light per m (red first).
const DEEP: Vec3 = [0.015, 0.16, 0.22];
const SWALLOWS_PER_M: Vec3 = [1.5, 0.55, 0.40];

/// Colour of the sky along a direction.
pub(crate) fn sky(along: Vec3) -> Vec3 {
    mix(HORIZON, ZENITH, along[2].max(0.0).sqrt())
}

/// What a ray sees, linear RGB. `pixel_rad`: size of the pixel at distance 1.
pub(crate) fn along(scene: &Scene, ray: &Ray, pixel_rad: f64) -> Vec3 {
    const FAR_M: f64 = 500.0;
    let ground = ground::meet(&scene.ground, ray, FAR_M);
    let far = ground.map_or(FAR_M, |hit| hit.t);
    let solid = scene.meet_solids(ray, far);
    let (seen, distance) = match (solid, ground) {
        (Some((hit, colour)), _) => {
            let at = ray.at(hit.t);
            (lit(scene, at, hit.normal, colour, Some(ray.along)), hit.t)
        }
        (None, Some(hit)) => {
            let slant = dot(hit.normal, ray.along).abs().max(0.08);
            let footprint = hit.t * pixel_rad / slant;
            let colour = ground::colour(&scene.ground, ray.at(hit.t), footprint);
            let colour = lit(scene, ray.at(hit.t), hit.normal, colour, None);
            (colour, hit.t)
        }
        (None, None) => (sky(ray.along), FAR_M),
    };
    let wet = water(scene, ray, seen, distance);
    let (colour, reach) = wet.unwrap_or((seen, distance));
    let haze = 1.0 - (-(reach / HAZE_M).powi(2) * std::f64::consts::LN_2).exp();
    mix(colour, sky([ray.along[0], ray.along[1], 0.0]), haze)
}

/// Colour of a surface under sun and sky; `towards`: viewing direction, for surfaces that shine.
fn lit(scene: &Scene, at: Vec3, normal: Vec3, colour: Vec3, towards: Option<Vec3>) -> Vec3 {
    let from = add(at, scale(normal, 1e-4));
    let shaded = |along: Vec3, far: f64| scene.is_blocked(&Ray { from, along }, far);
    let facing = dot(normal, SUN).max(0.0);
    let sun = if facing > 0.0 && !shaded(SUN, 1e3) { facing } else { 0.0 };
    let open = openness(scene, from, normal);
    let upward = 0.55 + 0.45 * normal[2];
    let light = [0, 1, 2].map(|i| SUNLIGHT[i] * sun + SKYLIGHT[i] * upward * open);
    let mut out = [0, 1, 2].map(|i| colour[i] * light[i]);
    if let Some(along) = towards
        && sun > 0.0
    {
        let half = unit(add(SUN, scale(along, -1.0)));
        let shine = 0.25 * dot(half, normal).max(0.0).powi(40);
        out = out.map(|c| c + shine);
    }
    out
}

/// Share of the sky that nothing nearby hides, from ten directions.
fn openness(scene: &Scene, from: Vec3, normal: Vec3) -> f64 {
    const REACH_M: f64 = 0.25;
    const RAYS: usize = 10;
    if scene.distance_to_solids(from) > REACH_M {
        return 1.0;
    }
    let side = if normal[2].abs() < 0.9 { [0.0, 0.0, 1.0] } else { [1.0, 0.0, 0.0] };
    let a = unit(caudata_model::pose::cross(side, normal));
    let b = caudata_model::pose::cross(normal, a);
    let hidden: f64 = (0..RAYS)
        .map(|k| {
            let angle = std::f64::consts::TAU * (k as f64 + 0.25) / RAYS as f64;
            let rise = if k % 2 == 0 { 0.45 } else { 1.3 };
            let flat = add(scale(a, angle.cos()), scale(b, angle.sin()));
            let along = unit(add(flat, scale(normal, rise)));
            // what is nearer hides more, so that the shade has no edges
            let met = scene.meet_solids(&Ray { from, along }, REACH_M);
            met.map_or(0.0, |(hit, _)| 1.0 - hit.t / REACH_M)
        })
        .sum();
    1.0 - 0.9 * hidden / RAYS as f64
}

/// What is `seen` at `distance`, through the water in between; also how far away the haze begins to count.
/// `None`: no water in between.
fn water(scene: &Scene, ray: &Ray, seen: Vec3, distance: f64) -> Option<(Vec3, f64)> {
    let level = f64::from(scene.ground.terrain.water_level_m?);
    let surface = ground::plane(ray, level, distance).map(|hit| hit.t);
    let under = ray.from[2] < level;
    let path = match (under, surface) {
        (true, None) => distance,
        (true, Some(t)) => t,
        (false, None) => return None,
        (false, Some(t)) => distance - t,
    };
    let through = SWALLOWS_PER_M.map(|k| (-k * path).exp());
    let dim = [0, 1, 2].map(|i| seen[i] * through[i] + DEEP[i] * (1.0 - through[i]));
    let Some(t) = surface.filter(|_| !under) else { return Some((dim, 0.0)) };
    let normal = ripple(ray.at(t), scene.time_s, t);
    let cos = -dot(normal, ray.along);
    let mirrored = add(ray.along, scale(normal, 2.0 * cos));
    let fresnel = 0.02 + 0.98 * (1.0 - cos.clamp(0.0, 1.0)).powi(5);
    let glint = 1.2 * dot(mirrored, SUN).max(0.0).powi(180);
    let image = sky(mirrored).map(|c| c + glint);
    Some((mix(dim, image, fresnel.max(0.06)), t))
}

/// Normal of the water's surface: a few small waves, calmer with distance so that they do not flicker.
fn ripple(at: Vec3, time_s: f64, distance: f64) -> Vec3 {
    const WAVES: [[f64; 4]; 3] =
        [[9.0, 4.0, 3.1, 0.018], [-6.0, 11.0, 4.3, 0.014], [17.0, -13.0, 6.0, 0.010]];
    let calm = 1.0 / (1.0 + (distance / 4.0).powi(2));
    let (mut sx, mut sy) = (0.0, 0.0);
    for [kx, ky, rate, slope] in WAVES {
        let wave = slope * calm * (kx * at[0] + ky * at[1] + rate * time_s).cos();
        let k = f64::hypot(kx, ky);
        sx += wave * kx / k;
        sy += wave * ky / k;
    }
    unit([-sx, -sy, 1.0])
}
