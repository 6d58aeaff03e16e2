//! `docs/reference/configuration.md` is made from the doc comments of the configuration's structs, so that it
//! cannot lag behind.
//!
//! When this test fails, run it with `CAUDATA_WRITE_DOCS=1` and commit the file.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use caudata_config::{Config, PRESETS, Source};

/// Where the structs of the configuration are.
const SOURCES: [&str; 6] = [
    "crates/config/src",
    "crates/config/src/sections",
    "sim/src",
    "sim/src/terrain",
    "task/src",
    "task/src/reward",
];

/// A struct as its source describes it.
#[derive(Default, Debug)]
struct Described {
    doc: String,
    /// Name, type, doc.
    fields: Vec<(String, String, String)>,
}

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// All structs with their doc comments, by name.
fn described_structs() -> BTreeMap<String, Described> {
    let mut structs = BTreeMap::new();
    for folder in SOURCES {
        for entry in std::fs::read_dir(repository().join(folder)).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|extension| extension == "rs") {
                read_structs(&std::fs::read_to_string(&path).unwrap(), &mut structs);
            }
        }
    }
    structs
}

/// Reads `pub struct X { /// doc … pub field: Type, }`, and the rows of
/// `reward_terms! { /// doc … name: …; }`, which become the struct `RewardWeights`.
fn read_structs(text: &str, structs: &mut BTreeMap<String, Described>) {
    let mut doc = String::new();
    let mut open: Option<(String, Described)> = None;
    for line in text.lines().map(str::trim) {
        if let Some(comment) = line.strip_prefix("///") {
            let comment = comment.trim();
            if !doc.is_empty() {
                doc.push(' ');
            }
            doc.push_str(comment);
            continue;
        }
        if line.starts_with("#[") {
            continue;
        }
        if let Some(name) = line.strip_prefix("pub struct ").and_then(|s| s.strip_suffix(" {")) {
            open = Some((name.into(), Described { doc: doc.clone(), fields: Vec::new() }));
        } else if line == "reward_terms! {" {
            let doc = "`[task.reward.weights]`: weight of each term; 0 switches a term off.".into();
            open = Some(("RewardWeights".into(), Described { doc, fields: Vec::new() }));
        } else if line == "}" {
            // A struct without fields of its own is a macro's pattern.
            if let Some((name, described)) = open.take().filter(|(_, d)| !d.fields.is_empty()) {
                structs.insert(name, described);
            }
        } else if let Some((_, described)) = &mut open {
            let field = line.strip_prefix("pub ").unwrap_or(line);
            if let Some((name, kind)) = field.split_once(": ")
                && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
            {
                let kind = kind.split(" = ").next().unwrap();
                let kind = kind.trim_end_matches([',', ';']).to_owned();
                described.fields.push((name.into(), kind, doc.clone()));
            }
        }
        doc.clear();
    }
}

/// Writes the table of one struct and, after it, those of the structs inside it.
fn write_section(
    out: &mut String,
    structs: &BTreeMap<String, Described>,
    kind: &str,
    prefix: &str,
    defaults: &BTreeMap<String, String>,
) {
    let described = &structs[kind];
    let title = if prefix.is_empty() { "Top level".into() } else { format!("`[{prefix}]`") };
    writeln!(out, "\n## {title}\n\n{}\n", without_title(&described.doc)).unwrap();
    let mut inner = Vec::new();
    let mut rows = String::new();
    for (name, kind, doc) in &described.fields {
        let key = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
        match defaults.get(&key) {
            Some(default) => {
                let doc = doc.replace('|', "\\|");
                writeln!(rows, "| `{key}` | `{default}` | {doc} |").unwrap();
            }
            // A table that is empty, or a list: it has no key to name a default of.
            None if !structs.contains_key(kind.rsplit("::").next().unwrap()) => {
                writeln!(rows, "| `{key}` | none | {doc} |").unwrap();
            }
            None => inner.push((kind.rsplit("::").next().unwrap(), key)),
        }
    }
    if !rows.is_empty() {
        write!(out, "| key | default | meaning |\n|---|---|---|\n{rows}").unwrap();
    }
    for (kind, key) in inner {
        write_section(out, structs, kind, &key, defaults);
    }
}

/// Doc comments begin with the name of their table, which is the heading here.
fn without_title(doc: &str) -> &str {
    match doc.split_once("]`") {
        Some((head, rest)) if head.len() < 40 => {
            rest.trim_start_matches([':', '.', ',']).trim_start()
        }
        _ => doc,
    }
}

fn reference() -> String {
    let config = Config::load(&Source::default()).unwrap();
    let defaults: BTreeMap<String, String> = config.entries().into_iter().collect();
    let mut out = String::from(
        "# Configuration\n\n\
        Made from the doc comments in the code by `crates/config/tests/it/reference.rs`; edit those, not this file.\n\n\
        One TOML file describes a run. Layers lie on top of each other, later ones win: the defaults below, a preset \
        (`--preset`), a file (`--config FILE.toml`), single keys (`--set learner.ppo.gamma=0.98`, any number of times). An \
        unknown key is an error that names the nearest known one; every value is checked before anything starts.\n\n\
        `caudata config show --preset quick` prints every key with its value in effect, \
        `caudata config check --config FILE.toml` only checks. A run folder keeps the configuration in effect as `config.toml`.\n\n\
        Units are in the names: `_s` seconds, `_m` metres, `_rad` radians, `_nm` N·m, `_mps` m/s, `_radps` rad/s, `_hz` Hz.\n\n\
        Presets:\n\n",
    );
    for preset in PRESETS {
        writeln!(out, "- `{}`: {}", preset.name, preset.about).unwrap();
    }
    write_section(&mut out, &described_structs(), "Config", "", &defaults);
    let lines: Vec<String> = out.lines().map(wrapped).collect();
    lines.join("\n") + "\n"
}

/// `line` in lines of at most 110 characters, unless it is a row of a table.
fn wrapped(line: &str) -> String {
    let mut out = String::new();
    let mut width = 0;
    for word in line.split(' ').filter(|_| !line.starts_with('|')) {
        let long = word.chars().count();
        let (space, more) = match width {
            0 => ("", 0),
            _ if width + 1 + long > 110 => ("\n", 0),
            _ => (" ", width + 1),
        };
        out += space;
        out += word;
        width = more + long;
    }
    if line.starts_with('|') { line.to_owned() } else { out }
}

#[test]
fn the_reference_page_is_up_to_date() {
    let path = repository().join("docs/reference/configuration.md");
    let made = reference();
    if std::env::var_os("CAUDATA_WRITE_DOCS").is_some() {
        std::fs::write(&path, &made).unwrap();
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        kept == made,
        "docs/reference/configuration.md is out of date: run this test with CAUDATA_WRITE_DOCS=1"
    );
}

#[test]
fn every_key_is_explained() {
    let page = reference();
    for (key, default) in Config::default().entries() {
        let row = format!("| `{key}` | `{default}` | ");
        let at = page.find(&row).unwrap_or_else(|| panic!("no row for {key} = {default}"));
        let meaning = page[at + row.len()..].lines().next().unwrap();
        assert!(meaning.len() > 15, "{key} is not explained: {meaning}");
    }
}
