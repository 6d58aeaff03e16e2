//! What may change while a run goes on, and the record of what has.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::{Config, ConfigError, TransportKind, keys, layers};

/// The record in a run folder.
pub const CHANGES: &str = "changes.toml";
/// Changes of one run.
pub const CHANGES_MAX: usize = 1_000;
/// Settings of one change.
pub const SETTINGS_MAX: usize = 64;
/// Bytes of one setting.
const SETTING_BYTES_MAX: usize = 256;
/// Bytes of a record.
const RECORD_BYTES_MAX: u64 = 1 << 20;

/// Who acts on a key, or why it stays as it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Key {
    /// The learner.
    Learner,
    /// The environments, which only the actors of the learner's own process change together with it.
    Actors,
    /// Nobody while the run goes on.
    Fixed(&'static str),
}

const REMOTE: &str =
    "only actors in the learner's process follow it, with transport.kind = \"inproc\"";
const ONCE: &str = "it is read once, at the start";
const BUILT: &str = "the simulation is built once, at the start";

/// By the beginning of a key; the first row that fits counts.
const KEYS: [(&str, Key); 14] = [
    ("task.reward.weights.", Key::Actors),
    ("task.command.", Key::Actors),
    ("task.randomisation.", Key::Actors),
    ("learner.ppo.learning_rate", Key::Learner),
    ("learner.ppo.value_learning_rate", Key::Learner),
    ("learner.ppo.target_kl", Key::Learner),
    ("learner.ppo.entropy_weight", Key::Learner),
    ("actors.", Key::Fixed("how much is collected at a time stays")),
    ("learner.network.", Key::Fixed("the networks keep their form")),
    ("engine.", Key::Fixed(BUILT)),
    ("terrain.", Key::Fixed(BUILT)),
    ("task.reward.", Key::Fixed("of the rewards only weights change")),
    ("task.", Key::Fixed("what a policy sees and does, and what ends an episode, stays")),
    ("", Key::Fixed(ONCE)),
];

fn key_of(key: &str) -> Key {
    // A term of the task file: `task.reward.term.NAME.weight`.
    let own = key.strip_prefix("task.reward.term.");
    if own.is_some_and(|own| own.ends_with(".weight")) {
        return Key::Actors;
    }
    let row = KEYS.iter().find(|(prefix, _)| key.starts_with(prefix));
    row.map_or(Key::Fixed(ONCE), |(_, found)| *found)
}

/// Settings that are in effect from an iteration on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Change {
    /// Iterations that were done before: the policy that they led to is the first one to act under it.
    pub iteration: u64,
    /// `key=value`, as for `--set`.
    pub set: Vec<String>,
}

/// The changes of a run, in the order of their iterations: `changes.toml`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Changes {
    /// `[[change]]`.
    pub change: Vec<Change>,
}

impl Changes {
    /// Reads a record and checks it against the configuration that it changes; a file that is not there has
    /// none.
    ///
    /// # Errors
    /// A [`ConfigError`] that names the file, and the change that is wrong.
    pub fn read(path: &Path, config: &Config) -> Result<Self, ConfigError> {
        let origin = path.display().to_string();
        let text = match caudata_durable::read_text_at_most(path, RECORD_BYTES_MAX) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                return Ok(Self::default());
            }
            Err(source) => {
                let path = path.to_owned();
                return Err(ConfigError::Read { path, source });
            }
        };
        let bad = |message: String| ConfigError::Changes { origin: origin.clone(), message };
        let found: Self = toml::from_str(&text).map_err(|error| bad(error.message().to_owned()))?;
        if found.change.len() > CHANGES_MAX {
            return Err(bad(format!("has more than {CHANGES_MAX} changes")));
        }
        let in_order = |pair: &[Change]| pair[0].iteration <= pair[1].iteration;
        if !found.change.windows(2).all(in_order) {
            return Err(bad("is not in the order of its iterations".into()));
        }
        found.at(config, u64::MAX).map_err(|error| bad(error.to_string()))?;
        Ok(found)
    }

    /// The record of a run folder.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn of_run(folder: &Path, config: &Config) -> Result<Self, ConfigError> {
        Self::read(&folder.join(CHANGES), config)
    }

    /// All settings until the end, in order.
    pub fn settings(&self) -> Vec<String> {
        self.change.iter().flat_map(|c| c.set.clone()).collect()
    }

    /// `config` as it is once `iteration` iterations are done and what is to change then has.
    ///
    /// # Errors
    /// As [`Config::changed`].
    pub fn at(&self, config: &Config, iteration: u64) -> Result<Config, ConfigError> {
        let until = self.change.partition_point(|c| c.iteration <= iteration);
        let changed = |now: Config, change: &Change| now.changed(config, &change.set);
        self.change[..until].iter().try_fold(config.clone(), changed)
    }

    /// As a file.
    ///
    /// # Errors
    /// [`ConfigError::Unrepresentable`] for an iteration above 2⁶³ − 1, and for more than [`Changes::read`]
    /// reads.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        let text = toml::to_string(self);
        let text = text.map_err(|error| ConfigError::Unrepresentable(error.to_string()))?;
        if text.len() as u64 > RECORD_BYTES_MAX {
            let message =
                format!("the record of changes would have more than {RECORD_BYTES_MAX} bytes");
            return Err(ConfigError::Unrepresentable(message));
        }
        Ok(text)
    }
}

impl Config {
    /// With settings that change while a run goes on, checked as a whole. `first` is what the run began with:
    /// its policies promise to obey its ranges of commands, so that later ones lie within.
    ///
    /// # Errors
    /// [`ConfigError::Fixed`] for a key that stays, else as [`Config::load`].
    pub fn changed(&self, first: &Config, set: &[String]) -> Result<Config, ConfigError> {
        if set.len() > SETTINGS_MAX {
            let message = format!("has {} settings; at most {SETTINGS_MAX} at once", set.len());
            let origin = "the change".to_owned();
            return Err(ConfigError::Changes { origin, message });
        }
        let mut over = Vec::with_capacity(set.len());
        for assignment in set {
            if assignment.len() > SETTING_BYTES_MAX {
                let start: String = assignment.chars().take(40).collect();
                return Err(ConfigError::BadOverride(format!("{start}…")));
            }
            let layer = layers::parse_override(assignment)?;
            // who follows a change goes by the key that it names
            let whole_table = |(_, value): (&str, &str)| value.trim_start().starts_with('{');
            if assignment.split_once('=').is_some_and(whole_table) {
                return Err(ConfigError::BadOverride(assignment.clone()));
            }
            over.push((format!("`{assignment}`"), layer));
        }
        // A key that there is not is told as such first.
        let changed = layers::lay(keys::table_of(self), &over)?;
        for (key, _) in over.iter().flat_map(|(_, layer)| keys::entries(layer)) {
            match key_of(&key) {
                Key::Fixed(reason) => return Err(ConfigError::Fixed { key, reason }),
                Key::Actors if first.transport.kind != TransportKind::Inproc => {
                    let reason = REMOTE;
                    return Err(ConfigError::Fixed { key, reason });
                }
                Key::Actors | Key::Learner => {}
            }
        }
        changed.validate()?;
        let (now, then) = (&changed.task.command, &first.task.command);
        for (key, now, then) in [
            ("task.command.vx_mps", now.vx_mps, then.vx_mps),
            ("task.command.vy_mps", now.vy_mps, then.vy_mps),
            ("task.command.yaw_rate_radps", now.yaw_rate_radps, then.yaw_rate_radps),
        ] {
            if now[0] < then[0] || now[1] > then[1] {
                return Err(ConfigError::OutOfRange {
                    key,
                    value: format!("{now:?}"),
                    rule: format!(
                        "must lie within {then:?}, with which the run began and which its policies state"
                    ),
                });
            }
        }
        Ok(changed)
    }

    /// The keys that may change while a run goes on, with their values.
    pub fn changeable(&self) -> Vec<(String, String)> {
        let own = self.task.reward.term.iter();
        let own = own.map(|term| {
            let value = format!("{:?}", term.weight);
            (format!("task.reward.term.{}.weight", term.name), value)
        });
        let fixed = |key: &str| matches!(key_of(key), Key::Fixed(_));
        let all = self.entries().into_iter().filter(|(key, _)| !fixed(key));
        all.chain(own).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Source;

    fn set(settings: &[&str]) -> Result<Config, ConfigError> {
        let first = Config::default();
        let settings: Vec<String> = settings.iter().map(|&s| s.to_owned()).collect();
        first.changed(&first, &settings)
    }

    #[test]
    fn a_setting_is_one_key_and_one_value() {
        for wrong in [
            "learner.ppo.entropy_weight=0.01\nlearner.ppo.target_kl=0.02",
            "learner.ppo={learning_rate=0.002}",
        ] {
            let refused = set(&[wrong]).unwrap_err();
            assert!(matches!(refused, ConfigError::BadOverride(_)), "{refused}");
        }
    }

    #[test]
    fn weights_rates_commands_and_randomisation_change() {
        let changed = set(&[
            "task.reward.weights.bend=-1.5",
            "learner.ppo.learning_rate=0.002",
            "task.command.vx_mps=[0.0, 0.3]",
            "task.randomisation.kp_scale=[0.9, 1.0]",
        ])
        .unwrap();
        assert_eq!(changed.task.reward.weights.bend, -1.5);
        assert_eq!(changed.learner.ppo.learning_rate, 0.002);
        assert_eq!(changed.task.command.vx_mps, [0.0, 0.3]);
        assert_eq!(changed.task.randomisation.kp_scale, [0.9, 1.0]);
    }

    #[test]
    fn what_is_wrong_is_said_in_one_line() {
        for (setting, said) in [
            ("task.reward.weights.bent=-1", "unknown key"),
            ("task.reward.weights.bend=1", "this term costs"),
            ("task.reward.weights.bend=hello", "wrong value"),
            ("task.reward.weights.bend=-0,5", "expected a number"),
            ("learner.ppo.learning_rate=2", "must lie in"),
            ("task.command.vx_mps=[0.0, 3.0]", "with which the run began"),
            ("task.randomisation.kp_scale=[1.0, 0.9]", "must be [min, max]"),
            ("actors.lanes=3", "cannot change while a run goes on"),
            ("task.reward.lin_vel_sigma=0.1", "only weights change"),
            ("learner.network.symmetric=true", "keep their form"),
            ("task.reward.term.x.weight=1", "task.reward.term"),
            ("robot=x", "read once"),
            ("bend", "is not of the form"),
        ] {
            let error = set(&[setting]).unwrap_err().to_string();
            assert!(error.contains(said) && !error.contains('\n'), "{error}");
        }
        let long = format!("run.name={}", "x".repeat(300));
        assert!(set(&[long.as_str()]).is_err());
        assert!(set(&["run.name=x"; SETTINGS_MAX + 1]).is_err());
    }

    #[test]
    fn actors_elsewhere_are_not_left_behind() {
        let remote = Source::default().set("transport.kind=zenoh");
        let first = Config::load(&remote).unwrap();
        let set = |setting: &str| first.changed(&first, &[setting.to_owned()]);
        set("learner.ppo.entropy_weight=0.01").unwrap();
        let refused = set("task.reward.weights.bend=-1").unwrap_err().to_string();
        assert!(refused.contains("in the learner's process"), "{refused}");
    }

    #[test]
    fn the_weight_of_a_term_of_ones_own_goes_by_its_name() {
        let term = "task.reward.term=[{name=\"low\", value=\"height\", weight=-1.0}]";
        let first = Config::load(&Source::default().set(term)).unwrap();
        let key = "task.reward.term.low.weight";
        let changed = first.changed(&first, &[format!("{key}=-2.5")]).unwrap();
        assert_eq!(changed.task.reward.term[0].weight, -2.5);
        assert!(changed.changeable().contains(&(key.into(), "-2.5".into())));
        let other = "task.reward.term.low.value=\"1\"".to_owned();
        let refused = first.changed(&first, &[other]).unwrap_err().to_string();
        assert!(refused.contains("only weights"), "{refused}");
    }

    #[test]
    fn every_changeable_key_may_be_set_to_what_it_is() {
        let first = Config::load(&Source::preset("quick")).unwrap();
        for (key, value) in first.changeable() {
            let same = first.changed(&first, &[format!("{key}={value}")]).unwrap();
            assert_eq!(same, first, "{key}");
        }
    }

    #[test]
    fn a_record_is_read_in_order_and_a_bad_one_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(CHANGES);
        let config = Config::default();
        assert_eq!(Changes::read(&path, &config).unwrap(), Changes::default());
        let change = |iteration, weight: &str| Change {
            iteration,
            set: vec![format!("task.reward.weights.bend={weight}")],
        };
        let record = Changes { change: vec![change(3, "-1"), change(3, "-2"), change(8, "-3")] };
        std::fs::write(&path, record.to_toml().unwrap()).unwrap();
        let read = Changes::of_run(dir.path(), &config).unwrap();
        assert_eq!(read, record);
        for (iteration, bend) in [(2, 0.0), (3, -2.0), (7, -2.0), (8, -3.0)] {
            let at = read.at(&config, iteration).unwrap();
            assert_eq!(at.task.reward.weights.bend, bend, "{iteration}");
        }
        for bad in [
            "[[change]]\niteration = 4\nset = []\n[[change]]\niteration = 3\nset = []",
            "[[change]]\niteration = 4\nset = [\"actors.lanes=3\"]",
            "[[change]]\niteration = 4\nwhy = 1",
        ] {
            std::fs::write(&path, bad).unwrap();
            assert!(Changes::read(&path, &config).is_err(), "{bad}");
        }
    }
}
