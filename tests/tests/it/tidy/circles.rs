//! No import circles between the modules of a crate: whoever reads one can read on in one direction.
//!
//! A module is a file. It uses another one where it names something that is defined there, by whatever way
//! the name comes to it. `mod child;` and `pub use child::Name;` are no use; naming what a child has in the
//! code is.

use std::collections::{BTreeMap, BTreeSet};

use super::exceptions::{Offence, hold};
use super::product::{self, Source};
use super::tokens::{self, Token};

/// A path of names, `crate` first: `["crate", "batch", "contact"]`.
type Path = Vec<String>;

/// One file's module.
struct Module {
    children: BTreeSet<String>,
    /// Name here → path as it is written in the `use`.
    imports: BTreeMap<String, Path>,
    /// Modules of which everything is imported.
    globs: Vec<Path>,
    /// Names defined at its top level.
    defined: BTreeSet<String>,
    /// Paths of two names or more that its code has, and single names.
    named: BTreeSet<Path>,
}

struct Crate {
    modules: BTreeMap<Path, Module>,
}

#[test]
fn modules_do_not_import_in_circles() {
    let mut offences = Vec::new();
    let sources = product::sources();
    let packages: BTreeSet<&String> = sources.iter().map(|s| &s.package).collect();
    for package in packages {
        for root in ["lib", "main"] {
            let folder = if package == "." { "src/".to_owned() } else { format!("{package}/src/") };
            let files: BTreeMap<&str, &Source> = (sources.iter())
                .filter_map(|s| Some((s.path.strip_prefix(&folder)?.strip_suffix(".rs")?, s)))
                .collect();
            let mut whole = Crate { modules: BTreeMap::new() };
            whole.add(&files, root, vec!["crate".into()]);
            for circle in whole.circles() {
                let what = format!("{}{}", circle.join(" "), whole.story(&circle));
                offences.push(Offence::new(format!("{folder}{root}.rs"), what));
            }
        }
    }
    hold("import circle", offences);
}

impl Crate {
    /// Adds the module in `file` (without `.rs`), and those that it declares.
    fn add(&mut self, files: &BTreeMap<&str, &Source>, file: &str, path: Path) {
        let Some(source) = files.get(file) else {
            return;
        };
        let module = Module::read(&source.tokens);
        let folder = match file.rsplit_once('/') {
            _ if file == "lib" || file == "main" => String::new(),
            Some((folder, "mod")) => format!("{folder}/"),
            _ => format!("{file}/"),
        };
        for child in &module.children {
            let below = [path.clone(), vec![child.clone()]].concat();
            self.add(files, &format!("{folder}{child}"), below.clone());
            self.add(files, &format!("{folder}{child}/mod"), below);
        }
        self.modules.insert(path, module);
    }

    /// Where what `names` means in the module `here` is defined; `None`: in another crate, or it is a module.
    fn resolve(&self, here: &Path, names: &[String], depth: usize) -> Option<Path> {
        let first = names.first()?;
        let module = self.modules.get(here)?;
        let (start, rest) = match first.as_str() {
            "crate" => (here[..1].to_vec(), &names[1..]),
            "self" => (here.clone(), &names[1..]),
            "super" => {
                let up = names.iter().take_while(|n| *n == "super").count();
                (here[..here.len().checked_sub(up)?].to_vec(), &names[up..])
            }
            name if module.children.contains(name) => (here.clone(), names),
            name => {
                let imported = module.imports.get(name).filter(|_| depth < 9)?;
                let path = [imported, &names[1..]].concat();
                return self.resolve(here, &path, depth + 1);
            }
        };
        self.look_up(&start, rest, depth)
    }

    fn look_up(&self, at: &Path, names: &[String], depth: usize) -> Option<Path> {
        let module = self.modules.get(at)?;
        let name = names.first()?;
        if module.children.contains(name) {
            let child = [at.clone(), vec![name.clone()]].concat();
            return self.look_up(&child, &names[1..], depth);
        }
        if depth < 9 && !module.defined.contains(name) {
            if module.imports.contains_key(name) {
                return self.resolve(at, names, depth + 1);
            }
            for glob in &module.globs {
                let from =
                    self.resolve(at, &[glob.clone(), vec![name.clone()]].concat(), depth + 1);
                if from.as_ref().is_some_and(|m| self.modules[m].defined.contains(name)) {
                    return from;
                }
            }
        }
        Some(at.clone())
    }

    /// Module → the modules that it uses, each with a name that it takes from there.
    fn uses(&self) -> BTreeMap<&Path, BTreeMap<Path, String>> {
        let mut all = BTreeMap::new();
        for (here, module) in &self.modules {
            let mut used = BTreeMap::new();
            let imported = module
                .imports
                .iter()
                .filter(|(name, _)| module.named.iter().any(|path| path[0] == **name));
            let through_globs = module.globs.iter().flat_map(|glob| {
                let single = module.named.iter().map(|path| &path[0]);
                single.map(move |name| [glob.clone(), vec![name.clone()]].concat())
            });
            let through_globs = through_globs.filter(|path| {
                let name = &path[path.len() - 1];
                let from = self.resolve(here, path, 0);
                !module.defined.contains(name)
                    && from.is_some_and(|m| self.modules[&m].defined.contains(name))
            });
            let paths = module.named.iter().filter(|path| path.len() > 1).cloned();
            for path in imported.map(|(_, path)| path.clone()).chain(paths).chain(through_globs) {
                if let Some(from) = self.resolve(here, &path, 0).filter(|from| from != here) {
                    used.entry(from).or_insert_with(|| path.join("::"));
                }
            }
            all.insert(here, used);
        }
        all
    }

    /// Sets of modules of which each uses each, directly or over others.
    fn circles(&self) -> Vec<Vec<String>> {
        let uses = self.uses();
        let reached = |from: &Path| {
            let (mut open, mut seen) = (vec![from.clone()], BTreeSet::new());
            while let Some(module) = open.pop() {
                for next in uses[&module].keys() {
                    if seen.insert(next.clone()) {
                        open.push(next.clone());
                    }
                }
            }
            seen
        };
        let reach: BTreeMap<&Path, BTreeSet<Path>> =
            uses.keys().map(|m| (*m, reached(m))).collect();
        let mut circles: BTreeSet<Vec<String>> = BTreeSet::new();
        for (module, far) in &reach {
            let both = far.iter().filter(|other| reach[other].contains(*module));
            let circle: Vec<String> = both.map(|m| m.join("::")).collect();
            if circle.len() > 1 {
                circles.insert(circle);
            }
        }
        circles.into_iter().collect()
    }

    /// Who takes what from whom in a circle.
    fn story(&self, circle: &[String]) -> String {
        let mut lines = String::new();
        for (module, used) in self.uses() {
            for (from, name) in used {
                if circle.contains(&module.join("::")) && circle.contains(&from.join("::")) {
                    lines += &format!(
                        "\n    {} takes {name} from {}",
                        module.join("::"),
                        from.join("::")
                    );
                }
            }
        }
        lines
    }
}

impl Module {
    fn read(t: &[Token]) -> Self {
        let mut module = Self {
            children: BTreeSet::new(),
            imports: BTreeMap::new(),
            globs: Vec::new(),
            defined: BTreeSet::new(),
            named: BTreeSet::new(),
        };
        let (mut i, mut depth) = (0, 0);
        while i < t.len() {
            let next = t.get(i + 1).map_or("", |token| token.text.as_str());
            match t[i].text.as_str() {
                "{" => depth += 1,
                "}" => depth -= 1,
                "use" if next != "<" => {
                    let end = (i..t.len()).find(|&k| t[k].text == ";").unwrap_or(t.len() - 1);
                    module.import(&t[i + 1..end], &[]);
                    i = end;
                }
                "mod" if t.get(i + 2).is_some_and(|token| token.text == ";") => {
                    module.children.insert(next.to_owned());
                    i += 2;
                }
                "fn" | "struct" | "enum" | "trait" | "type" | "const" | "static" | "union"
                | "mod"
                    if depth == 0 =>
                {
                    module.defined.insert(next.to_owned());
                }
                _ if t[i].is_word() && !(i > 0 && t[i - 1].text == ".") => {
                    let mut path = vec![t[i].text.clone()];
                    while t.get(i + 1).is_some_and(|s| s.text == "::")
                        && t.get(i + 2).is_some_and(Token::is_word)
                    {
                        path.push(t[i + 2].text.clone());
                        i += 2;
                    }
                    module.named.insert(path);
                }
                _ => {}
            }
            i += 1;
        }
        module
    }

    /// Reads one tree of a `use`, below `prefix`.
    fn import(&mut self, tree: &[Token], prefix: &[String]) {
        let mut path = prefix.to_vec();
        let mut i = 0;
        while i < tree.len() {
            match tree[i].text.as_str() {
                "::" => {}
                "*" => {
                    self.globs.push(path);
                    return;
                }
                "{" => {
                    let end = tokens::closing(tree, i);
                    let mut from = i + 1;
                    while from < end {
                        let mut to = from;
                        while to < end && tree[to].text != "," {
                            to = if tree[to].text == "{" {
                                tokens::closing(tree, to) + 1
                            } else {
                                to + 1
                            };
                        }
                        self.import(&tree[from..to], &path);
                        from = to + 1;
                    }
                    return;
                }
                "as" => {
                    self.imports.insert(tree[i + 1].text.clone(), path);
                    return;
                }
                "self" if !path.is_empty() => {}
                name => path.push(name.to_owned()),
            }
            i += 1;
        }
        if let Some(name) = path.last().cloned() {
            self.imports.insert(name, path);
        }
    }
}

#[test]
fn a_circle_is_found_by_whatever_way_it_goes() {
    let files = |list: &[(&str, &str)]| -> Vec<(String, Source)> {
        let source = |(name, text): &(&str, &str)| {
            let tokens = tokens::read(text);
            let source = Source { package: ".".into(), path: (*name).into(), tokens, lines: 1 };
            ((*name).to_owned(), source)
        };
        list.iter().map(source).collect()
    };
    let circles = |list: &[(&str, &str)]| {
        let held = files(list);
        let by_name = held.iter().map(|(name, source)| (name.as_str(), source)).collect();
        let mut whole = Crate { modules: BTreeMap::new() };
        whole.add(&by_name, "lib", vec!["crate".into()]);
        whole.circles()
    };
    let root = ("lib", "mod a; mod b; pub use a::A; pub use b::B;");
    // One way only, over the root's other name for it.
    assert!(
        circles(&[root, ("a", "pub struct A;"), ("b", "use crate::A; pub struct B(A);")])
            .is_empty()
    );
    let round = circles(&[
        root,
        ("a", "pub struct A(super::b::B);"),
        ("b", "use crate::A; pub struct B(A);"),
    ]);
    assert_eq!(round, [["crate::a", "crate::b"]]);
    // A child that takes from its parent, which takes from the child.
    let child = circles(&[
        ("lib", "mod a;"),
        ("a", "mod c; use c::f; pub const N: u8 = 1; fn g() { f() }"),
        ("a/c", "use super::*; pub fn f() -> u8 { N }"),
    ]);
    assert_eq!(child, [["crate::a", "crate::a::c"]]);
    // An import that is passed on and not used is none.
    let passed_on = [
        ("lib", "mod a;"),
        ("a", "mod c; pub use c::f; pub const N: u8 = 1;"),
        ("a/c", "use super::N; pub fn f() -> u8 { N }"),
    ];
    assert!(circles(&passed_on).is_empty());
}
