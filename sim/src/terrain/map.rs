//! Ground from a file: a picture (PNG, grey) or a table of heights (CSV).

use std::path::Path;

use crate::SimError;

/// Largest file, bytes.
const FILE_BYTES_MAX: u64 = 64 << 20;
/// Fewest and most points along an edge.
const POINTS: std::ops::RangeInclusive<usize> = 2..=2048;

/// A square of heights as the file has them: `points` rows of `points`, the first row farthest to the left of
/// the robot (largest y), each row from small to large x.
#[derive(Debug)]
pub(super) struct HeightMap {
    points: usize,
    heights_m: Vec<f64>,
}

impl HeightMap {
    /// Reads a file; black of a picture is 0 and white `white_m`, a table is in metres. The lowest point is
    /// then put at 0.
    pub fn read(file: &Path, white_m: f64) -> Result<Self, SimError> {
        let wrong = |reason: String| SimError::Map { file: file.display().to_string(), reason };
        let size = std::fs::metadata(file).map_err(|e| wrong(e.to_string()))?.len();
        if size > FILE_BYTES_MAX {
            return Err(wrong(format!("is larger than {} MiB", FILE_BYTES_MAX >> 20)));
        }
        let bytes = std::fs::read(file).map_err(|e| wrong(e.to_string()))?;
        let rows = match file.extension().and_then(|e| e.to_str()) {
            Some("png") => picture(&bytes, white_m),
            Some("csv") => table(&bytes),
            _ => Err("must end in .png or .csv".to_owned()),
        };
        Self::of(rows.map_err(&wrong)?).map_err(wrong)
    }

    fn of(rows: Vec<Vec<f64>>) -> Result<Self, String> {
        let points = rows.len();
        if !POINTS.contains(&points) || rows.iter().any(|row| row.len() != points) {
            let widths: Vec<usize> = rows.iter().map(Vec::len).collect();
            let (least, most) = (widths.iter().min(), widths.iter().max());
            return Err(format!(
                "has {points} rows of {} to {} values; it must be a square of 2 to 2048",
                least.unwrap_or(&0),
                most.unwrap_or(&0)
            ));
        }
        let mut heights_m = rows.concat();
        if heights_m.iter().any(|h| !h.is_finite() || h.abs() > 1e3) {
            return Err("has a height that is not a number within ±1000 m".to_owned());
        }
        let lowest = heights_m.iter().copied().fold(f64::INFINITY, f64::min);
        heights_m.iter_mut().for_each(|h| *h -= lowest);
        Ok(Self { points, heights_m })
    }

    /// Height at a place, `across` and `up` being 0 to 1 from the smallest to the largest x and y.
    pub fn at(&self, across: f64, up: f64) -> f64 {
        let last = self.points - 1;
        let place = |share: f64| {
            let at = share.clamp(0.0, 1.0) * last as f64;
            let cell = (at as usize).min(last - 1);
            (cell, at - cell as f64)
        };
        let ((x, u), (row, v)) = (place(across), place(1.0 - up));
        let h = |dx: usize, dy: usize| self.heights_m[(row + dy) * self.points + x + dx];
        (1.0 - v) * ((1.0 - u) * h(0, 0) + u * h(1, 0)) + v * ((1.0 - u) * h(0, 1) + u * h(1, 1))
    }
}

fn table(bytes: &[u8]) -> Result<Vec<Vec<f64>>, String> {
    let text = std::str::from_utf8(bytes).map_err(|_| "is not UTF-8".to_owned())?;
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    lines
        .map(|(number, line)| {
            let values = line.split([',', ';']).map(|cell| cell.trim().parse::<f64>());
            let values: Result<_, _> = values.collect();
            values.map_err(|_| format!("has a cell in line {} that is no number", number + 1))
        })
        .collect()
}

fn picture(bytes: &[u8], white_m: f64) -> Result<Vec<Vec<f64>>, String> {
    let mut decoder = png::Decoder::new(std::io::Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(|e| e.to_string())?;
    let size = reader.output_buffer_size().ok_or("is too large")?;
    if size as u64 > FILE_BYTES_MAX {
        return Err("is too large".to_owned());
    }
    let mut pixels = vec![0; size];
    let info = reader.next_frame(&mut pixels).map_err(|e| e.to_string())?;
    let wide = match info.bit_depth {
        png::BitDepth::Sixteen => 2,
        _ => 1,
    };
    let channels = info.color_type.samples();
    if !matches!(info.color_type, png::ColorType::Grayscale | png::ColorType::GrayscaleAlpha) {
        return Err("is coloured; heights are shades of grey".to_owned());
    }
    let grey = |pixel: &[u8]| match wide {
        2 => f64::from(u16::from_be_bytes([pixel[0], pixel[1]])) / 65_535.0,
        _ => f64::from(pixel[0]) / 255.0,
    };
    let rows = pixels.chunks_exact(info.line_size).take(info.height as usize);
    let row = |row: &[u8]| {
        let pixels = row.chunks_exact(channels * wide).take(info.width as usize);
        pixels.map(|pixel| white_m * grey(pixel)).collect()
    };
    Ok(rows.map(row).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(name: &str, bytes: &[u8]) -> (tempfile::TempDir, std::path::PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        (folder, path)
    }

    #[test]
    fn a_table_lies_as_it_is_written() {
        let (_folder, path) = file("ground.csv", b"1.0, 1.5\n1.1; 2.0\n");
        let map = HeightMap::read(&path, 0.0).unwrap();
        // the lowest, 1.0, is at 0; the first line is the one with the largest y
        for ((across, up), height) in [
            ((0.0, 1.0), 0.0),
            ((1.0, 1.0), 0.5),
            ((0.0, 0.0), 0.1),
            ((1.0, 0.0), 1.0),
            ((0.5, 0.5), 0.4),
        ] {
            assert!((map.at(across, up) - height).abs() < 1e-12, "{across} {up}");
        }
    }

    #[test]
    fn white_of_a_picture_is_as_high_as_is_said() {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, 2, 2);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(&[0, 255, 51, 102]).unwrap();
        writer.finish().unwrap();
        let (_folder, path) = file("ground.png", &bytes);
        let map = HeightMap::read(&path, 0.2).unwrap();
        assert!((map.at(1.0, 1.0) - 0.2).abs() < 1e-12);
        // 51/255 = 0.2
        assert!((map.at(0.0, 0.0) - 0.04).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_square_of_heights_is_refused() {
        for (name, bytes, reason) in [
            ("a.csv", &b"1,2\n3"[..], "rows of 1 to 2"),
            ("a.csv", b"1,x\n2,3", "line 1"),
            ("a.csv", b"1,nan\n2,3", "not a number"),
            ("a.png", b"no picture", "png"),
            ("a.txt", b"", ".png or .csv"),
        ] {
            let (_folder, path) = file(name, bytes);
            let error = HeightMap::read(&path, 0.1).unwrap_err().to_string().to_lowercase();
            assert!(error.contains(reason), "{error}");
        }
    }
}
