//! PNG and GIF bytes.

use crate::error::RenderError;
use crate::image::Image;

/// Longest animation, frames: a minute at 50 per second.
const MAX_FRAMES: usize = 3000;

fn failed(error: impl std::fmt::Display) -> RenderError {
    RenderError::Encode(error.to_string())
}

/// One picture as PNG.
///
/// # Errors
/// [`RenderError::Encode`].
pub fn png(image: &Image) -> Result<Vec<u8>, RenderError> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, image.width(), image.height());
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(image.rgb()).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

/// Pictures of one size as an endless animated GIF, `frame_s` each (rounded to hundredths of a second; many
/// viewers show less than 0.02 s slower). Every frame has its own palette of 256 colours.
///
/// # Errors
/// [`RenderError`] where there is no frame, there are too many, or their sizes differ.
pub fn gif(frames: &[Image], frame_s: f64) -> Result<Vec<u8>, RenderError> {
    let Some(first) = frames.first().filter(|_| frames.len() <= MAX_FRAMES) else {
        let count = frames.len();
        return Err(RenderError::setting("frames", count, "must be 1 to 3000"));
    };
    if !(0.01..=10.0).contains(&frame_s) {
        let reason = "must be 0.01 to 10 s";
        return Err(RenderError::setting("frame time", frame_s, reason));
    }
    let edge = |n: u32| u16::try_from(n).map_err(failed);
    let (width, height) = (edge(first.width())?, edge(first.height())?);
    let mut bytes = Vec::new();
    let mut encoder = gif::Encoder::new(&mut bytes, width, height, &[]).map_err(failed)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
    for image in frames {
        if (image.width(), image.height()) != (first.width(), first.height()) {
            let size = format!("{} × {}", image.width(), image.height());
            let reason = "all frames must be alike";
            return Err(RenderError::setting("frame size", size, reason));
        }
        // 10: the encoder's own balance of palette quality (1, slow) and speed (30)
        let mut frame = gif::Frame::from_rgb_speed(width, height, image.rgb(), 10);
        frame.delay = (frame_s * 100.0).round() as u16;
        encoder.write_frame(&frame).map_err(failed)?;
    }
    drop(encoder);
    Ok(bytes)
}
