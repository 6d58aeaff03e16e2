//! The product's source files: what is shipped, without tests.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::tokens::{self, Token};

/// Packages that are tests through and through.
const TEST_PACKAGES: [&str; 2] = ["tests", "tests/launch"];

/// A source file of the product.
pub struct Source {
    /// Folder of its package, below the repository; the command line's is `.`.
    pub package: String,
    /// Its path below the repository.
    pub path: String,
    /// Without comments and tests.
    pub tokens: Vec<Token>,
    /// Lines of it that are no tests.
    pub lines: usize,
}

/// Where the repository is.
pub fn root() -> PathBuf {
    caudata_tests::repository_root()
}

/// All files below `folder` whose names end with `end`; not what is built, and not what is hidden.
pub fn files(folder: &Path, end: &str) -> Vec<PathBuf> {
    let (mut open, mut out) = (vec![folder.to_owned()], Vec::new());
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(&folder).expect("readable folder") {
            let path = entry.expect("entry").path();
            let name = path.file_name().expect("name").to_string_lossy().into_owned();
            if path.is_dir() && name != "target" && !name.starts_with('.') {
                open.push(path);
            } else if name.ends_with(end) {
                out.push(path);
            }
        }
    }
    out.sort();
    out
}

/// `path` as it is named in this repository.
pub fn below_root(path: &Path) -> String {
    let below = path.strip_prefix(root()).expect("below the repository");
    below.to_string_lossy().into_owned()
}

/// Folders of all packages, tests' included.
pub fn packages() -> Vec<String> {
    let manifests = files(&root(), "Cargo.toml");
    let folder = |m: &PathBuf| below_root(m.parent().expect("folder"));
    let name = |f: String| if f.is_empty() { ".".to_owned() } else { f };
    manifests.iter().map(folder).map(name).collect()
}

/// Every source file of the product.
pub fn sources() -> Vec<Source> {
    let packages = packages();
    let shipped = packages.iter().filter(|p| !TEST_PACKAGES.contains(&p.as_str()));
    shipped.flat_map(|package| of_package(package)).collect()
}

fn of_package(package: &str) -> Vec<Source> {
    let folder = root().join(package).join("src");
    let mut tests: BTreeSet<PathBuf> = BTreeSet::new();
    let mut out = Vec::new();
    for path in files(&folder, ".rs") {
        let text = std::fs::read_to_string(&path).expect("UTF-8");
        let all = tokens::read(&text);
        let (kept, parts) = tokens::without_tests(&all);
        for pair in all.windows(3).filter(|w| w[0].text == "mod" && w[2].text == ";") {
            let is_test = parts.iter().any(|p| (p.0..=p.1).contains(&pair[0].line));
            if is_test || pair[1].text == "tests" {
                tests.insert(children(&path).join(&pair[1].text));
            }
        }
        let lines = text.lines().count() - parts.iter().map(|p| p.1 - p.0 + 1).sum::<usize>();
        let below = below_root(&path);
        let path = below.strip_prefix("./").unwrap_or(&below).to_owned();
        out.push(Source { package: package.to_owned(), path, tokens: kept, lines });
    }
    let is_test = |s: &Source| {
        let path = root().join(&s.path).with_extension("");
        path.ancestors().any(|a| tests.contains(a))
    };
    out.retain(|s| !is_test(s));
    out
}

/// The folder in which the modules that the file at `path` declares lie.
fn children(path: &Path) -> PathBuf {
    let parent = path.parent().expect("folder").to_owned();
    match path.file_stem().and_then(|s| s.to_str()).expect("name") {
        "mod" | "lib" | "main" => parent,
        stem => parent.join(stem),
    }
}
