//! Turns a scene into pixels.

use std::sync::{Mutex, PoisonError};

use crate::camera::Camera;
use crate::error::RenderError;
use crate::image::Image;
use crate::light;
use crate::scene::Scene;
use crate::solid::Ray;
use crate::vector::scale;
use caudata_model::pose::add;

/// Size and smoothness of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quality {
    /// Pixels across, 16 to 4096.
    pub width: u32,
    /// Pixels down, 16 to 4096.
    pub height: u32,
    /// Rays per pixel along each edge, 1 to 4; more smooths edges.
    pub rays: u32,
    /// Threads; they do not change the picture.
    pub threads: usize,
}

/// Makes the picture.
///
/// # Errors
/// [`RenderError::Setting`] where a size is out of range.
pub fn render(scene: &Scene, camera: &Camera, quality: &Quality) -> Result<Image, RenderError> {
    let Quality { width, height, rays, threads } = *quality;
    if !(1..=4).contains(&rays) {
        let reason = "must be 1 to 4 per pixel and edge";
        return Err(RenderError::setting("rays", rays, reason));
    }
    let mut image = Image::new(width, height)?;
    let pixel_rad = camera.pixel_rad(height);
    let paint = |row: usize, out: &mut [u8]| {
        for (column, pixel) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let mut sum = [0.0; 3];
            for k in 0..rays * rays {
                let offset = |i: u32| (f64::from(i) + 0.5) / f64::from(rays);
                let (x, y) = (column as f64 + offset(k % rays), row as f64 + offset(k / rays));
                let ray = Ray { from: camera.eye_m, along: camera.direction(x, y, width, height) };
                sum = add(sum, light::along(scene, &ray, pixel_rad));
            }
            *pixel = scale(sum, 1.0 / f64::from(rays * rays)).map(srgb);
        }
    };
    // Each thread takes the next row: those with a robot in them take longest.
    let rows = Mutex::new(image.rgb.chunks_mut(width as usize * 3).enumerate());
    let next = || rows.lock().unwrap_or_else(PoisonError::into_inner).next();
    let work = || {
        while let Some((number, row)) = next() {
            paint(number, row);
        }
    };
    std::thread::scope(|scope| {
        for _ in 1..threads.clamp(1, 64) {
            scope.spawn(work);
        }
        work();
    });
    Ok(image)
}

/// A linear channel as an sRGB byte; bright light is rounded off softly.
fn srgb(linear: f64) -> u8 {
    let soft = if linear > 0.7 {
        0.7 + 0.3 * (1.0 - (-(linear - 0.7) / 0.3).exp())
    } else {
        linear.max(0.0)
    };
    let encoded =
        if soft <= 0.003_130_8 { 12.92 * soft } else { 1.055 * soft.powf(1.0 / 2.4) - 0.055 };
    (encoded.clamp(0.0, 1.0) * 255.0).round() as u8
}
