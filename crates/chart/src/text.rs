//! Texts and numbers as they stand in a picture.

/// Text made safe for HTML and SVG.
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
pub fn number(x: f64) -> String {
    let size = x.abs();
    if !x.is_finite() {
        return "–".to_owned();
    }
    if size != 0.0 && !(1e-4..1e6).contains(&size) {
        return power_of_ten(x);
    }
    let decimals = if size == 0.0 { 0.0 } else { 2.0 - size.log10().floor() };
    fixed(x, decimals)
}

/// A number in so many decimals (0 to 7), without a trail of zeros.
pub(crate) fn fixed(x: f64, decimals: f64) -> String {
    let decimals = decimals.clamp(0.0, 7.0) as usize;
    let text = format!("{x:.decimals$}");
    let text =
        if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0" } else { text }.to_owned()
}

fn power_of_ten(x: f64) -> String {
    const RAISED: [char; 10] = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    let text = format!("{x:.2e}");
    let (digits, power) = text.split_once('e').unwrap_or((&text, "0"));
    let raised = power.chars().map(|c| match c.to_digit(10) {
        Some(digit) => RAISED[digit as usize],
        None => '⁻',
    });
    format!("{digits}·10{}", raised.collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        for (x, want) in [
            (0.0, "0"),
            (-0.0, "0"),
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
    fn text_is_made_safe() {
        assert_eq!(escape("<a href=\"x\">&'"), "&lt;a href=&quot;x&quot;&gt;&amp;&#39;");
    }
}
