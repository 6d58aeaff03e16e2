//! An XML file as a tree of its own, and the remarks made about it.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::io::ErrorKind;
use std::path::Path;
use std::sync::Arc;

use caudata_durable::read_at_most;
use roxmltree::{Document, Node};

use crate::error::{ModelError, Remark};

/// Largest robot file or MJCF that is read.
const FILE_LIMIT_BYTES: u64 = 16 * 1024 * 1024;
/// Deepest nesting of elements: 64 bodies in each other, and what stands around and in them.
const DEPTH_LIMIT: usize = 68;
/// Deepest chain of includes.
const INCLUDE_LIMIT: usize = 16;
/// Most files that are included in all: one that includes itself twice would be 2¹⁶.
const INCLUDED_LIMIT: usize = 256;
/// Largest magnitude of any number.
const NUMBER_LIMIT: f64 = 1e9;

/// An element.
#[derive(Clone, Debug, Default)]
pub(crate) struct Element {
    pub tag: String,
    pub attributes: BTreeMap<String, String>,
    /// File and line of attributes that stand elsewhere: in a default class.
    pub elsewhere: BTreeMap<String, Arc<(String, u32)>>,
    pub children: Vec<Element>,
    /// Whether text stands in it.
    pub has_text: bool,
    pub file: String,
    pub line: u32,
    /// Whether its tag is a macro of xacro.
    pub of_xacro: bool,
}

/// All that was said.
#[derive(Default)]
pub(crate) struct Remarks {
    /// Whether the file is a robot's own, in which nothing may be passed over in silence.
    pub strict: bool,
    pub notes: Vec<Remark>,
    pub refusals: Vec<Remark>,
}

impl Remarks {
    pub fn note(&mut self, at: &Element, message: impl Into<String>) {
        self.notes.push(at.remark(message));
    }

    pub fn refuse(&mut self, at: &Element, message: impl Into<String>) {
        self.refusals.push(at.remark(message));
    }

    /// A note of an element, which is named in front.
    pub fn note_of(&mut self, at: &Element, message: impl Display) {
        self.notes.push(at.remark_of(message));
    }

    /// A refusal, likewise; once for a value of a default class, whoever takes it over.
    pub fn refuse_of(&mut self, at: &Element, message: impl Display) {
        let remark = at.remark_of(message);
        if !self.refusals.contains(&remark) {
            self.refusals.push(remark);
        }
    }

    /// A refusal of what is let pass in a file of another tool.
    pub fn refuse_if_strict(&mut self, at: &Element, message: impl Display) {
        if self.strict {
            self.refuse_of(at, message);
        }
    }

    /// A refusal of no line in particular.
    pub fn refuse_plain(&mut self, file: &str, message: String) {
        let file = file.to_owned();
        self.refusals.push(Remark { file, line: 0, message });
    }

    /// A note that stands for many of one kind.
    pub fn note_once(&mut self, at: &Element, message: impl Into<String>) {
        let remark = at.remark(message);
        if !self.notes.iter().any(|n| n.message == remark.message) {
            self.notes.push(remark);
        }
    }
}

impl Element {
    pub fn remark(&self, message: impl Into<String>) -> Remark {
        Remark { file: self.file.clone(), line: self.line, message: message.into() }
    }

    /// A remark of the element, which is named in front; where the attribute that the message begins with is a
    /// default class's, a remark of that class.
    pub fn remark_of(&self, message: impl Display) -> Remark {
        let message = message.to_string();
        let attribute = message.strip_prefix("attribute `").and_then(|m| m.split('`').next());
        match attribute.and_then(|a| self.elsewhere.get(a)) {
            Some(place) => {
                let (file, line) = (**place).clone();
                Remark { file, line, message: format!("<{}> of a default: {message}", self.tag) }
            }
            None => self.remark(format!("{}: {message}", self.label())),
        }
    }

    pub fn get(&self, attribute: &str) -> Option<&str> {
        self.attributes.get(attribute).map(String::as_str)
    }

    /// `<tag name="…">`, to speak of it.
    pub fn label(&self) -> String {
        match self.get("name") {
            Some(name) => format!("<{} name=\"{name}\">", self.tag),
            None => format!("<{}>", self.tag),
        }
    }

    pub fn all<'a>(&'a self, tag: &'a str) -> impl Iterator<Item = &'a Element> {
        self.children.iter().filter(move |c| c.tag == tag)
    }

    pub fn first(&self, tag: &str) -> Option<&Element> {
        self.children.iter().find(|c| c.tag == tag)
    }

    /// The first of it and what it holds that is such.
    pub fn find(&self, such: &impl Fn(&Self) -> bool) -> Option<&Self> {
        if such(self) {
            return Some(self);
        }
        self.children.iter().find_map(|c| c.find(such))
    }

    /// Numbers of an attribute; `None`: absent, or refused.
    pub fn numbers(&self, attribute: &str, remarks: &mut Remarks) -> Option<Vec<f64>> {
        let text = self.get(attribute)?;
        let mut out = Vec::new();
        for word in text.split_whitespace() {
            match word.parse::<f64>() {
                Ok(x) if x.is_finite() && x.abs() <= NUMBER_LIMIT => out.push(x),
                _ => {
                    let message =
                        format!("attribute `{attribute}`: `{word}` is not a usable number");
                    remarks.refuse_of(self, message);
                    return None;
                }
            }
        }
        Some(out)
    }

    /// At most `most` numbers of an attribute, and at least one.
    pub fn some_numbers(
        &self,
        attribute: &str,
        most: usize,
        remarks: &mut Remarks,
    ) -> Option<Vec<f64>> {
        let numbers = self.numbers(attribute, remarks)?;
        if !(1..=most).contains(&numbers.len()) {
            let found = numbers.len();
            let message =
                format!("attribute `{attribute}`: has {found} numbers where 1 to {most} belong");
            remarks.refuse_if_strict(self, message);
        }
        Some(numbers)
    }

    /// Exactly `N` numbers of an attribute.
    pub fn array<const N: usize>(
        &self,
        attribute: &str,
        remarks: &mut Remarks,
    ) -> Option<[f64; N]> {
        let numbers = self.numbers(attribute, remarks)?;
        let found = numbers.len();
        let array = numbers.try_into().ok();
        if array.is_none() {
            let message = format!("attribute `{attribute}`: has {found} numbers where {N} belong");
            remarks.refuse_of(self, message);
        }
        array
    }

    /// Refuses a mass that is none; one to go on with, so that no more is said of it, kg.
    pub fn no_mass(&self, attribute: &str, remarks: &mut Remarks) -> f64 {
        let mass = self.get(attribute).unwrap_or_default();
        let message = format!("attribute `{attribute}`: is {mass} kg; it must be above zero");
        remarks.refuse_of(self, message);
        1.0
    }

    pub fn number(&self, attribute: &str, remarks: &mut Remarks) -> Option<f64> {
        self.array::<1>(attribute, remarks).map(|[x]| x)
    }

    /// A number that is refused below zero.
    pub fn not_negative(&self, attribute: &str, remarks: &mut Remarks) -> Option<f64> {
        let number = self.number(attribute, remarks)?;
        if number < 0.0 {
            let message = format!("attribute `{attribute}`: is {number}; it must not be negative");
            remarks.refuse_of(self, message);
            return None;
        }
        Some(number)
    }

    /// Refuses attributes that are one letter off a known one, and notes others that are not known.
    pub fn misspelt(&self, known: &[&str], remarks: &mut Remarks) {
        for key in self.attributes.keys().filter(|key| !known.contains(&key.as_str())) {
            if let Some(meant) = meant(key, known) {
                let message = format!("attribute `{key}`: is not known; did you mean `{meant}`?");
                remarks.refuse_of(self, message);
            } else {
                let message = format!("<{}>: attribute `{key}` is not read", self.tag);
                remarks.note_once(self, message);
            }
        }
    }
}

/// The known word that another one is one letter off; of two letters each, all words are alike.
pub(crate) fn meant<'a>(word: &str, known: &[&'a str]) -> Option<&'a str> {
    let slip = |k: &&&str| k.len().max(word.len()) > 2 && strsim::osa_distance(k, word) == 1;
    known.iter().find(slip).copied()
}

/// The bytes of a file, if there are not too many.
pub(crate) fn bytes(path: &Path) -> Result<Vec<u8>, ModelError> {
    read_at_most(path, FILE_LIMIT_BYTES).map_err(|source| match source.kind() {
        ErrorKind::FileTooLarge => {
            ModelError::TooLarge { file: path.display().to_string(), limit: FILE_LIMIT_BYTES }
        }
        _ => ModelError::Read { path: path.to_owned(), of: None, source },
    })
}

/// Reads a file and everything that it includes.
pub(crate) fn read(file: &Path, remarks: &mut Remarks) -> Result<Element, ModelError> {
    let mut root = parse(file)?;
    include(&mut root, [file, file], remarks, (0, &mut 0));
    Ok(root)
}

fn parse(file: &Path) -> Result<Element, ModelError> {
    let bytes = bytes(file)?;
    if bytes.starts_with(b"\xff\xfe") || bytes.starts_with(b"\xfe\xff") {
        let message = "is UTF-16; save it as UTF-8".to_owned();
        return Err(ModelError::Xml(Remark { file: file.display().to_string(), line: 1, message }));
    }
    of_text(&file.display().to_string(), &String::from_utf8_lossy(&bytes))
}

/// What a text holds; `file` names it.
pub(crate) fn of_text(file: &str, text: &str) -> Result<Element, ModelError> {
    let wrong = |line: u32, message: String| {
        ModelError::Xml(Remark { file: file.to_owned(), line, message })
    };
    let document = Document::parse(text).map_err(|e| match e {
        roxmltree::Error::DtdDetected => {
            let before = text.split("<!DOCTYPE").next().unwrap_or_default();
            wrong(lines(before), "a <!DOCTYPE …> is not read; take it out".to_owned())
        }
        // told at line 1 by the parser
        roxmltree::Error::UnclosedRootNode | roxmltree::Error::UnexpectedEndOfStream => {
            wrong(lines(text.trim_end()), format!("not well-formed XML, at its end: {e}"))
        }
        _ => wrong(e.pos().row, format!("not well-formed XML: {e}")),
    })?;
    own(&document, document.root_element(), file, 0)
        .ok_or_else(|| wrong(0, format!("elements nest more than {DEPTH_LIMIT} deep")))
}

/// The line that a text ends in.
fn lines(text: &str) -> u32 {
    1 + text.matches('\n').count() as u32
}

/// The element and what it holds; `None`: it nests too deeply.
fn own(document: &Document<'_>, node: Node<'_, '_>, file: &str, depth: usize) -> Option<Element> {
    if depth > DEPTH_LIMIT {
        return None;
    }
    let attribute = |a: roxmltree::Attribute<'_, '_>| (a.name().to_owned(), a.value().to_owned());
    let children = node.children().filter(Node::is_element);
    let is_text = |n: Node<'_, '_>| n.is_text() && !n.text().unwrap_or("").trim().is_empty();
    Some(Element {
        tag: node.tag_name().name().to_owned(),
        attributes: node.attributes().map(attribute).collect(),
        elsewhere: BTreeMap::new(),
        children: children.map(|c| own(document, c, file, depth + 1)).collect::<Option<_>>()?,
        has_text: node.children().any(is_text),
        file: file.to_owned(),
        line: document.text_pos_at(node.range().start).row,
        // by its prefix: the address behind it has changed over the years
        of_xacro: document.input_text()[node.range()].starts_with("<xacro:"),
    })
}

/// Puts the children of included files in the place of `<include>`: they lie beside the outermost file, or the one
/// that includes them. `depth` of the chain, and `count` of all files.
fn include(
    element: &mut Element,
    [outermost, file]: [&Path; 2],
    remarks: &mut Remarks,
    (depth, count): (usize, &mut usize),
) {
    let mut children = Vec::with_capacity(element.children.len());
    for mut child in std::mem::take(&mut element.children) {
        if child.tag != "include" || child.of_xacro {
            include(&mut child, [outermost, file], remarks, (depth, count));
            children.push(child);
            continue;
        }
        let Some(name) = child.get("file") else {
            remarks.refuse(&child, "<include> names no file");
            continue;
        };
        if depth >= INCLUDE_LIMIT {
            remarks.refuse(&child, format!("<include> nests more than {INCLUDE_LIMIT} files"));
            continue;
        }
        *count += 1;
        if *count > INCLUDED_LIMIT {
            if *count == INCLUDED_LIMIT + 1 {
                let message = format!("more than {INCLUDED_LIMIT} files are included in all");
                remarks.refuse(&child, message);
            }
            continue;
        }
        let beside = [outermost, file].map(|file| file.with_file_name("").join(name));
        let path = beside.iter().find(|path| path.is_file()).unwrap_or(&beside[1]);
        match parse(path) {
            Ok(mut included) => {
                include(&mut included, [outermost, path], remarks, (depth + 1, count));
                children.append(&mut included.children);
            }
            Err(error) => remarks.refuse(&child, format!("<include>: {error}")),
        }
    }
    element.children = children;
}
