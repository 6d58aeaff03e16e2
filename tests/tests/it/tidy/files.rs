//! What holds for each source file: it says what it is for, its comments can be read, nothing is left to do.

use super::exceptions::{Offence, hold};
use super::product::{self, below_root, root};

#[test]
fn every_module_says_what_it_is_for() {
    let files = product::files(&root(), ".rs");
    assert!(files.len() > 50);
    for file in files {
        let text = std::fs::read_to_string(&file).expect("utf-8");
        let first = text.lines().find(|line| !line.trim().is_empty() && !line.starts_with("#!["));
        assert!(
            first.is_some_and(|line| line.starts_with("//!")),
            "{} does not begin with a `//!` line",
            file.display()
        );
    }
}

#[test]
fn nothing_is_left_to_do_in_the_code() {
    let marks = [concat!("TO", "DO"), concat!("FIX", "ME"), concat!("XX", "X:")];
    for file in product::files(&root(), ".rs") {
        let text = std::fs::read_to_string(&file).expect("utf-8");
        for (number, line) in text.lines().enumerate() {
            assert!(
                !marks.iter().any(|mark| line.contains(mark)),
                "{}:{} holds a mark of unfinished work",
                file.display(),
                number + 1
            );
        }
    }
}

#[test]
fn documentation_makes_sense_in_a_hover() {
    let mut offences = Vec::new();
    for file in product::files(&root(), ".rs") {
        let text = std::fs::read_to_string(&file).expect("UTF-8");
        let mut before = "";
        for (number, line) in text.lines().enumerate() {
            let line = line.trim();
            // "Of …" hangs in the air where nobody sees the name it belongs to.
            let begins = !before.starts_with("///") && line.starts_with("/// Of ");
            if begins || line.starts_with("//! Of ") {
                offences
                    .push(Offence::new(below_root(&file), format!("line {}: {line}", number + 1)));
            }
            before = line;
        }
    }
    hold("documentation", offences);
}
