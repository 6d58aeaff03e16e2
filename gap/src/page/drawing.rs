//! A picture of texts and bars, as SVG.

use std::fmt::Write;

use caudata_chart::escape;

/// Places and sizes are in the picture's own units, to the right and down.
pub(super) struct Drawing(String);

impl Drawing {
    /// `size`: width and height. `most_px`: how wide it may be shown. `about`: for who does not see it.
    pub fn new((w, h): (f64, f64), most_px: f64, title: &str, about: &str) -> Self {
        let (title, about) = (escape(title), escape(about));
        let head = format!(r#"<svg viewBox="0 0 {w:.0} {h:.0}" style="max-width:{most_px:.0}px""#);
        Self(format!(r#"{head} role="img" aria-label="{about}"><title>{title}</title>"#))
    }

    /// A text whose `anchor` (start, middle, end) is at a place; `look`: its class, and more.
    pub fn text(&mut self, look: &str, anchor: &str, (x, y): (f64, f64), text: &str) {
        let at = format!(r#"x="{x:.1}" y="{y:.1}" text-anchor="{anchor}""#);
        let _ = write!(self.0, "<text {look} {at}>{}</text>", escape(text));
    }

    /// A bar from its upper left corner.
    pub fn bar(&mut self, look: &str, (x, y): (f64, f64), (w, h): (f64, f64)) {
        let at = format!(r#"x="{x:.1}" y="{y:.1}" width="{w:.1}" height="{h:.1}""#);
        let _ = write!(self.0, "<rect {look} {at}/>");
    }

    /// A vertical line from the top down to `y`.
    pub fn rule(&mut self, x: f64, y: f64) {
        let line = format!(r#"x1="{x:.1}" x2="{x:.1}" y1="0" y2="{y:.1}""#);
        let _ = write!(self.0, r#"<line class="floor" {line}/>"#);
    }

    /// Any other SVG.
    pub fn push(&mut self, svg: &str) {
        self.0.push_str(svg);
    }

    /// What `draw` adds, with a text for who points at it.
    pub fn told(&mut self, about: &str, draw: impl FnOnce(&mut Self)) {
        let _ = write!(self.0, "<g><title>{}</title>", escape(about));
        draw(self);
        self.push("</g>");
    }

    /// The whole picture.
    pub fn finish(self) -> String {
        self.0 + "</svg>"
    }
}
