//! An XML file as a tree of its own, with what it includes in place, and the remarks made about it.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::Path;

use roxmltree::{Document, Node};

use super::remark::Remark;
use crate::error::ModelError;
use crate::load;

/// Deepest chain of includes.
const INCLUDE_LIMIT: usize = 16;
/// Largest magnitude of any number.
const NUMBER_LIMIT: f64 = 1e9;

/// An element.
#[derive(Clone, Debug, Default)]
pub(super) struct Element {
    pub tag: String,
    pub attributes: BTreeMap<String, String>,
    pub children: Vec<Element>,
    pub file: String,
    pub line: u32,
    /// Whether its tag is a macro of xacro.
    pub of_xacro: bool,
}

/// All that was said.
#[derive(Default)]
pub(super) struct Remarks {
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
        self.note(at, format!("{}: {message}", at.label()));
    }

    /// A refusal, likewise.
    pub fn refuse_of(&mut self, at: &Element, message: impl Display) {
        self.refuse(at, format!("{}: {message}", at.label()));
    }

    /// A refusal of no line in particular.
    pub fn refuse_plain(&mut self, file: &str, message: String) {
        let file = file.to_owned();
        self.refusals.push(Remark {
            file,
            line: 0,
            message,
        });
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
    fn remark(&self, message: impl Into<String>) -> Remark {
        Remark {
            file: self.file.clone(),
            line: self.line,
            message: message.into(),
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
                    remarks.refuse_of(
                        self,
                        format!("`{attribute}`: `{word}` is not a usable number"),
                    );
                    return None;
                }
            }
        }
        Some(out)
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
            let message = format!("`{attribute}` has {found} numbers where {N} belong");
            remarks.refuse_of(self, message);
        }
        array
    }

    pub fn number(&self, attribute: &str, remarks: &mut Remarks) -> Option<f64> {
        self.array::<1>(attribute, remarks).map(|[x]| x)
    }
}

/// Reads a file and everything that it includes.
pub(super) fn read(file: &Path, remarks: &mut Remarks) -> Result<Element, ModelError> {
    let mut root = parse(file)?;
    include(&mut root, file, remarks, 0);
    Ok(root)
}

fn parse(file: &Path) -> Result<Element, ModelError> {
    let bytes = load::read(file)?;
    let label = file.display().to_string();
    let text = String::from_utf8_lossy(&bytes);
    let document = Document::parse(&text).map_err(|e| ModelError::Xml {
        file: label.clone(),
        message: e.to_string(),
    })?;
    Ok(own(&document, document.root_element(), &label))
}

fn own(document: &Document<'_>, node: Node<'_, '_>, file: &str) -> Element {
    let attribute = |a: roxmltree::Attribute<'_, '_>| (a.name().to_owned(), a.value().to_owned());
    let children = node.children().filter(Node::is_element);
    Element {
        tag: node.tag_name().name().to_owned(),
        attributes: node.attributes().map(attribute).collect(),
        children: children.map(|c| own(document, c, file)).collect(),
        file: file.to_owned(),
        line: document.text_pos_at(node.range().start).row,
        of_xacro: node
            .tag_name()
            .namespace()
            .is_some_and(|name| name.contains("xacro")),
    }
}

/// Puts the children of included files in the place of `<include>`.
fn include(element: &mut Element, file: &Path, remarks: &mut Remarks, depth: usize) {
    let mut children = Vec::with_capacity(element.children.len());
    for mut child in std::mem::take(&mut element.children) {
        if child.tag != "include" || child.of_xacro {
            include(&mut child, file, remarks, depth);
            children.push(child);
            continue;
        }
        let Some(name) = child.get("file") else {
            remarks.refuse(&child, "<include> names no file");
            continue;
        };
        if depth >= INCLUDE_LIMIT {
            remarks.refuse(
                &child,
                format!("<include> nests more than {INCLUDE_LIMIT} files"),
            );
            continue;
        }
        let path = file.with_file_name("").join(name);
        match parse(&path) {
            Ok(mut included) => {
                include(&mut included, &path, remarks, depth + 1);
                children.append(&mut included.children);
            }
            Err(error) => remarks.refuse(&child, format!("<include>: {error}")),
        }
    }
    element.children = children;
}
