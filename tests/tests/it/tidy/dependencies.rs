//! What may depend on what, and that nothing is declared for nobody.

use std::collections::{BTreeMap, BTreeSet};

use cargo_metadata::{DependencyKind, Metadata, MetadataCommand};

use super::exceptions::{Offence, hold};
use super::product::{self, root};
use super::tokens::{self, Token};

/// The platform that this was built on, as `rustc` names it.
fn host() -> String {
    let answer = std::process::Command::new("rustc").arg("-vV").output();
    let text = String::from_utf8(answer.expect("rustc runs").stdout).expect("UTF-8");
    let host = text.lines().find_map(|line| line.strip_prefix("host: "));
    host.expect("rustc names its host").to_owned()
}

/// What cargo knows of the workspace and of this platform's dependencies: a machine that has just built this
/// has no other platform's packages, and shall not need a network here.
fn metadata() -> Metadata {
    let options = ["--offline", "--locked", "--filter-platform", &host()].map(String::from);
    MetadataCommand::new()
        .manifest_path(root().join("Cargo.toml"))
        .other_options(options)
        .exec()
        .expect("cargo metadata answers from the lock file")
}

/// Names of all packages that `package` links, over normal dependencies, itself excluded.
fn linked_by(metadata: &Metadata, package: &str) -> BTreeSet<String> {
    let resolve = metadata.resolve.as_ref().expect("resolved graph");
    let nodes: BTreeMap<_, _> = resolve.nodes.iter().map(|node| (&node.id, node)).collect();
    let name_of: BTreeMap<_, _> =
        metadata.packages.iter().map(|p| (&p.id, p.name.to_string())).collect();
    let start = metadata
        .packages
        .iter()
        .find(|p| p.name.as_str() == package)
        .unwrap_or_else(|| panic!("package {package} exists"));
    let mut open = vec![&start.id];
    let mut seen = BTreeSet::new();
    while let Some(id) = open.pop() {
        for dep in &nodes[id].deps {
            let normal = dep.dep_kinds.iter().any(|kind| kind.kind == DependencyKind::Normal);
            if normal && seen.insert(name_of[&dep.pkg].clone()) {
                open.push(&dep.pkg);
            }
        }
    }
    seen
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
        ("caudata-task", &["caudata-sim", "tokio", "tonic", "zenoh"], "the task is pure"),
        (
            "caudata-sim",
            &["tokio", "tonic", "zenoh", "caudata-task"],
            "physics knows no network and no task",
        ),
        ("caudata-env", &["tokio", "tonic", "zenoh"], "environments know no network"),
        ("caudata-transport", &["caudata-proto", "caudata-task"], "transport moves opaque frames"),
        ("caudata-model", &["tokio", "rapier3d"], "the model is data"),
        ("caudata-policy", &["caudata-sim", "tokio"], "the policy file needs no simulator"),
        ("caudata-policy-server", &["caudata-sim", "zenoh"], "the server stores and serves"),
        ("caudata-config", &["zenoh", "iceoryx2", "tokio"], "configuration is data"),
    ];
    for (package, forbidden, why) in rules {
        let linked = linked_by(&metadata, package);
        for name in forbidden {
            assert!(!linked.contains(*name), "{package} must not link {name}: {why}");
        }
    }
}

#[test]
fn what_only_tests_need_is_linked_by_no_program() {
    let metadata = metadata();
    for package in metadata.workspace_packages() {
        let linked = linked_by(&metadata, package.name.as_str());
        let tests = ["caudata-chaos-proxy", "caudata-fuzz", "caudata-rehearsal"];
        if tests.contains(&package.name.as_str()) {
            continue;
        }
        for name in tests {
            assert!(!linked.contains(name), "{} links {name}", package.name);
        }
    }
}

#[test]
fn generated_code_stays_in_proto() {
    let metadata = metadata();
    // tonic services are implemented and called with generated types: only the server and the gRPC clients
    // see them. TensorBoard's files are messages, too.
    let allowed = [
        "caudata-proto",
        "caudata-policy-server",
        "caudata-fuzz",
        "caudata-telemetry",
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

#[test]
fn every_crate_inherits_the_workspace_lints() {
    let root = root();
    for package in metadata().workspace_packages() {
        let text = std::fs::read_to_string(&package.manifest_path).expect("manifest");
        assert!(
            text.contains("[lints]\nworkspace = true"),
            "{} does not inherit the workspace lints",
            package.manifest_path.strip_prefix(&root).unwrap_or(&package.manifest_path)
        );
    }
}

#[test]
fn nothing_is_declared_that_nobody_uses() {
    let mut offences = Vec::new();
    let mut wanted = BTreeSet::new();
    for package in product::packages() {
        let folder = root().join(&package);
        let manifest = read_manifest(&folder);
        let mut words = BTreeSet::new();
        for part in ["src", "tests", "benches", "examples"].map(|part| folder.join(part)) {
            let files = if part.is_dir() { product::files(&part, ".rs") } else { Vec::new() };
            // Packages below this one's folder count for themselves.
            let own = files.iter().filter(|file| folder_of_package(file) == folder);
            words.extend(own.flat_map(|file| words_of(file)));
        }
        if folder.join("build.rs").is_file() {
            words.extend(words_of(&folder.join("build.rs")));
        }
        for section in [
            "dependencies",
            "dev-dependencies",
            "build-dependencies",
            "target.'cfg(fuzzing)'.dependencies",
        ] {
            for name in names_in(&manifest, section) {
                if !words.contains(&name.replace('-', "_")) {
                    let what =
                        format!("[{section}] declares it, and no source of this package names it");
                    offences.push(Offence::new(format!("{package} {name}"), what));
                }
                wanted.insert(name);
            }
        }
    }
    for name in names_in(&read_manifest(&root()), "workspace.dependencies") {
        if !wanted.contains(&name) {
            let what = "[workspace.dependencies] declares it, and no package asks for it";
            offences.push(Offence::new(format!("workspace {name}"), what));
        }
    }
    hold("unused dependency", offences);
}

fn read_manifest(folder: &std::path::Path) -> String {
    std::fs::read_to_string(folder.join("Cargo.toml")).expect("manifest")
}

fn folder_of_package(file: &std::path::Path) -> &std::path::Path {
    let mut above = file.ancestors().skip(1);
    above.find(|folder| folder.join("Cargo.toml").is_file()).expect("a package")
}

fn words_of(file: &std::path::Path) -> Vec<String> {
    let text = std::fs::read_to_string(file).expect("UTF-8");
    let words = tokens::read(&text).into_iter().filter(Token::is_word);
    words.map(|token| token.text).collect()
}

/// Keys of the table `[section]` of a manifest.
fn names_in(manifest: &str, section: &str) -> Vec<String> {
    let head = format!("[{section}]");
    let lines = manifest.lines().skip_while(|line| **line != head).skip(1);
    lines
        .take_while(|line| !line.starts_with('['))
        .filter(|line| line.starts_with(|c: char| c.is_ascii_alphabetic()))
        .map(|line| line.split(['.', ' ', '=']).next().unwrap_or_default().to_owned())
        .collect()
}
