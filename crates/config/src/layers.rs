//! Defaults, preset, file and overrides, laid on top of each other.

use std::path::{Path, PathBuf};

use caudata_model::RobotModel;
use toml::{Table, Value};

use crate::derive::derived;
use crate::{Config, ConfigError, PRESETS, Preset, keys};

/// Largest file that is read, bytes; all keys with their values take 8,000.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// Where a configuration comes from. Later fields win over earlier ones.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Source {
    /// Name of a preset.
    pub preset: Option<String>,
    /// A TOML file; keys it does not have come from the preset and the defaults.
    pub file: Option<PathBuf>,
    /// `a.b=c`, in order.
    pub overrides: Vec<String>,
}

impl Source {
    /// A preset alone.
    pub fn preset(name: &str) -> Self {
        Self { preset: Some(name.to_owned()), ..Self::default() }
    }

    /// A file alone.
    pub fn file(path: &Path) -> Self {
        Self { file: Some(path.to_owned()), ..Self::default() }
    }

    /// With one more override.
    pub fn set(mut self, assignment: impl Into<String>) -> Self {
        self.overrides.push(assignment.into());
        self
    }
}

/// Lays the layers on top of each other; the result has the right types, its values are not checked.
fn merge(source: &Source) -> Result<Config, ConfigError> {
    let layers = with_derived(source, layers(source)?)?;
    lay(keys::table_of(&Config::default()), &layers)
}

/// Lays layers, each with where it comes from, over all keys of a configuration.
pub(crate) fn lay(mut merged: Table, layers: &[(String, Table)]) -> Result<Config, ConfigError> {
    let known = merged.clone();
    for (origin, layer) in layers {
        let unknown = keys::first_unknown(layer, &known);
        lay_over(&mut merged, layer.clone());
        // The types decide what is known (a section may have optional keys); the tree finds the place.
        if let Err(error) = Config::deserialize_from(&merged) {
            return Err(match unknown {
                Some(key) => {
                    let suggestion = keys::nearest(&key, &known);
                    let git = Path::new(origin).with_file_name("git.txt");
                    let origin = match git.is_file() && origin.ends_with("config.toml") {
                        true => {
                            format!("{origin}; {} names the version that wrote it", git.display())
                        }
                        false => origin.clone(),
                    };
                    ConfigError::UnknownKey { key, origin, suggestion }
                }
                None => wrong_type(&error, Some(origin)),
            });
        }
    }
    Config::deserialize_from(&merged).map_err(|error| wrong_type(&error, None))
}

impl Config {
    /// Reads and checks a configuration.
    ///
    /// # Errors
    /// A [`ConfigError`] that names the key, file or override that is wrong.
    pub fn load(source: &Source) -> Result<Self, ConfigError> {
        let config = merge(source)?;
        config.validate()?;
        Ok(config)
    }

    fn deserialize_from(table: &Table) -> Result<Self, toml::de::Error> {
        table.clone().try_into()
    }
}

/// What was given, the strongest last, each with where it comes from.
pub(crate) fn layers(source: &Source) -> Result<Vec<(String, Table)>, ConfigError> {
    let mut layers = Vec::new();
    if let Some(name) = &source.preset {
        let preset = Preset::find(name).ok_or_else(|| ConfigError::UnknownPreset {
            name: name.clone(),
            known: PRESETS.map(|preset| preset.name).join(", "),
        })?;
        let origin = format!("preset `{name}`");
        layers.push((origin.clone(), parse(&origin, preset.text)?));
    }
    if let Some(path) = &source.file {
        let text = caudata_durable::read_text_at_most(path, FILE_BYTES_MAX)
            .map_err(|source| ConfigError::Read { path: path.clone(), source })?;
        let origin = path.display().to_string();
        layers.push((origin.clone(), parse(&origin, &text)?));
    }
    for assignment in &source.overrides {
        layers.push((format!("override `{assignment}`"), parse_override(assignment)?));
    }
    Ok(layers)
}

/// With what the robot decides below everything else, where the preset is one for any robot.
fn with_derived(
    source: &Source,
    mut layers: Vec<(String, Table)>,
) -> Result<Vec<(String, Table)>, ConfigError> {
    let preset = source.preset.as_deref().and_then(Preset::find);
    if preset.is_none_or(|preset| !preset.derived) {
        return Ok(layers);
    }
    let robot = robot_of(layers.iter().map(|(_, layer)| layer));
    let path = Config { robot, ..Config::default() }.robot_path();
    let model = RobotModel::load(&path).map_err(|error| ConfigError::Robot(error.to_string()))?;
    let origin = format!("what follows from {}", path.display());
    let own = layers.iter().any(|(_, layer)| lists_terms(layer));
    let mut below = vec![(origin.clone(), parse(&origin, &derived(&model, own)?)?)];
    if let Some(any) =
        Preset::find(Preset::ANY).filter(|any| source.preset.as_deref() != Some(any.name))
    {
        let origin = format!("preset `{}`", any.name);
        below.push((origin.clone(), parse(&origin, any.text)?));
    }
    below.append(&mut layers);
    Ok(below)
}

/// Whether a layer lists the terms of the observation.
fn lists_terms(layer: &Table) -> bool {
    let task = layer.get("task").and_then(|task| task.get("observation"));
    task.is_some_and(|observation| observation.get("term").is_some())
}

/// The robot file that the last layer with one names, else the default.
fn robot_of<'a>(layers: impl DoubleEndedIterator<Item = &'a Table>) -> PathBuf {
    let named = |layer: &'a Table| layer.get("robot")?.as_str();
    layers.rev().find_map(named).map_or_else(|| Config::default().robot, PathBuf::from)
}

impl Source {
    /// With a preset where neither preset nor file was asked for: `wanted`, or where the overrides name
    /// another robot, the one made for it ([`Preset::for_robot`]). A robot file that cannot be read is left
    /// to be found by whoever needs it.
    pub fn or_preset(&mut self, wanted: &str) {
        if self.preset.is_some() || self.file.is_some() {
            return;
        }
        let parsed = self.overrides.iter().map(|o| parse_override(o));
        let layers: Vec<Table> = parsed.filter_map(Result::ok).collect();
        let named = layers.iter().any(|layer| layer.contains_key("robot"));
        let path = Config { robot: robot_of(layers.iter()), ..Config::default() }.robot_path();
        let preset = match RobotModel::load(&path) {
            Ok(model) if named => Preset::for_robot(wanted, model.name()),
            _ => wanted,
        };
        self.preset = Some(preset.to_owned());
    }
}

fn parse(origin: &str, text: &str) -> Result<Table, ConfigError> {
    text.parse().map_err(|error: toml::de::Error| {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        ConfigError::Syntax {
            origin: origin.to_owned(),
            line: before.matches('\n').count() + 1,
            column: before.rsplit('\n').next().unwrap_or_default().chars().count() + 1,
            message: error.message().to_owned(),
        }
    })
}

/// `a.b=c` as a tree. The value is TOML; a bare word is taken as a string.
pub(crate) fn parse_override(assignment: &str) -> Result<Table, ConfigError> {
    let bad = || ConfigError::BadOverride(assignment.to_owned());
    let (key, value) = assignment.split_once('=').ok_or_else(bad)?;
    let value = value.trim();
    let value = match format!("v = {value}").parse::<Table>() {
        // a line break would hide what stands behind it
        Ok(table) if table.len() > 1 => return Err(bad()),
        Ok(mut table) => table.remove("v").ok_or_else(bad)?,
        Err(_) => Value::String(value.to_owned()),
    };
    let mut words: Vec<&str> = key.trim().split('.').map(str::trim).collect();
    if words.iter().any(|word| word.is_empty()) {
        return Err(bad());
    }
    let last = words.pop().ok_or_else(bad)?;
    let mut tree = Table::from_iter([(last.to_owned(), value)]);
    for word in words.into_iter().rev() {
        tree = Table::from_iter([(word.to_owned(), Value::Table(tree))]);
    }
    Ok(tree)
}

fn lay_over(base: &mut Table, layer: Table) {
    for (key, value) in layer {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(base)), Value::Table(layer)) => lay_over(base, layer),
            (Some(Value::Array(items)), Value::Table(layer)) => {
                if !lay_over_named(items, &layer) {
                    base.insert(key, Value::Table(layer));
                }
            }
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

/// Lays tables over the items of an array that have their names, `task.reward.term.NAME.weight=2`; false, and
/// nothing changed, where one has none.
fn lay_over_named(items: &mut [Value], layer: &Table) -> bool {
    let named = |item: &Value, name: &str| item.get("name").and_then(Value::as_str) == Some(name);
    let mut laid = items.to_vec();
    for (name, over) in layer {
        match (laid.iter_mut().find(|item| named(item, name)), over) {
            (Some(Value::Table(item)), Value::Table(over)) => lay_over(item, over.clone()),
            _ => return false,
        }
    }
    items.clone_from_slice(&laid);
    true
}

/// The parser says `… in \`a.b\`` below its message; that is the key. `origin`: the layer that has it.
fn wrong_type(error: &toml::de::Error, origin: Option<&String>) -> ConfigError {
    let text = error.to_string();
    let key = text
        .lines()
        .find_map(|line| line.strip_prefix("in `")?.strip_suffix('`'))
        .map(str::to_owned);
    ConfigError::WrongType { key, origin: origin.cloned(), message: in_words(error.message()) }
}

/// The parser's message, without the names of Rust's types.
fn in_words(message: &str) -> String {
    let Some((found, wanted)) = message.rsplit_once("expected ") else {
        return message.to_owned();
    };
    let words = match wanted {
        "f32" | "f64" => "a number, for instance 0.98",
        "usize" | "u8" | "u16" | "u32" | "u64" => "a whole number from 0 on",
        "i8" | "i16" | "i32" | "i64" => "a whole number",
        other => other,
    };
    format!("{found}expected {words}")
}
