//! A picture with two axes.

use std::fmt::Write;

use crate::axis::Axis;
use crate::style::style_on_white;
use crate::text::escape;

/// Most points of one curve: more cannot be seen and make the page heavy.
const MOST_POINTS: usize = 900;
const TOP: f64 = 10.0;
const RIGHT: f64 = 12.0;
const BOTTOM: f64 = 40.0;
/// Least room for the vertical axis, and what a character of its marks takes.
const LEFT: f64 = 58.0;
const CHARACTER: f64 = 6.6;

/// A picture with two axes.
#[derive(Debug)]
pub struct Chart {
    body: String,
    size: (f64, f64),
    left: f64,
    x: Axis,
    y: Axis,
    title: String,
    about: String,
}

impl Chart {
    /// An empty chart. `about`: what it shows, for those who do not see it.
    pub fn new(size: (f64, f64), x: Axis, y: Axis, title: &str, about: &str) -> Self {
        let marks = y.ticks(((size.1 / 48.0) as usize).max(3));
        let longest = marks.iter().map(|tick| tick.1.chars().count()).max();
        let mut chart = Self {
            body: String::new(),
            size,
            left: LEFT.max(26.0 + CHARACTER * longest.unwrap_or(0) as f64),
            x,
            y,
            title: title.to_owned(),
            about: about.to_owned(),
        };
        chart.grid(&marks);
        chart
    }

    fn px(&self, x: f64) -> f64 {
        self.left + self.x.place(x) * (self.size.0 - self.left - RIGHT)
    }

    fn py(&self, y: f64) -> f64 {
        self.size.1 - BOTTOM - self.y.place(y) * (self.size.1 - TOP - BOTTOM)
    }

    fn raw(&mut self, element: std::fmt::Arguments<'_>) {
        // Writing to a String cannot fail.
        let _ = self.body.write_fmt(element);
    }

    fn grid(&mut self, marks: &[(f64, String)]) {
        let (left, right, low) = (self.left, self.size.0 - RIGHT, self.size.1 - BOTTOM);
        for (t, label) in self.x.ticks(((self.size.0 / 90.0) as usize).max(3)) {
            let (x, y) = (self.px(t), low + 15.0);
            self.raw(format_args!(
                r#"<path class="g" d="M{x:.1} {low:.1}V{TOP}"/><text class="t" x="{x:.1}" y="{y:.1}" text-anchor="middle">{label}</text>"#
            ));
        }
        for (t, label) in marks {
            let (x, y) = (left - 6.0, self.py(*t));
            self.raw(format_args!(
                r#"<path class="g" d="M{left:.1} {y:.1}H{right:.1}"/><text class="t" x="{x:.1}" y="{:.1}" text-anchor="end">{label}</text>"#,
                y + 3.5
            ));
        }
    }

    /// Labels of the axes, with units.
    pub fn labels(&mut self, x: &str, y: &str) {
        let (w, h) = self.size;
        let middle = self.left + 0.5 * (w - self.left - RIGHT);
        let half = TOP + 0.5 * (h - TOP - BOTTOM);
        self.raw(format_args!(
            r#"<text class="l" x="{middle:.1}" y="{:.1}" text-anchor="middle">{}</text><text class="l" transform="translate(12 {half:.1}) rotate(-90)" text-anchor="middle">{}</text>"#,
            h - 6.0,
            escape(x),
            escape(y)
        ));
    }

    /// A curve of class `class`; it breaks where a value is missing.
    pub fn line(&mut self, class: &str, x: &[f64], y: &[f64]) {
        let path = self.path(&thin(x, y));
        self.raw(format_args!(r#"<path class="{class}" d="{path}"/>"#));
    }

    fn path(&self, points: &[(f64, f64)]) -> String {
        let mut out = String::new();
        let mut pen = 'M';
        for &(x, y) in points {
            if !(x.is_finite() && y.is_finite()) {
                pen = 'M';
                continue;
            }
            let _ = write!(out, "{pen}{:.1} {:.1}", self.px(x), self.py(y).clamp(-9e3, 9e3));
            pen = 'L';
        }
        out
    }

    /// The area between two curves; parts where one is missing stay open.
    pub fn band(&mut self, class: &str, x: &[f64], low: &[f64], high: &[f64]) {
        let n = x.len().min(low.len()).min(high.len());
        let step = n.div_ceil(MOST_POINTS).max(1);
        let points: Vec<(f64, f64, f64)> = (0..n).map(|i| (x[i], low[i], high[i])).collect();
        let known = |p: &(f64, f64, f64)| p.1.is_finite() && p.2.is_finite();
        for part in points.chunk_by(|a, b| known(a) && known(b)) {
            if part.len() > 1 {
                let there = part.iter().step_by(step).map(|p| (p.0, p.2));
                let back = part.iter().rev().step_by(step).map(|p| (p.0, p.1));
                let path = self.path(&there.chain(back).collect::<Vec<_>>());
                self.raw(format_args!(r#"<path class="{class}" d="{path}Z"/>"#));
            }
        }
    }

    /// Single points.
    pub fn points(&mut self, class: &str, x: &[f64], y: &[f64]) {
        let n = x.len().min(y.len());
        for i in (0..n).step_by(n.div_ceil(MOST_POINTS).max(1)) {
            if x[i].is_finite() && y[i].is_finite() {
                let (px, py) = (self.px(x[i]), self.py(y[i]));
                self.raw(format_args!(
                    r#"<circle class="{class}" cx="{px:.1}" cy="{py:.1}" r="2.2"/>"#
                ));
            }
        }
    }

    /// The chart for a page, which gives it its caption and [`style`](crate::style).
    pub fn finish(self) -> String {
        let (w, h) = self.size;
        format!(
            r#"<svg viewBox="0 0 {w:.0} {h:.0}" style="max-width:{:.0}px" role="img" aria-label="{}"><title>{}</title>{}</svg>"#,
            1.25 * w,
            escape(&self.about),
            escape(&self.title),
            self.body
        )
    }
}

/// An SVG file of its own: charts of one size in rows of `columns`, each below its title.
pub fn sheet(charts: &[Chart], columns: usize) -> String {
    const TITLE: f64 = 30.0;
    let columns = columns.clamp(1, charts.len().max(1));
    let (w, h) = charts.first().map_or((1.0, 1.0), |chart| chart.size);
    let (width, height) = (w * columns as f64, (h + TITLE) * charts.len().div_ceil(columns) as f64);
    let mut out = format!(
        r#"<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0}" height="{height:.0}" viewBox="0 0 {width:.0} {height:.0}"><style>{}</style><rect width="100%" height="100%" fill="white"/>"#,
        style_on_white()
    );
    for (i, chart) in charts.iter().enumerate() {
        let (x, y) = (w * (i % columns) as f64, (h + TITLE) * (i / columns) as f64 + TITLE);
        let _ = write!(
            out,
            r#"<g transform="translate({x:.0} {y:.0})"><text class="title" x="{:.1}" y="-8" text-anchor="middle">{}</text>{}</g>"#,
            0.5 * (chart.left + w - RIGHT),
            escape(&chart.title),
            chart.body
        );
    }
    out.push_str("</svg>\n");
    out
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
    fn spikes_survive_thinning_and_gaps_break_the_line() {
        let x: Vec<f64> = (0..10_000).map(f64::from).collect();
        let mut y = vec![0.0; 10_000];
        y[7777] = 5.0;
        let points = thin(&x, &y);
        assert!(points.len() <= MOST_POINTS + 2 && points.contains(&(7777.0, 5.0)));
        let mut c =
            Chart::new((300.0, 200.0), Axis::exact([0.0, 3.0]), Axis::exact([0.0, 1.0]), "t", "a");
        c.line("before", &[0.0, 1.0, 2.0, 3.0], &[0.0, 1.0, f64::NAN, 1.0]);
        let text = c.finish();
        let d = text.split("class=\"before\" d=\"").nth(1).unwrap().split('"').next().unwrap();
        assert_eq!(d.matches('M').count(), 2, "{d}");
    }

    #[test]
    fn a_sheet_is_a_file_of_its_own() {
        let chart = |title: &str| {
            let axis = Axis::exact([0.0, 1.0]);
            let mut chart = Chart::new((300.0, 200.0), axis, axis, title, "a");
            chart.line("after", &[0.0, 1.0], &[0.0, 1.0]);
            chart
        };
        let svg = sheet(&["one", "a < b", "three"].map(chart), 2);
        assert!(svg.contains(r#"width="600" height="460""#), "{svg}");
        assert!(svg.contains("a &lt; b") && !svg.contains("var("));
        assert!(sheet(&[], 2).ends_with("</svg>\n"));
    }
}
