//! The documentation: its lines can be read, its links lead somewhere, its examples work.

use std::path::Path;
use std::process::{Command, Output};

use super::exceptions::{Offence, hold};
use super::product::{below_root, files, root};

const MOST_CHARACTERS_OF_A_LINE: usize = 110;

/// A line of a page, and the kind of block that it stands in.
struct Line {
    page: String,
    number: usize,
    text: String,
    /// What stands behind the opening fence (`sh`, `text`, …); `None` outside of blocks.
    block: Option<String>,
}

impl Line {
    fn place(&self) -> String {
        format!("{}:{}", self.page, self.number)
    }
}

fn lines() -> Vec<Line> {
    let mut out = Vec::new();
    for file in files(&root(), ".md") {
        let mut block: Option<String> = None;
        for (i, text) in std::fs::read_to_string(&file).expect("UTF-8").lines().enumerate() {
            if let Some(kind) = text.strip_prefix("```") {
                block = if block.is_some() { None } else { Some(kind.to_owned()) };
                continue;
            }
            let (page, block) = (below_root(&file), block.clone());
            out.push(Line { page, number: i + 1, text: text.to_owned(), block });
        }
    }
    out
}

#[test]
fn lines_of_pages_are_at_most_110_characters_long() {
    let long = lines().into_iter().filter(|line| {
        // Tables and links cannot be broken; blocks of text are what a program printed.
        let text = line.text.trim_start();
        let unbreakable = text.starts_with('|') || text.contains("](") || text.contains("://");
        let printed = line.block.as_deref() == Some("text");
        !unbreakable && !printed && line.text.chars().count() > MOST_CHARACTERS_OF_A_LINE
    });
    let offences = long.map(|l| Offence::new(l.page.clone(), format!("line {}", l.number)));
    hold("line of a page", offences.collect());
}

#[test]
fn every_block_says_what_it_is() {
    let known = ["sh", "sh run", "toml", "text", "python"];
    for line in lines() {
        let kind = line.block.as_deref().unwrap_or("text");
        assert!(known.contains(&kind), "{}: a block of the kind `{kind}`", line.place());
    }
}

#[test]
fn links_lead_somewhere() {
    let all = lines();
    let mut wrong = Vec::new();
    for line in all.iter().filter(|line| line.block.is_none()) {
        for link in line.text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            if link.contains("://") {
                continue;
            }
            let (path, anchor) = link.split_once('#').unwrap_or((link, ""));
            let folder = Path::new(&line.page).parent().expect("folder");
            let target =
                if path.is_empty() { line.page.clone() } else { plain(&folder.join(path)) };
            let page = all.iter().filter(|other| other.page == target);
            let mut headings =
                page.filter(|l| l.block.is_none()).filter_map(|l| anchor_of(&l.text));
            let there = root().join(&target).exists();
            if !there || (!anchor.is_empty() && !headings.any(|heading| heading == anchor)) {
                wrong.push(format!("{}: {link}", line.place()));
            }
        }
    }
    assert!(wrong.is_empty(), "links that lead nowhere:\n{}", wrong.join("\n"));
}

/// Tables of faults say which test shows what: each is there, under that name or, with `…`, that beginning.
#[test]
fn tests_that_tables_name_are_there() {
    let sources = files(&root(), ".rs").into_iter();
    let text: String = sources.map(|file| std::fs::read_to_string(file).expect("UTF-8")).collect();
    let pages = ["docs/reference/faults.md", "docs/reference/faults-actors.md"];
    let mut wrong = Vec::new();
    for line in lines().iter().filter(|l| pages.contains(&&*l.page)) {
        for name in line.text.split('`').skip(1).step_by(2) {
            let name = name.rsplit("::").next().unwrap_or(name);
            let test = name.trim_end_matches('…');
            let letters = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
            let is_test = test.matches('_').count() >= 3 || name.ends_with('…');
            let end = if name.ends_with('…') { "" } else { "(" };
            if is_test && test.chars().all(letters) && !text.contains(&format!("fn {test}{end}")) {
                wrong.push(format!("{}: {name}", line.place()));
            }
        }
    }
    assert!(wrong.is_empty(), "no such test:\n{}", wrong.join("\n"));
}

/// `a/../b` as `b`.
fn plain(path: &Path) -> String {
    let mut parts: Vec<&str> = Vec::new();
    for part in path.iter().map(|part| part.to_str().expect("UTF-8")) {
        if part == ".." {
            parts.pop();
        } else if part != "." {
            parts.push(part);
        }
    }
    parts.join("/")
}

/// The anchor that readers of markdown give a heading.
fn anchor_of(line: &str) -> Option<String> {
    let heading = line.strip_prefix('#')?.trim_start_matches('#').trim();
    let kept = heading.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
    Some(kept.collect::<String>().to_lowercase().replace(' ', "-"))
}

/// A command line of ours in a page, as words.
struct Example {
    place: String,
    words: Vec<String>,
    /// Nothing is left out of it: it stands in a block, without `…`.
    whole: bool,
}

/// What pages name as `caudata …`, in blocks of commands, behind the `$` of what was printed, and between
/// back quotes.
fn examples() -> Vec<Example> {
    let (mut out, mut begun) = (Vec::new(), String::new());
    for line in lines() {
        let in_block = match line.block.as_deref() {
            Some("sh" | "sh run") => Some(line.text.as_str()),
            Some("text") => line.text.strip_prefix("$ "),
            _ => None,
        };
        let mut found: Vec<String> = Vec::new();
        if let Some(text) = in_block {
            begun += text;
            if let Some(open) = begun.strip_suffix('\\') {
                begun = open.to_owned();
                continue;
            }
            found.push(std::mem::take(&mut begun));
        } else if line.block.is_none() {
            // The last one of an odd number opens what the next line closes.
            let spans = line.text.matches('`').count() / 2;
            let between = line.text.split('`').skip(1).step_by(2).take(spans);
            found.extend(between.map(str::to_owned));
        }
        for text in found {
            let (place, words) = (line.place(), words_of(&text));
            let whole = in_block.is_some() && !text.contains('…');
            if words.first().is_some_and(|program| PROGRAMS.contains(&program.as_str())) {
                out.push(Example { place, words, whole });
            }
        }
    }
    out
}

const PROGRAMS: [&str; 6] = [
    "caudata",
    "caudata-actor",
    "caudata-learner",
    "caudata-policy-server",
    "caudata-robot",
    "caudata-ros2",
];

/// Words as a shell makes them, up to a comment, a pipe or the next command; without the signs of what may be
/// left out.
fn words_of(text: &str) -> Vec<String> {
    let (mut words, mut word, mut quote): (Vec<String>, String, Option<char>) =
        (Vec::new(), String::new(), None);
    for c in text.chars().chain([' ']) {
        match (quote, c) {
            (Some(open), c) if c == open => quote = None,
            (None, '"' | '\'') => quote = Some(c),
            (None, '[' | ']' | '…') => {}
            (None, ' ') if word.is_empty() => {}
            (None, ' ') => words.push(std::mem::take(&mut word)),
            (None, '#') if word.is_empty() => break,
            (None, '|' | '&' | ';' | '>') => break,
            (_, c) => word.push(c),
        }
    }
    // An assignment before a command is the shell's.
    words.into_iter().skip_while(|word| word.starts_with("CAUDATA_")).collect()
}

fn run(words: &[String], folder: &Path) -> Output {
    let program = caudata_tests::binary(&words[0]).expect("programs are built before tests");
    let mut command = Command::new(program);
    let output = command.args(&words[1..]).current_dir(folder).output();
    output.unwrap_or_else(|error| panic!("{}: {error}", words[0]))
}

#[test]
fn commands_in_pages_are_understood() {
    let mut wrong = Vec::new();
    let mut checked = 0;
    for example in examples() {
        // With `--help` at its end a program reads all flags and their values, and does nothing.
        let number = |word: &String| {
            if word.len() == 1 && word == "N" { "1".to_owned() } else { word.clone() }
        };
        let mut words: Vec<String> = example.words.iter().map(number).collect();
        words.push("--help".to_owned());
        let output = run(&words, &root());
        let (said, help) = (output.stderr, output.stdout);
        let why = match String::from_utf8_lossy(&said).lines().next() {
            _ if output.status.success() && example.whole => missing(&example.words, &help),
            _ if output.status.success() => None,
            said => Some(said.unwrap_or_default().to_owned()),
        };
        checked += 1;
        if let Some(why) = why {
            let page = example.place.split(':').next().expect("a page");
            let place = format!("{page}: {}", example.words.join(" "));
            wrong.push(Offence::new(place, format!("{} {why}", example.place)));
        }
    }
    assert!(checked > 50, "pages should have many examples, found {checked}");
    hold("example", wrong);
}

/// What the usage in `help` asks for and `words` lack.
fn missing(words: &[String], help: &[u8]) -> Option<String> {
    let help = String::from_utf8_lossy(help);
    let usage = help.lines().find_map(|line| line.strip_prefix("Usage: "))?;
    let mut needed = usage.split(' ').filter(|word| word.starts_with("--"));
    let lacking = needed.find(|flag| !words.iter().any(|word| word == flag))?;
    Some(format!("lacks {lacking}"))
}

/// A command of a page at a size that a test can wait for: fewer and shorter episodes, two iterations.
fn small_size(words: &[String]) -> Vec<String> {
    let sizes: &[(&str, &str)] = match words.get(1).map(String::as_str) {
        Some("eval") => &[("--episodes", "1"), ("--seconds", "4")],
        Some("train") => &[("--iterations", "2")],
        _ => &[],
    };
    let mut words = words.to_vec();
    for (flag, value) in sizes {
        match words.iter().position(|word| word == flag) {
            Some(at) => words[at + 1] = (*value).to_owned(),
            None => words.extend([(*flag).to_owned(), (*value).to_owned()]),
        }
    }
    if words.get(1).is_some_and(|command| command == "train") {
        let small = ["evaluation.episodes=1", "actors.lanes=8", "actors.chunk_steps=8"];
        words.extend(small.iter().flat_map(|set| ["--set".to_owned(), (*set).to_owned()]));
    }
    words
}

#[test]
fn small_examples_run() {
    let scratch = tempfile::tempdir().expect("a folder");
    for name in ["robots", "policies"] {
        let (from, to) = (root().join(name), scratch.path().join(name));
        std::os::unix::fs::symlink(from, to).expect("a link");
    }
    let places: Vec<String> = lines()
        .into_iter()
        .filter(|line| line.block.as_deref() == Some("sh run"))
        .map(|line| line.place())
        .collect();
    let small = examples().into_iter().filter(|example| places.contains(&example.place));
    let mut ran = 0;
    for example in small {
        let output = run(&small_size(&example.words), scratch.path());
        let why = String::from_utf8_lossy(&output.stderr);
        let line = example.words.join(" ");
        assert!(output.status.success(), "{}: {line}: {why}", example.place);
        ran += 1;
    }
    assert!(ran > 3, "pages should have blocks that run (```sh run), found {ran}");
}

#[test]
fn settings_in_pages_are_settings() {
    let scratch = tempfile::tempdir().expect("a folder");
    let mut blocks: Vec<(String, String)> = Vec::new();
    let mut last = (String::new(), 0);
    for line in lines().into_iter().filter(|line| line.block.as_deref() == Some("toml")) {
        if last != (line.page.clone(), line.number - 1) {
            blocks.push((line.place(), String::new()));
        }
        last = (line.page.clone(), line.number);
        let text = &mut blocks.last_mut().expect("begun").1;
        *text += &format!("{}\n", line.text);
    }
    for (place, text) in blocks {
        let file = scratch.path().join("page.toml");
        std::fs::write(&file, text).expect("written");
        let words = ["caudata", "config", "show", "--config"].map(str::to_owned);
        let output = run(&[&words[..], &[file.display().to_string()]].concat(), &root());
        assert!(output.status.success(), "{place}: {}", String::from_utf8_lossy(&output.stderr));
    }
}
