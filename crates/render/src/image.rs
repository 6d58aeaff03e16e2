//! Pixels, and text on them.

use crate::error::RenderError;
use crate::font;

/// Largest edge of a picture, pixels.
const MAX_EDGE: u32 = 4096;

/// An RGB picture, 8 bits per channel, sRGB, rows from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    width: u32,
    height: u32,
    pub(crate) rgb: Vec<u8>,
}

impl Image {
    /// A black picture.
    ///
    /// # Errors
    /// [`RenderError::Setting`] where an edge is not 16 to 4096 pixels.
    pub fn new(width: u32, height: u32) -> Result<Self, RenderError> {
        for (what, value) in [("width", width), ("height", height)] {
            if !(16..=MAX_EDGE).contains(&value) {
                let reason = "must be 16 to 4096 pixels";
                return Err(RenderError::setting(what, value, reason));
            }
        }
        Ok(Self { width, height, rgb: vec![0; width as usize * height as usize * 3] })
    }

    /// Width, pixels.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height, pixels.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// All bytes, `[height, width, 3]`.
    pub fn rgb(&self) -> &[u8] {
        &self.rgb
    }

    /// Where the bytes of a pixel begin.
    fn place(&self, x: u32, y: u32) -> Option<usize> {
        let inside = x < self.width && y < self.height;
        inside.then(|| 3 * (y as usize * self.width as usize + x as usize))
    }

    /// The pixel in column `x`, row `y` from the top; black outside.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let at = self.place(x, y);
        at.map_or([0; 3], |at| [0, 1, 2].map(|i| self.rgb[at + i]))
    }

    /// Writes one line of text on a dark strip along the lower edge. Characters that the font lacks become
    /// blanks; what does not fit is cut.
    pub fn caption(&mut self, text: &str) {
        let zoom = (self.width / 400).max(1);
        let strip = (font::HEIGHT + 4) * zoom;
        for y in self.height.saturating_sub(strip)..self.height {
            for x in 0..self.width {
                self.blend(x, y, [12, 16, 22], 0.62);
            }
        }
        let top = self.height.saturating_sub(strip) + 2 * zoom;
        for (i, c) in text.chars().enumerate() {
            let left = (3 + i as u32 * (font::WIDTH + 1)) * zoom;
            let rows = font::glyph(c);
            for y in 0..font::HEIGHT * zoom {
                for x in 0..font::WIDTH * zoom {
                    let bit = font::WIDTH - 1 - x / zoom;
                    if rows[(y / zoom) as usize] >> bit & 1 == 1 {
                        self.blend(left + x, top + y, [235, 240, 245], 1.0);
                    }
                }
            }
        }
    }

    fn blend(&mut self, x: u32, y: u32, colour: [u8; 3], share: f64) {
        let Some(at) = self.place(x, y) else { return };
        for (old, new) in self.rgb[at..at + 3].iter_mut().zip(colour) {
            let mixed = f64::from(*old) * (1.0 - share) + f64::from(new) * share;
            *old = mixed.round() as u8;
        }
    }
}
