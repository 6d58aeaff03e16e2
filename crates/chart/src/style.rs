//! Colours and strokes of everything in a picture.

type Colour = (&'static str, &'static str, &'static str, &'static str);

/// Name of a colour; its value on light ground, on dark ground, on paper.
const COLOURS: [Colour; 8] = [
    ("ink", "#1c1f23", "#e8e6e1", "#000"),
    ("soft", "#5d646e", "#9aa3ad", "#444"),
    ("grid", "#eceae4", "#262b32", "#e6e6e6"),
    ("before", "#c8500a", "#ff9a57", "#b8460a"),
    ("after", "#0b6fb3", "#62b5f0", "#0a5f9c"),
    ("meas", "#23272d", "#f1efe9", "#000"),
    ("band", "#8a93a055", "#aab4c055", "#0000002b"),
    ("ok", "#1d7f4e", "#5fcf97", "#14603a"),
];

const RULES: &str = "\
svg{font:11.5px system-ui,sans-serif}
svg text{fill:var(--soft)} svg .v{fill:var(--ink);font-variant-numeric:tabular-nums} svg .n{fill:var(--ink)}
svg .title{fill:var(--ink);font-size:14px;font-weight:600}
.g{stroke:var(--grid);stroke-width:1}
.before,.after,.measured,.command,.other{fill:none;stroke-width:1.6;stroke-linejoin:round}
.before{stroke:var(--before)}.after{stroke:var(--after)}.measured{stroke:var(--meas);stroke-width:2.8;opacity:.5}
.command{stroke:var(--soft);stroke-width:1;stroke-dasharray:4 3;opacity:.75}.other{stroke:var(--ok)}
.p-before{fill:var(--before)}.p-after{fill:var(--after)}.p-measured{fill:var(--meas);opacity:.55}.p-other{fill:var(--ok)}
.band{fill:var(--band);stroke:none}
.b-before{fill:var(--before);opacity:.16}.b-after{fill:var(--after);opacity:.16}.b-measured{fill:var(--band)}.b-other{fill:var(--ok);opacity:.14}
.floor{stroke:var(--soft);stroke-width:1.2;stroke-dasharray:2 3}
.bar-before{fill:var(--before)}.bar-after{fill:var(--after)}.bar-set{fill:var(--after)}.bar-out{fill:var(--soft);opacity:.45}
.whisk{stroke:var(--ink);stroke-width:1.4;fill:none}
";

/// The style sheet of pictures inside a page: variables for light, dark and paper, then the classes.
pub fn style() -> String {
    let of = |ground: fn(&Colour) -> &'static str| {
        let set = |colour: &Colour| format!("--{}:{};", colour.0, ground(colour));
        COLOURS.iter().map(set).collect::<String>()
    };
    format!(
        ":root{{{}}}@media (prefers-color-scheme:dark){{:root{{{}}}}}@media print{{:root{{{}}}}}\n{RULES}",
        of(|c| c.1),
        of(|c| c.2),
        of(|c| c.3)
    )
}

/// The style sheet of a picture by itself, on white; without variables, which many programs do not know.
pub(crate) fn style_on_white() -> String {
    COLOURS.iter().fold(RULES.to_owned(), |rules, colour| {
        rules.replace(&format!("var(--{})", colour.0), colour.1)
    })
}
