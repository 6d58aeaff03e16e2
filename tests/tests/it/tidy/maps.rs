//! What the maps name exists, and what exists is on the map.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::product::root;

/// Markdown files whose back-quoted paths must exist.
const MAPS: [&str; 3] = ["ARCHITECTURE.md", "CONTRIBUTING.md", "README.md"];

/// A back-quoted word counts as a path when it begins with one of the repository's folders or names a root
/// file; one that begins with `/` is part of a web address.
fn looks_like_a_path(word: &str, root: &Path) -> bool {
    let plain = word.chars().all(|c| c.is_ascii_alphanumeric() || "._-/".contains(c));
    let first = word.split('/').next().unwrap_or_default();
    let known_top = root.join(first).exists() || word.ends_with(".md") || word.ends_with('/');
    plain && !first.is_empty() && known_top && (word.contains('/') || word.ends_with(".md"))
}

#[test]
fn every_path_that_the_maps_name_exists() {
    let root = root();
    let mut checked = 0;
    for map in MAPS {
        let text = std::fs::read_to_string(root.join(map)).expect(map);
        for word in text.split('`').skip(1).step_by(2) {
            if looks_like_a_path(word, &root)
                && !word.starts_with("target/")
                && !word.starts_with("runs/")
            {
                assert!(root.join(word).exists(), "{map} names `{word}`, which does not exist");
                checked += 1;
            }
        }
    }
    assert!(checked > 20, "the maps should name many paths, found {checked}");
}

#[test]
fn what_the_map_says_to_be_in_a_file_is_there() {
    let root = root();
    let map = std::fs::read_to_string(root.join("ARCHITECTURE.md")).expect("map");
    let mut checked = 0;
    // `path` (`Name`…
    for (before, after) in
        map.match_indices("` (`").map(|(at, sign)| (&map[..at], &map[at + sign.len()..]))
    {
        let path = before.rsplit('`').next().unwrap_or_default();
        let name = after.split('`').next().unwrap_or_default();
        if !path.ends_with(".rs") || name.contains('/') {
            continue;
        }
        let text = std::fs::read_to_string(root.join(path)).unwrap_or_default();
        let there = name.split("::").all(|part| text.contains(part));
        assert!(there, "ARCHITECTURE.md says that `{name}` is in `{path}`");
        checked += 1;
    }
    assert!(checked > 3, "the map should name what is in files, found {checked}");
}

#[test]
fn every_top_level_folder_is_on_the_map() {
    let root = root();
    let map = std::fs::read_to_string(root.join("ARCHITECTURE.md")).expect("map");
    let listed = std::process::Command::new("git").args(["ls-files"]).current_dir(&root).output();
    let Ok(output) = listed else {
        println!("skipped: git is not installed");
        return;
    };
    let files = String::from_utf8(output.stdout).expect("utf-8 names");
    let folders: BTreeSet<&str> = files
        .lines()
        .filter_map(|line| line.split_once('/').map(|(top, _)| top))
        .filter(|top| !top.starts_with('.'))
        .collect();
    for folder in folders {
        assert!(
            map.contains(&format!("`{folder}/`")),
            "ARCHITECTURE.md does not say what `{folder}/` is for"
        );
    }
}

#[test]
fn the_page_on_exit_codes_matches_the_code() {
    let page = std::fs::read_to_string(root().join("docs/reference/exit-codes.md")).expect("page");
    let on_page: BTreeMap<u8, String> = page
        .lines()
        .filter_map(|line| {
            let mut cells = line.split('|').map(str::trim).skip(1);
            let number = cells.next()?.parse().ok()?;
            Some((number, cells.next()?.to_owned()))
        })
        .collect();
    let in_code: BTreeMap<u8, String> = caudata_telemetry::ExitCode::all()
        .map(|code| (code.number(), format!("{code:?}")))
        .collect();
    assert_eq!(on_page, in_code);
}
