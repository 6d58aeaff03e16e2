//! Pictures as inline SVG: axes, curves, bands, points. Colours are the page's CSS variables, so that a picture follows light and dark.

use std::fmt::Write;

/// Most points of one curve: more cannot be seen and make the page heavy.
const MOST_POINTS: usize = 900;

/// Text made safe for HTML and SVG.
#[must_use]
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c if c.is_control() && c != '\n' => {}
            c => out.push(c),
        }
    }
    out
}

/// A number in three significant digits, without a trail of zeros.
#[must_use]
pub fn number(x: f64) -> String {
    if !x.is_finite() {
        return "–".to_owned();
    }
    let size = x.abs();
    if size == 0.0 {
        return "0".to_owned();
    }
    if !(1e-4..1e6).contains(&size) {
        let text = format!("{x:.2e}");
        return match text.split_once('e') {
            Some((digits, power)) => format!("{digits}·10{}", superscript(power)),
            None => text,
        };
    }
    let decimals = (2 - size.log10().floor() as i32).clamp(0, 7) as usize;
    let text = format!("{x:.decimals$}");
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text
    }
}

fn superscript(power: &str) -> String {
    power
        .chars()
        .filter_map(|c| match c {
            '-' => Some('⁻'),
            '0' => Some('⁰'),
            '1' => Some('¹'),
            '2' => Some('²'),
            '3' => Some('³'),
            '4' => Some('⁴'),
            '5' => Some('⁵'),
            '6' => Some('⁶'),
            '7' => Some('⁷'),
            '8' => Some('⁸'),
            '9' => Some('⁹'),
            _ => None,
        })
        .collect()
}

/// An axis: its range, and whether it is logarithmic.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    low: f64,
    high: f64,
    log: bool,
}

impl Axis {
    /// A linear axis over all finite `values`, with a margin; a flat one gets some height.
    pub fn over(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = extent(values);
        let span = high - low;
        let margin = if span > 0.0 {
            0.06 * span
        } else {
            low.abs().max(1e-6) * 0.1
        };
        Self {
            low: low - margin,
            high: high + margin,
            log: false,
        }
    }

    /// A linear axis over exactly this span (of time).
    pub fn exact(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = extent(values);
        let high = if high > low { high } else { low + 1.0 };
        Self {
            low,
            high,
            log: false,
        }
    }

    /// A logarithmic axis over the positive `values`.
    pub fn log_over(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = extent(values.filter(|x| *x > 0.0));
        let (low, high) = if low > 0.0 { (low, high) } else { (0.1, 1.0) };
        Self {
            low: low / 1.25,
            high: high * 1.25,
            log: true,
        }
    }

    /// Makes sure that `x` is inside.
    pub fn with(mut self, x: f64) -> Self {
        self.low = self.low.min(x);
        self.high = self.high.max(x);
        self
    }

    /// 0 at the low end, 1 at the high end.
    pub fn place(&self, x: f64) -> f64 {
        if self.log {
            (x.max(1e-300) / self.low).ln() / (self.high / self.low).ln()
        } else {
            (x - self.low) / (self.high - self.low)
        }
    }

    /// Round places for marks.
    pub fn ticks(&self, about: usize) -> Vec<f64> {
        if self.log {
            let mut out = Vec::new();
            let mut decade = 10f64.powf(self.low.log10().floor());
            while decade <= self.high && out.len() < 40 {
                let steps: &[f64] = if self.high / self.low < 120.0 {
                    &[1.0, 2.0, 5.0]
                } else {
                    &[1.0]
                };
                out.extend(
                    steps
                        .iter()
                        .map(|m| m * decade)
                        .filter(|x| (self.low..=self.high).contains(x)),
                );
                decade *= 10.0;
            }
            return out;
        }
        let raw = (self.high - self.low) / about.max(1) as f64;
        let unit = 10f64.powf(raw.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0]
            .into_iter()
            .map(|m| m * unit)
            .find(|s| *s >= raw)
            .unwrap_or(raw);
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step).floor() as i64;
        (first..=last.min(first + 20))
            .map(|k| k as f64 * step)
            .collect()
    }
}

fn extent(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values
        .filter(|x| x.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| {
            (l.min(x), h.max(x))
        });
    if low <= high { (low, high) } else { (0.0, 1.0) }
}

/// A picture with two axes.
pub struct Chart {
    width: f64,
    height: f64,
    left: f64,
    x: Axis,
    y: Axis,
    body: String,
    title: String,
    about: String,
}

const TOP: f64 = 10.0;
const RIGHT: f64 = 12.0;
const BOTTOM: f64 = 40.0;

impl Chart {
    /// An empty chart. `about`: what it shows, for those who do not see it.
    pub fn new(size: (f64, f64), x: Axis, y: Axis, title: &str, about: &str) -> Self {
        let mut chart = Self {
            width: size.0,
            height: size.1,
            left: 58.0,
            x,
            y,
            body: String::new(),
            title: escape(title),
            about: escape(about),
        };
        chart.grid();
        chart
    }

    fn px(&self, x: f64) -> f64 {
        self.left + self.x.place(x) * (self.width - self.left - RIGHT)
    }

    fn py(&self, y: f64) -> f64 {
        self.height - BOTTOM - self.y.place(y) * (self.height - TOP - BOTTOM)
    }

    fn grid(&mut self) {
        let (low, high) = (self.height - BOTTOM, TOP);
        let about_x = ((self.width / 90.0) as usize).max(3);
        for t in self.x.ticks(about_x) {
            let x = self.px(t);
            let _ = write!(
                self.body,
                r#"<line class="g" x1="{x:.1}" x2="{x:.1}" y1="{low:.1}" y2="{high:.1}"/><text class="t" x="{x:.1}" y="{:.1}" text-anchor="middle">{}</text>"#,
                low + 15.0,
                number(t)
            );
        }
        for t in self.y.ticks(5) {
            let y = self.py(t);
            let _ = write!(
                self.body,
                r#"<line class="g" x1="{:.1}" x2="{:.1}" y1="{y:.1}" y2="{y:.1}"/><text class="t" x="{:.1}" y="{:.1}" text-anchor="end">{}</text>"#,
                self.left,
                self.width - RIGHT,
                self.left - 6.0,
                y + 3.5,
                number(t)
            );
        }
    }

    /// Labels of the axes, with units.
    pub fn labels(&mut self, x: &str, y: &str) {
        let middle = self.left + 0.5 * (self.width - self.left - RIGHT);
        let high = TOP + 0.5 * (self.height - TOP - BOTTOM);
        let _ = write!(
            self.body,
            r#"<text class="l" x="{middle:.1}" y="{:.1}" text-anchor="middle">{}</text><text class="l" transform="translate(12 {high:.1}) rotate(-90)" text-anchor="middle">{}</text>"#,
            self.height - 6.0,
            escape(x),
            escape(y)
        );
    }

    /// A curve of class `class`; it breaks where a value is missing.
    pub fn line(&mut self, class: &str, x: &[f64], y: &[f64]) {
        let path = self.path(&thin(x, y));
        let _ = write!(self.body, r#"<path class="{class}" d="{path}"/>"#);
    }

    fn path(&self, points: &[(f64, f64)]) -> String {
        let mut out = String::new();
        let mut pen = 'M';
        for &(x, y) in points {
            if !(x.is_finite() && y.is_finite()) {
                pen = 'M';
                continue;
            }
            let _ = write!(
                out,
                "{pen}{:.1} {:.1}",
                self.px(x),
                self.py(y).clamp(-9e3, 9e3)
            );
            pen = 'L';
        }
        out
    }

    /// The area between two curves; parts where one is missing stay open.
    pub fn band(&mut self, class: &str, x: &[f64], low: &[f64], high: &[f64]) {
        let n = x.len().min(low.len()).min(high.len());
        let step = n.div_ceil(MOST_POINTS).max(1);
        let mut from = 0;
        while from < n {
            let known = |i: usize| low[i].is_finite() && high[i].is_finite();
            while from < n && !known(from) {
                from += 1;
            }
            let mut to = from;
            while to < n && known(to) {
                to += 1;
            }
            if to > from + 1 {
                let there = (from..to).step_by(step).map(|i| (x[i], high[i]));
                let back = (from..to).rev().step_by(step).map(|i| (x[i], low[i]));
                let path = self.path(&there.chain(back).collect::<Vec<_>>());
                let _ = write!(self.body, r#"<path class="{class}" d="{path}Z"/>"#);
            }
            from = to.max(from + 1);
        }
    }

    /// Single points.
    pub fn points(&mut self, class: &str, x: &[f64], y: &[f64]) {
        let n = x.len().min(y.len());
        for i in (0..n).step_by(n.div_ceil(MOST_POINTS).max(1)) {
            if x[i].is_finite() && y[i].is_finite() {
                let _ = write!(
                    self.body,
                    r#"<circle class="{class}" cx="{:.1}" cy="{:.1}" r="2.2"/>"#,
                    self.px(x[i]),
                    self.py(y[i])
                );
            }
        }
    }

    /// The picture.
    pub fn finish(self) -> String {
        let (w, h) = (self.width, self.height);
        format!(
            r#"<svg viewBox="0 0 {w:.0} {h:.0}" style="max-width:{:.0}px" role="img" aria-label="{}"><title>{}</title>{}</svg>"#,
            1.25 * w,
            self.about,
            self.title,
            self.body
        )
    }
}

/// At most [`MOST_POINTS`] points: from each stretch its lowest and its highest, so that no spike is lost.
fn thin(x: &[f64], y: &[f64]) -> Vec<(f64, f64)> {
    let n = x.len().min(y.len());
    if n <= MOST_POINTS {
        return (0..n).map(|i| (x[i], y[i])).collect();
    }
    let stretch = n.div_ceil(MOST_POINTS / 2);
    let mut out = Vec::with_capacity(MOST_POINTS + 2);
    for from in (0..n).step_by(stretch) {
        let all = from..(from + stretch).min(n);
        let known = || all.clone().filter(|&i| y[i].is_finite());
        let low = known().min_by(|&a, &b| y[a].total_cmp(&y[b]));
        let high = known().max_by(|&a, &b| y[a].total_cmp(&y[b]));
        match (low, high) {
            (Some(a), Some(b)) => {
                let (first, second) = (a.min(b), a.max(b));
                out.push((x[first], y[first]));
                out.push((x[second], y[second]));
            }
            _ => out.push((x[from], f64::NAN)),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        for (x, want) in [
            (0.0, "0"),
            (1.0, "1"),
            (0.012_345, "0.0123"),
            (12.0, "12"),
            (123.456, "123"),
            (0.5, "0.5"),
            (-4.56789, "-4.57"),
            (2.5e-7, "2.50·10⁻⁷"),
            (f64::NAN, "–"),
            (1000.0, "1000"),
        ] {
            assert_eq!(number(x), want);
        }
    }

    #[test]
    fn axes_mark_round_places() {
        let a = Axis::exact([0.0, 10.0].into_iter());
        assert_eq!(a.ticks(5), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        let l = Axis::log_over([0.1, 2.0].into_iter());
        assert_eq!(l.ticks(5).len(), 5, "{:?}", l.ticks(5)); // 0.1 0.2 0.5 1 2
        assert!((l.place(0.08) - 0.0).abs() < 1e-9);
    }

    #[test]
    fn spikes_survive_thinning_and_gaps_break_the_line() {
        let x: Vec<f64> = (0..10_000).map(f64::from).collect();
        let mut y = vec![0.0; 10_000];
        y[7777] = 5.0;
        let points = thin(&x, &y);
        assert!(points.len() <= MOST_POINTS + 2 && points.contains(&(7777.0, 5.0)));
        let mut c = Chart::new(
            (300.0, 200.0),
            Axis::exact([0.0, 3.0].into_iter()),
            Axis::exact([0.0, 1.0].into_iter()),
            "t",
            "a",
        );
        c.line("before", &[0.0, 1.0, 2.0, 3.0], &[0.0, 1.0, f64::NAN, 1.0]);
        let text = c.finish();
        let d = text
            .split("class=\"before\" d=\"")
            .nth(1)
            .unwrap()
            .split('"')
            .next()
            .unwrap();
        assert_eq!(d.matches('M').count(), 2, "{d}");
    }

    #[test]
    fn text_is_made_safe() {
        assert_eq!(
            escape("<a href=\"x\">&'"),
            "&lt;a href=&quot;x&quot;&gt;&amp;&#39;"
        );
    }
}
