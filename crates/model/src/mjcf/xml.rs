//! Reading attributes of MJCF elements with errors that name file, line, element and attribute.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use roxmltree::{Document, Node};

use crate::error::ModelError;
use crate::pose;

/// Largest magnitude of any number in a robot file; beyond it something is wrong.
const NUMBER_LIMIT: f64 = 1e9;

/// What every reading function needs: the document and its name.
pub(super) struct Source<'a> {
    pub file: &'a str,
    pub doc: &'a Document<'a>,
}

impl Source<'_> {
    /// An error at `node`; `attribute` names the attribute at fault where there is one.
    pub fn error(
        &self,
        node: Node<'_, '_>,
        attribute: Option<&str>,
        message: impl Into<String>,
    ) -> ModelError {
        let tag = node.tag_name().name();
        let mut element = tag.to_owned();
        if let Some(name) = node.attribute("name") {
            element.push_str(&format!(" name=\"{name}\""));
        }
        let message = match attribute {
            Some(a) => format!("attribute `{a}`: {}", message.into()),
            None => message.into(),
        };
        ModelError::Mjcf {
            file: self.file.to_owned(),
            line: self.doc.text_pos_at(node.range().start).row,
            element,
            message,
        }
    }

    /// Refuses `node`.
    pub fn refuse<T>(
        &self,
        node: Node<'_, '_>,
        message: impl Into<String>,
    ) -> Result<T, ModelError> {
        Err(self.error(node, None, message))
    }

    /// Refuses one attribute of `node`.
    pub fn refuse_attribute<T>(
        &self,
        node: Node<'_, '_>,
        attribute: &str,
        message: impl Into<String>,
    ) -> Result<T, ModelError> {
        Err(self.error(node, Some(attribute), message))
    }

    /// Element children of `node`; refuses stray text.
    pub fn children<'n>(&self, node: Node<'n, 'n>) -> Result<Vec<Node<'n, 'n>>, ModelError> {
        for child in node.children() {
            if child.is_text() && !child.text().unwrap_or("").trim().is_empty() {
                return self.refuse(node, "holds text; MJCF has only elements and attributes");
            }
        }
        Ok(node.children().filter(Node::is_element).collect())
    }

    /// Refuses element children.
    pub fn no_children(&self, node: Node<'_, '_>) -> Result<(), ModelError> {
        match node.children().find(Node::is_element) {
            Some(c) => Err(self.error(
                c,
                None,
                format!("is not supported inside <{}>", node.tag_name().name()),
            )),
            None => Ok(()),
        }
    }

    /// Refuses attributes that are not in `allowed`.
    pub fn only_attributes(&self, node: Node<'_, '_>, allowed: &[&str]) -> Result<(), ModelError> {
        for a in node.attributes() {
            if !allowed.contains(&a.name()) {
                return self.refuse_attribute(
                    node,
                    a.name(),
                    format!(
                        "is outside the supported subset (supported: {})",
                        allowed.join(", ")
                    ),
                );
            }
        }
        Ok(())
    }
}

/// Attribute values that an element takes from its default class.
pub(super) type AttributeMap = BTreeMap<String, String>;

/// One element with its default class resolved.
pub(super) struct Element<'s, 'n> {
    pub source: &'s Source<'s>,
    pub node: Node<'n, 'n>,
    pub defaults: Option<&'s AttributeMap>,
}

impl Element<'_, '_> {
    pub fn error(&self, attribute: &str, message: impl Into<String>) -> ModelError {
        self.source.error(self.node, Some(attribute), message)
    }

    pub fn refuse<T>(&self, attribute: &str, message: impl Into<String>) -> Result<T, ModelError> {
        Err(self.error(attribute, message))
    }

    /// The value of an attribute: the element's own, else its class's.
    pub fn text(&self, attribute: &str) -> Option<&str> {
        self.node.attribute(attribute).or_else(|| {
            self.defaults
                .and_then(|d| d.get(attribute))
                .map(String::as_str)
        })
    }

    pub fn required_text(&self, attribute: &str) -> Result<&str, ModelError> {
        match self.text(attribute) {
            Some(t) if !t.trim().is_empty() => Ok(t),
            _ => Err(self.error(attribute, "is missing")),
        }
    }

    /// Numbers of an attribute, between `min` and `max` of them.
    pub fn numbers(
        &self,
        attribute: &str,
        min: usize,
        max: usize,
    ) -> Result<Option<Vec<f64>>, ModelError> {
        let Some(text) = self.text(attribute) else {
            return Ok(None);
        };
        let mut out = Vec::new();
        for word in text.split_whitespace() {
            let x: f64 = word
                .parse()
                .map_err(|_| self.error(attribute, format!("`{word}` is not a number")))?;
            if !x.is_finite() || x.abs() > NUMBER_LIMIT {
                return self.refuse(attribute, format!("`{word}` is not a usable number"));
            }
            out.push(x);
        }
        if out.len() < min || out.len() > max {
            let need = if min == max {
                format!("{min}")
            } else {
                format!("{min} to {max}")
            };
            return self.refuse(
                attribute,
                format!("has {} numbers where {need} belong", out.len()),
            );
        }
        Ok(Some(out))
    }

    pub fn array<const N: usize>(&self, attribute: &str) -> Result<Option<[f64; N]>, ModelError> {
        let Some(v) = self.numbers(attribute, N, N)? else {
            return Ok(None);
        };
        let mut out = [0.0; N];
        out.copy_from_slice(&v);
        Ok(Some(out))
    }

    pub fn number(&self, attribute: &str) -> Result<Option<f64>, ModelError> {
        Ok(self.array::<1>(attribute)?.map(|a| a[0]))
    }

    /// A number ≥ 0, 0 where the attribute is absent.
    pub fn non_negative(&self, attribute: &str) -> Result<f64, ModelError> {
        let x = self.number(attribute)?.unwrap_or(0.0);
        if x < 0.0 {
            return self.refuse(attribute, format!("is {x}; it must not be negative"));
        }
        Ok(x)
    }

    /// A whole number ≥ 0.
    pub fn bits(&self, attribute: &str, default: u32) -> Result<u32, ModelError> {
        match self.text(attribute) {
            None => Ok(default),
            Some(t) => t
                .trim()
                .parse()
                .map_err(|_| self.error(attribute, format!("`{t}` is not a whole number ≥ 0"))),
        }
    }

    /// A unit vector.
    pub fn direction(&self, attribute: &str) -> Result<Option<[f64; 3]>, ModelError> {
        let Some(v) = self.array::<3>(attribute)? else {
            return Ok(None);
        };
        let n = pose::norm(v);
        if n < 1e-9 {
            return self.refuse(attribute, "has no direction (length zero)");
        }
        Ok(Some(v.map(|x| x / n)))
    }
}

/// Default classes: class name → element → attributes, inheritance already applied.
#[derive(Default)]
pub(super) struct Defaults {
    classes: BTreeMap<String, BTreeMap<String, AttributeMap>>,
}

/// Name that MuJoCo gives the outermost default class.
pub(super) const MAIN_CLASS: &str = "main";
/// Deepest nesting of default classes or bodies.
pub(super) const DEPTH_LIMIT: usize = 64;

impl Defaults {
    /// Reads a top-level `<default>`; `attributes_of` gives the supported attributes of an element inside it.
    pub fn read(
        &mut self,
        source: &Source<'_>,
        node: Node<'_, '_>,
        attributes_of: &dyn Fn(&str) -> Option<&'static [&'static str]>,
    ) -> Result<(), ModelError> {
        let name = node.attribute("class").unwrap_or(MAIN_CLASS).to_owned();
        self.read_class(source, node, name, BTreeMap::new(), attributes_of, 0)
    }

    fn read_class(
        &mut self,
        source: &Source<'_>,
        node: Node<'_, '_>,
        name: String,
        inherited: BTreeMap<String, AttributeMap>,
        attributes_of: &dyn Fn(&str) -> Option<&'static [&'static str]>,
        depth: usize,
    ) -> Result<(), ModelError> {
        source.only_attributes(node, &["class"])?;
        if depth > DEPTH_LIMIT {
            return source.refuse(node, "is nested too deeply");
        }
        let mut own = inherited;
        for child in node.children().filter(Node::is_element) {
            let tag = child.tag_name().name();
            if tag == "default" {
                continue;
            }
            let Some(allowed) = attributes_of(tag) else {
                return source.refuse(child, "is not supported inside <default>");
            };
            source.only_attributes(child, allowed)?;
            source.no_children(child)?;
            let map = own.entry(tag.to_owned()).or_default();
            for a in child.attributes() {
                if matches!(a.name(), "name" | "class") {
                    return source.refuse_attribute(
                        child,
                        a.name(),
                        "does not belong in a default",
                    );
                }
                map.insert(a.name().to_owned(), a.value().to_owned());
            }
        }
        for child in node.children().filter(Node::is_element) {
            if child.tag_name().name() == "default" {
                let Some(class) = child.attribute("class") else {
                    return source.refuse_attribute(child, "class", "is missing");
                };
                self.read_class(
                    source,
                    child,
                    class.to_owned(),
                    own.clone(),
                    attributes_of,
                    depth + 1,
                )?;
            }
        }
        match self.classes.entry(name) {
            Entry::Occupied(e) => Err(source.error(
                node,
                Some("class"),
                format!("`{}` is defined twice", e.key()),
            )),
            Entry::Vacant(e) => {
                e.insert(own);
                Ok(())
            }
        }
    }

    /// The element `node` with its class: its own `class`, else the body's `childclass`, else `main`.
    pub fn element<'s, 'n>(
        &'s self,
        source: &'s Source<'s>,
        node: Node<'n, 'n>,
        childclass: Option<&str>,
    ) -> Result<Element<'s, 'n>, ModelError> {
        let class = node.attribute("class").or(childclass);
        let tags = match (class, self.classes.get(class.unwrap_or(MAIN_CLASS))) {
            (Some(name), None) => {
                let attribute = if node.attribute("class").is_some() {
                    "class"
                } else {
                    "childclass"
                };
                return source.refuse_attribute(
                    node,
                    attribute,
                    format!("there is no default class `{name}`"),
                );
            }
            (_, tags) => tags,
        };
        Ok(Element {
            source,
            node,
            defaults: tags.and_then(|t| t.get(node.tag_name().name())),
        })
    }
}
