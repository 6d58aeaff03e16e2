//! Where the picture is taken from.

use caudata_model::pose::{add, cross, sub};

use crate::error::RenderError;
use crate::vector::{Vec3, scale, unit};

/// Named directions, relative to the robot's heading.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum View {
    /// From ahead, left and above.
    Iso,
    /// From the left.
    Side,
    /// From ahead.
    Front,
    /// From above.
    Top,
}

impl View {
    /// Azimuth from the heading (towards the left) and elevation of the camera, rad.
    fn angles_rad(self) -> (f64, f64) {
        let (azimuth_deg, elevation_deg): (f64, f64) = match self {
            Self::Iso => (50.0, 26.0),
            Self::Side => (90.0, 8.0),
            Self::Front => (0.0, 12.0),
            Self::Top => (90.0, 89.0),
        };
        (azimuth_deg.to_radians(), elevation_deg.to_radians())
    }
}

/// Half of the vertical field of view, 18°.
const HALF_VIEW_RAD: f64 = 0.1 * std::f64::consts::PI;

/// A pinhole camera; z of the world is up in the picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Where the camera is, world, m.
    pub eye_m: Vec3,
    forward: Vec3,
    right: Vec3,
    up: Vec3,
    /// Half the height of the picture at distance 1.
    half_height: f64,
}

impl Camera {
    /// At `distance_m` from `target_m`, seen from `azimuth_rad` (from world +x towards +y) and
    /// `elevation_rad` above the horizon, with a vertical field of view of 36°.
    ///
    /// # Errors
    /// [`RenderError::Setting`] where the distance is not 0.1 to 200 m, the elevation beyond ±89.9°, or
    /// something not finite.
    pub fn orbit(
        target_m: Vec3,
        distance_m: f64,
        azimuth_rad: f64,
        elevation_rad: f64,
    ) -> Result<Self, RenderError> {
        let check = |what, value: f64, good: bool, reason| {
            if good {
                return Ok(());
            }
            Err(RenderError::setting(what, value, reason))
        };
        let near = (0.1..=200.0).contains(&distance_m);
        check("camera distance", distance_m, near, "must be 0.1 to 200 m")?;
        let upright = elevation_rad.abs() <= 89.9f64.to_radians();
        check("camera elevation", elevation_rad, upright, "must be within ±1.569 rad (89.9°)")?;
        check("camera azimuth", azimuth_rad, azimuth_rad.is_finite(), "must be finite")?;
        for x in target_m {
            check("camera target", x, x.is_finite(), "must be finite")?;
        }
        let (sin_a, cos_a) = azimuth_rad.sin_cos();
        let (sin_e, cos_e) = elevation_rad.sin_cos();
        let away = [cos_a * cos_e, sin_a * cos_e, sin_e];
        let forward = scale(away, -1.0);
        let right = unit(cross(forward, [0.0, 0.0, 1.0]));
        Ok(Self {
            eye_m: add(target_m, scale(away, distance_m)),
            forward,
            right,
            up: cross(right, forward),
            half_height: HALF_VIEW_RAD.tan(),
        })
    }

    /// A named view of something at `target_m` that looks along `heading_rad`.
    ///
    /// # Errors
    /// As [`Camera::orbit`].
    pub fn of_view(
        view: View,
        target_m: Vec3,
        heading_rad: f64,
        distance_m: f64,
    ) -> Result<Self, RenderError> {
        let (azimuth, elevation) = view.angles_rad();
        Self::orbit(target_m, distance_m, heading_rad + azimuth, elevation)
    }

    /// How far away from its target a view has what reaches so far to the sides, and up or down, in a picture
    /// `aspect` times as wide as high, whichever way it is turned, m.
    pub fn far_enough_m(view: View, [aside_m, up_m]: [f64; 2], aspect: f64) -> f64 {
        let (sin, cos) = view.angles_rad().1.sin_cos();
        let half = HALF_VIEW_RAD.tan();
        let high_m = (up_m * cos + aside_m * sin) / half;
        let wide_m = aside_m / (aspect * half);
        // its near side is so much nearer than the target
        let near_m = aside_m * cos + up_m * sin;
        (high_m.max(wide_m) + near_m).clamp(0.1, 200.0)
    }

    /// Unit direction through `(x, y)` of a picture of `width × height` pixels, from its upper left corner;
    /// whole numbers are pixels' corners.
    pub fn direction(&self, x: f64, y: f64, width: u32, height: u32) -> Vec3 {
        let per_pixel = self.pixel_rad(height);
        let across = (x - f64::from(width) / 2.0) * per_pixel;
        let upward = (f64::from(height) / 2.0 - y) * per_pixel;
        let sideways = add(scale(self.right, across), scale(self.up, upward));
        unit(add(self.forward, sideways))
    }

    /// Size of a pixel at distance 1.
    pub(crate) fn pixel_rad(&self, height: u32) -> f64 {
        2.0 * self.half_height / f64::from(height)
    }

    /// Column and row (from the upper left corner, fractions count) at which a point of the world appears;
    /// `None` behind the camera.
    pub fn project(&self, point_m: Vec3, width: u32, height: u32) -> Option<[f64; 2]> {
        let to = sub(point_m, self.eye_m);
        let along = |axis: Vec3| caudata_model::pose::dot(to, axis);
        let depth = along(self.forward);
        if depth <= 0.0 {
            return None;
        }
        let per_pixel = self.pixel_rad(height) * depth;
        Some([
            f64::from(width) / 2.0 + along(self.right) / per_pixel,
            f64::from(height) / 2.0 - along(self.up) / per_pixel,
        ])
    }
}
