//! How long functions and files of the product may be.

use super::exceptions::{Offence, hold};
use super::product;
use super::tokens;

const MOST_LINES_OF_A_FUNCTION: usize = 80;
const MOST_LINES_OF_A_FILE: usize = 500;

#[test]
fn functions_are_at_most_80_lines_long() {
    let mut offences = Vec::new();
    for source in product::sources() {
        let t = &source.tokens;
        for i in 0..t.len().saturating_sub(1) {
            if t[i].text != "fn" || !t[i + 1].is_word() {
                continue;
            }
            let mut k = i;
            while k < t.len() && t[k].text != "{" && t[k].text != ";" {
                k = if matches!(t[k].text.as_str(), "(" | "[") {
                    tokens::closing(t, k) + 1
                } else {
                    k + 1
                };
            }
            if k == t.len() || t[k].text == ";" {
                continue;
            }
            let lines = t[tokens::closing(t, k)].line - t[i].line + 1;
            if lines > MOST_LINES_OF_A_FUNCTION {
                let place = format!("{}::{}", source.path, t[i + 1].text);
                offences.push(Offence::new(place, format!("line {}: {lines} lines", t[i].line)));
            }
        }
    }
    hold("function length", offences);
}

#[test]
fn files_are_at_most_500_lines_long() {
    let long = product::sources().into_iter().filter(|s| s.lines > MOST_LINES_OF_A_FILE);
    let offences = long.map(|s| Offence::new(s.path, format!("{} lines without tests", s.lines)));
    hold("file length", offences.collect());
}
