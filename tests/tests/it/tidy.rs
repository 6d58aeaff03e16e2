//! The rules of this repository, as tests: what ARCHITECTURE.md promises about paths and dependencies holds.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cargo_metadata::{DependencyKind, Metadata, MetadataCommand};

fn repository_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("tests/ lies in the repository")
        .to_path_buf()
}

/// The platform that this was built on, as `rustc` names it.
fn host() -> String {
    let answer = std::process::Command::new("rustc").arg("-vV").output();
    let text = String::from_utf8(answer.expect("rustc runs").stdout).expect("UTF-8");
    let host = text.lines().find_map(|line| line.strip_prefix("host: "));
    host.expect("rustc names its host").to_owned()
}

/// Of this platform only: a machine that has just built this has no other platform's packages, and shall not need a network here.
fn metadata() -> Metadata {
    let options = ["--offline", "--locked", "--filter-platform", &host()].map(String::from);
    MetadataCommand::new()
        .manifest_path(repository_root().join("Cargo.toml"))
        .other_options(options)
        .exec()
        .expect("cargo metadata answers from the lock file")
}

/// Names of all packages that `package` links, over normal dependencies, itself excluded.
fn linked_by(metadata: &Metadata, package: &str) -> BTreeSet<String> {
    let resolve = metadata.resolve.as_ref().expect("resolved graph");
    let nodes: BTreeMap<_, _> = resolve.nodes.iter().map(|node| (&node.id, node)).collect();
    let name_of: BTreeMap<_, _> = metadata
        .packages
        .iter()
        .map(|p| (&p.id, p.name.to_string()))
        .collect();
    let start = metadata
        .packages
        .iter()
        .find(|p| p.name.as_str() == package)
        .unwrap_or_else(|| panic!("package {package} exists"));
    let mut open = vec![&start.id];
    let mut seen = BTreeSet::new();
    while let Some(id) = open.pop() {
        for dep in &nodes[id].deps {
            let normal = dep
                .dep_kinds
                .iter()
                .any(|kind| kind.kind == DependencyKind::Normal);
            if normal && seen.insert(name_of[&dep.pkg].clone()) {
                open.push(&dep.pkg);
            }
        }
    }
    seen
}

/// Markdown files whose back-quoted paths must exist.
const MAPS: [&str; 2] = ["ARCHITECTURE.md", "README.md"];

/// A back-quoted word counts as a path when it begins with one of the repository's folders or names a root file; one
/// that begins with `/` is part of a web address.
fn looks_like_a_path(word: &str, root: &Path) -> bool {
    let plain = word
        .chars()
        .all(|c| c.is_ascii_alphanumeric() || "._-/".contains(c));
    let first = word.split('/').next().unwrap_or_default();
    let known_top = root.join(first).exists() || word.ends_with(".md") || word.ends_with('/');
    plain && !first.is_empty() && known_top && (word.contains('/') || word.ends_with(".md"))
}

#[test]
fn every_path_that_the_maps_name_exists() {
    let root = repository_root();
    let mut checked = 0;
    for map in MAPS {
        let text = std::fs::read_to_string(root.join(map)).expect(map);
        for word in text.split('`').skip(1).step_by(2) {
            if looks_like_a_path(word, &root)
                && !word.starts_with("target/")
                && !word.starts_with("runs/")
            {
                assert!(
                    root.join(word).exists(),
                    "{map} names `{word}`, which does not exist"
                );
                checked += 1;
            }
        }
    }
    assert!(
        checked > 20,
        "the maps should name many paths, found {checked}"
    );
}

#[test]
fn every_top_level_folder_is_on_the_map() {
    let root = repository_root();
    let map = std::fs::read_to_string(root.join("ARCHITECTURE.md")).expect("map");
    let listed = std::process::Command::new("git")
        .args(["ls-files"])
        .current_dir(&root)
        .output();
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
fn only_the_learner_links_libtorch() {
    let metadata = metadata();
    for package in metadata.workspace_packages() {
        let links_torch = linked_by(&metadata, package.name.as_str()).contains("tch");
        let is_learner = package.name.as_str() == "caudata-learner";
        assert_eq!(links_torch, is_learner, "{}", package.name);
    }
}

#[test]
fn what_may_depend_on_what() {
    let metadata = metadata();
    // (package, packages that it must not link, why)
    let rules: [(&str, &[&str], &str); 10] = [
        (
            "caudata-deploy",
            &["caudata-sim", "rapier3d", "caudata-env"],
            "the robot runs no simulator",
        ),
        (
            "caudata-hardware",
            &["caudata-sim", "tokio", "caudata-task"],
            "servos and sensors know neither physics nor the task",
        ),
        (
            "caudata-task",
            &["caudata-sim", "tokio", "tonic", "zenoh"],
            "the task is pure",
        ),
        (
            "caudata-sim",
            &["tokio", "tonic", "zenoh", "caudata-task"],
            "physics knows no network and no task",
        ),
        (
            "caudata-env",
            &["tokio", "tonic", "zenoh"],
            "environments know no network",
        ),
        (
            "caudata-transport",
            &["caudata-proto", "caudata-task"],
            "transport moves opaque frames",
        ),
        ("caudata-model", &["tokio", "rapier3d"], "the model is data"),
        (
            "caudata-policy",
            &["caudata-sim", "tokio"],
            "the policy file needs no simulator",
        ),
        (
            "caudata-policy-server",
            &["caudata-sim", "zenoh"],
            "the server stores and serves",
        ),
        (
            "caudata-config",
            &["zenoh", "iceoryx2", "tokio"],
            "configuration is data",
        ),
    ];
    for (package, forbidden, why) in rules {
        let linked = linked_by(&metadata, package);
        for name in forbidden {
            assert!(
                !linked.contains(*name),
                "{package} must not link {name}: {why}"
            );
        }
    }
}

#[test]
fn what_only_tests_need_is_linked_by_no_program() {
    let metadata = metadata();
    for package in metadata.workspace_packages() {
        let linked = linked_by(&metadata, package.name.as_str());
        for name in ["caudata-chaos-proxy", "caudata-left-out"] {
            assert!(!linked.contains(name), "{} links {name}", package.name);
        }
    }
}

#[test]
fn generated_code_stays_in_proto() {
    let metadata = metadata();
    // tonic services are implemented and called with generated types: only the server and the gRPC clients see them.
    let allowed = [
        "caudata-proto",
        "caudata-policy-server",
        "caudata-deploy",
        "caudata-learner",
        "caudata",
        "caudata-policy",
    ];
    for package in metadata.workspace_packages() {
        let uses_prost = package.dependencies.iter().any(|dep| dep.name == "prost");
        assert!(
            !uses_prost || allowed.contains(&package.name.as_str()),
            "{} uses prost; wire types stop at proto/",
            package.name
        );
    }
}

fn rust_files(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("readable folder") {
        let path = entry.expect("entry").path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() && name != "target" && !name.starts_with('.') {
            rust_files(&path, out);
        } else if name.ends_with(".rs") {
            out.push(path);
        }
    }
}

#[test]
fn every_module_says_what_it_is_for() {
    let mut files = Vec::new();
    rust_files(&repository_root(), &mut files);
    assert!(files.len() > 50);
    for file in files {
        let text = std::fs::read_to_string(&file).expect("utf-8");
        let first = text
            .lines()
            .find(|line| !line.trim().is_empty() && !line.starts_with("#!["));
        assert!(
            first.is_some_and(|line| line.starts_with("//!")),
            "{} does not begin with a `//!` line",
            file.display()
        );
    }
}

#[test]
fn every_crate_inherits_the_workspace_lints() {
    let root = repository_root();
    for package in metadata().workspace_packages() {
        let text = std::fs::read_to_string(&package.manifest_path).expect("manifest");
        assert!(
            text.contains("[lints]\nworkspace = true"),
            "{} does not inherit the workspace lints",
            package
                .manifest_path
                .strip_prefix(&root)
                .unwrap_or(&package.manifest_path)
        );
    }
}

#[test]
fn nothing_is_left_to_do_in_the_code() {
    let mut files = Vec::new();
    rust_files(&repository_root(), &mut files);
    let marks = [
        concat!("TO", "DO"),
        concat!("FIX", "ME"),
        concat!("XX", "X:"),
    ];
    for file in files {
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
fn the_page_on_exit_codes_matches_the_code() {
    let page = std::fs::read_to_string(repository_root().join("docs/exit-codes.md")).expect("page");
    let on_page: BTreeMap<u8, String> = page
        .lines()
        .filter_map(|line| {
            let mut cells = line.split('|').map(str::trim).skip(1);
            let number = cells.next()?.parse().ok()?;
            Some((number, cells.next()?.to_owned()))
        })
        .collect();
    let in_code: BTreeMap<u8, String> = caudata_telemetry::ExitCode::ALL
        .into_iter()
        .map(|code| (code.number(), format!("{code:?}")))
        .collect();
    assert_eq!(on_page, in_code);
}
