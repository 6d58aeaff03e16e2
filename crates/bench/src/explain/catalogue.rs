//! The mistakes that are hidden, and the harmless changes among which they are.

use caudata_config::Config;
use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};

/// A mistake, or a harmless change.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Change {
    /// Assignments to keys of the configuration.
    pub sets: Vec<String>,
    /// A reward term (name, value, weight).
    pub reward: Option<(&'static str, String, f64)>,
    /// A condition that ends episodes (name, value).
    pub when: Option<(&'static str, String)>,
    /// Terms of the observation (name, value, noise) in place of the standard ones.
    pub observation: Option<Vec<(&'static str, &'static str, f64)>>,
    /// The joint whose axis is turned round.
    pub reversed: Option<String>,
    /// Places that name it: whole keys, or a beginning of them.
    pub places: Vec<String>,
}

/// Draws the sizes of changes.
pub struct Draw<'a> {
    /// Random numbers.
    pub stream: Stream,
    /// What trains such a robot.
    pub reference: &'a Config,
    /// The robot.
    pub model: &'a RobotModel,
}

impl<'a> Draw<'a> {
    /// For a case.
    pub fn new(seed: u64, reference: &'a Config, model: &'a RobotModel) -> Self {
        Self { stream: Stream::new(Key::for_run(seed), Purpose::Excitation), reference, model }
    }

    /// Between two values, evenly in its logarithm.
    fn between(&mut self, low: f64, high: f64) -> f64 {
        self.stream.uniform_f64(low.ln(), high.ln()).exp()
    }

    fn text(&self, key: &str) -> String {
        let entries = self.reference.entries();
        let found = entries.into_iter().find(|(name, _)| name == key);
        found.map(|(_, value)| value).unwrap_or_default()
    }

    /// `key` times something between, each value of a range by itself.
    fn times(&mut self, key: &str, low: f64, high: f64) -> Change {
        let factor = self.between(low, high);
        let text = self.text(key);
        let list = text.trim_matches(['[', ']']);
        let scaled: Vec<String> = list
            .split(',')
            .filter_map(|number| number.trim().parse::<f64>().ok())
            .map(|number| format!("{:?}", number * factor))
            .collect();
        let value = match text.starts_with('[') {
            true => format!("[{}]", scaled.join(", ")),
            false => scaled.join(""),
        };
        to(key, &value)
    }

    /// Both ends of a range between.
    fn range(&mut self, key: &str, low: f64, high: f64) -> Change {
        let value = self.between(low, high);
        to(key, &format!("[{:?}, {value:?}]", 0.9 * value))
    }

    fn number(&mut self, key: &str, low: f64, high: f64) -> Change {
        let value = self.between(low, high);
        to(key, &format!("{value:?}"))
    }

    fn speed(&self) -> f64 {
        self.reference.evaluation.command_mps
    }

    fn tracking(&self) -> f64 {
        f64::from(self.reference.task.reward.weights.tracking_lin_vel)
    }

    /// A reward term that pays about `times` what walking does, its value being about `size`.
    fn term(&mut self, value: &str, size: f64, low: f64, high: f64) -> Change {
        let times = self.between(low, high);
        Change {
            reward: Some(("bonus", value.to_owned(), times * self.tracking() / size)),
            places: vec!["task.reward.term.bonus".into()],
            ..Change::default()
        }
    }

    /// The reward for velocity taken out, and this in its place.
    fn instead(&mut self, value: &str, size: f64) -> Change {
        const KEY: &str = "task.reward.weights.tracking_lin_vel";
        let mut change = self.term(value, size, 0.7, 1.5);
        change.sets.push(format!("{KEY}=0.0"));
        change.places.push(KEY.into());
        change
    }

    /// The standard observation with a term left out (`value` empty), replaced, or drowned in noise.
    fn seen(&mut self, part: &'static str, value: Option<&'static str>, noise: f64) -> Change {
        const ALL: [&str; 7] =
            ["joint_vel", "joint_pos_offset", "gyro", "gravity", "phase", "command", "actions"];
        let kept = ALL.iter().filter(|name| value.is_some() || **name != part);
        let term = |name: &&'static str| match *name == part {
            true => (*name, value.unwrap_or(""), noise),
            false => (*name, "", 0.0),
        };
        Change {
            observation: Some(kept.map(term).collect()),
            places: vec![format!("task.observation.term.{part}")],
            ..Change::default()
        }
    }

    /// A joint of a leg turned round whose nominal position is not zero.
    fn reversed(&mut self) -> Option<Change> {
        let model = self.model;
        let names = model.actuated_names();
        let of_leg = |i: &usize| {
            let link = model.joints()[model.actuated()[*i]].child_link;
            model.leg_of(link).is_some() && model.nominal_pos_rad()[*i].abs() > 0.2
        };
        let legs: Vec<usize> = (0..names.len()).filter(of_leg).collect();
        let joint = names.get(*legs.get(self.stream.below(legs.len().max(1) as u64) as usize)?)?;
        Some(Change {
            reversed: Some((*joint).to_owned()),
            places: vec![format!("robot.{joint}")],
            ..Change::default()
        })
    }

    /// The harmless changes of a case: a few weights, widths and ranges a little off what is known to work, and
    /// sometimes a term of one's own that hardly counts. None touches `places`.
    pub fn harmless(&mut self, places: &[String]) -> Vec<Change> {
        const KEYS: [&str; 20] = [
            "task.reward.weights.power",
            "task.reward.weights.action_rate",
            "task.reward.weights.slip",
            "task.reward.weights.orientation",
            "task.reward.weights.tracking_lin_vel",
            "task.reward.weights.tracking_yaw_rate",
            "task.reward.lin_vel_sigma",
            "task.reward.yaw_rate_sigma",
            "task.reward.phase_sigma",
            "task.reward.trunk_force_n",
            "task.phase.swing_height_m",
            "task.command.yaw_rate_radps",
            "task.command.zero_share",
            "task.noise.joint_vel_std_radps",
            "task.noise.gyro_std_radps",
            "task.push.force_n",
            "task.reset.joint_pos_noise_rad",
            "task.reset.base_vel_noise_mps",
            "learner.ppo.value_learning_rate",
            "learner.network.init_std",
        ];
        let mut keys = KEYS.to_vec();
        self.stream.shuffle(&mut keys);
        keys.truncate(3 + self.stream.below(5) as usize);
        keys.retain(|key| !places.iter().any(|place| place == key));
        let mut all: Vec<Change> = keys.iter().map(|key| self.times(key, 0.75, 1.35)).collect();
        if self.stream.chance(0.4) {
            let mut own = self.term("exp(-gyro.z ^ 2 / 1)", 1.0, 0.01, 0.05);
            own.reward = own.reward.map(|(_, value, weight)| ("calm", value, weight));
            all.push(own);
        }
        all
    }
}

fn to(key: &str, value: &str) -> Change {
    Change {
        sets: vec![format!("{key}={value}")],
        places: vec![key.to_owned()],
        ..Change::default()
    }
}

fn both(mut one: Change, other: Change) -> Change {
    one.sets.extend(other.sets);
    one.places.extend(other.places);
    one
}

type Make = fn(&mut Draw<'_>) -> Option<Change>;

/// Every mistake: a name, and how it is made.
#[rustfmt::skip]
pub const MISTAKES: &[(&str, Make)] = &[
    // a wrong scale of a reward
    ("power costs too much", |d| Some(d.times("task.reward.weights.power", 10.0, 60.0))),
    ("action rate costs too much", |d| Some(d.times("task.reward.weights.action_rate", 20.0, 100.0))),
    ("acceleration costs too much", |d| Some(d.times("task.reward.weights.joint_acceleration", 20.0, 150.0))),
    ("slip costs too much", |d| Some(d.times("task.reward.weights.slip", 10.0, 40.0))),
    ("leaning costs too much", |d| Some(d.times("task.reward.weights.orientation", 80.0, 400.0))),
    ("velocity pays nothing", |d| Some(d.times("task.reward.weights.tracking_lin_vel", 1e-3, 0.03))),
    ("velocity reward too wide", |d| Some(d.times("task.reward.lin_vel_sigma", 20.0, 200.0))),
    ("velocity reward too narrow", |d| Some(d.times("task.reward.lin_vel_sigma", 1e-4, 2e-3))),
    ("phase pays most", |d| Some(d.times("task.reward.weights.phase", 15.0, 60.0))),
    ("phase pays nothing", |d| Some(d.times("task.reward.weights.phase", 1e-3, 0.02))),
    ("yaw pays most", |d| Some(d.times("task.reward.weights.tracking_yaw_rate", 40.0, 200.0))),
    // a term of one's own with a wrong sign, gate or frame
    ("effort pays", |d| { let w = d.reference.evaluation.gates.power_w; Some(d.term("sum(abs(power))", w, 1.0, 5.0)) }),
    ("speed costs", |d| { let v = d.speed(); Some(d.term("velocity.x", -v, 1.5, 5.0)) }),
    ("velocity gated on the command", |d| { let v = d.speed(); Some(d.instead("command_vx", v)) }),
    ("velocity gated on a threshold of the command", |d| Some(d.instead("command_vx > 0.01", 1.0))),
    ("velocity in the wrong frame", |d| { let w = f64::from(d.reference.task.reward.lin_vel_sigma); Some(d.instead(&format!("exp(-(velocity.y - command_vx) ^ 2 / {w})"), 1.0)) }),
    ("the pose pays", |d| Some(d.term("exp(-sum((joint_pos - nominal) ^ 2) / 0.1)", 1.0, 2.0, 6.0))),
    ("rest pays", |d| Some(d.term("exp(-sum(joint_vel ^ 2) / 1)", 1.0, 2.0, 6.0))),
    ("a termination pays", |d| Some(d.term("1", -1.0, 2.0, 6.0))),
    // when an episode ends
    ("tilt limit too small", |d| Some(d.number("task.termination.max_tilt_rad", 0.01, 0.05))),
    ("ends when upright", |_| Some(Change { when: Some(("fallen", "gravity.z < -0.5".into())), places: vec!["task.termination.when.fallen".into()], ..Change::default() })),
    ("ends when it moves", |d| { let v = d.speed(); Some(Change { when: Some(("runaway", format!("abs(velocity.x) > {}", 0.2 * v))), places: vec!["task.termination.when.runaway".into()], ..Change::default() }) }),
    // what it sees
    ("command left out", |d| Some(d.seen("command", None, 0.0))),
    ("phase left out", |d| Some(d.seen("phase", None, 0.0))),
    ("positions left out", |d| Some(d.seen("joint_pos_offset", None, 0.0))),
    ("phase dead", |d| Some(d.seen("phase", Some("0 * clock"), 0.0))),
    ("command is something else", |d| Some(d.seen("command", Some("gyro"), 0.0))),
    ("positions are something else", |d| Some(d.seen("joint_pos_offset", Some("lower"), 0.0))),
    ("phase drowned in noise", |d| { let n = d.between(5.0, 50.0); Some(d.seen("phase", Some(""), n)) }),
    ("command drowned in noise", |d| { let n = d.between(5.0, 50.0); Some(d.seen("command", Some(""), n)) }),
    ("encoders drowned in noise", |d| { let one = d.number("task.noise.joint_pos_std_rad", 2.0, 9.0); Some(both(one, d.number("task.noise.joint_vel_std_radps", 5.0, 10.0))) }),
    // what is asked
    ("command impossible", |d| { let f = d.between(5.0, 12.0); let top = (f * d.speed()).min(4.5); Some(both(to("task.command.vx_mps", &format!("[{:?}, {top:?}]", 0.7 * top)), to("evaluation.command_mps", &format!("{:?}", 0.9 * top)))) }),
    ("always told to stand", |d| Some(d.number("task.command.zero_share", 0.97, 1.0))),
    ("commands change at once", |d| Some(d.range("task.command.resample_s", 0.02, 0.05))),
    ("hardly asked to move", |d| Some(d.times("task.command.vx_mps", 0.01, 0.1))),
    ("asked to spin", |d| { let r = d.between(6.0, 18.0); Some(to("task.command.yaw_rate_radps", &format!("[-{r:?}, {r:?}]"))) }),
    ("clock too fast", |d| Some(d.times("task.phase.frequency_hz", 4.0, 6.5))),
    ("clock stands", |d| Some(d.number("task.phase.stand_command_norm", 3.0, 9.0))),
    ("swing too high", |d| Some(d.times("task.phase.swing_height_m", 3.5, 6.0))),
    // what an action does
    ("actions too small", |d| Some(d.times("task.action.scale", 0.01, 0.06))),
    ("actions cut off", |d| Some(d.number("task.action.clip", 0.01, 0.06))),
    ("filter too slow", |d| Some(d.times("task.action.filter_alpha", 0.01, 0.04))),
    // which robot it is trained on
    ("too much latency", |d| Some(d.range("task.randomisation.command_delay_s", 0.095, 0.1))),
    ("gains too low", |d| Some(d.range("task.randomisation.kp_scale", 0.06, 0.1))),
    ("torque too low", |d| Some(d.range("task.randomisation.torque_scale", 0.06, 0.12))),
    ("supply too low", |d| Some(d.range("task.randomisation.supply_scale", 0.06, 0.15))),
    ("robot too heavy", |d| Some(d.range("task.randomisation.total_mass_scale", 6.0, 15.0))),
    ("no grip", |d| Some(d.range("task.randomisation.foot_friction_scale", 0.005, 0.03))),
    ("joints stuck in friction", |d| Some(d.range("task.randomisation.joint_friction_scale", 14.0, 20.0))),
    ("pushed all the time", |d| { let one = d.times("task.push.force_n", 20.0, 60.0); Some(both(both(one, d.range("task.push.interval_s", 0.1, 0.3)), to("task.push.full_after_env_steps", "0"))) }),
    ("starts fallen", |d| Some(d.number("task.reset.fallen_share", 0.97, 1.0))),
    ("starts bent", |d| Some(d.number("task.reset.joint_pos_noise_rad", 2.4, 3.1))),
    // how it learns
    ("learning rate too small", |d| { let r = d.between(1e-7, 1e-6); Some(to_rate(r)) }),
    ("learning rate too large", |d| { let r = d.between(0.05, 0.4); Some(to_rate(r)) }),
    ("short-sighted", |d| Some(d.number("learner.ppo.gamma", 0.05, 0.6))),
    ("noise pays", |d| Some(d.number("learner.ppo.entropy_weight", 0.2, 1.0))),
    ("explores nothing", |d| { let one = d.number("learner.network.init_std", 0.01, 0.03); let most = d.number("learner.network.std_max", 0.06, 0.08); Some(both(both(one, most), to("learner.network.std_min", "0.01"))) }),
    ("network too small", |_| Some(to("learner.network.policy_hidden", "[1]"))),
    ("batch too small", |_| Some(both(to("actors.lanes", "2"), to("actors.chunk_steps", "4")))),
    // the robot file
    ("joint reversed", |d| d.reversed()),
    ("joint reversed, again", |d| d.reversed()),
    ("joint reversed, once more", |d| d.reversed()),
];

/// A learning rate that stays where it is.
fn to_rate(rate: f64) -> Change {
    let keys = ["learning_rate", "learning_rate_min", "learning_rate_max", "target_kl"];
    let value = |key: &str| if key == "target_kl" { 0.0 } else { rate };
    let all =
        keys.iter().map(|key| to(&format!("learner.ppo.{key}"), &format!("{:?}", value(key))));
    all.reduce(both).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_config::Source;

    /// Every mistake of every robot is a configuration that nothing refuses, and none is another's.
    #[test]
    fn every_mistake_can_be_made() {
        for preset in ["quick", "quadruped", "hexapod"] {
            let reference = Config::load(&Source::preset(preset)).unwrap();
            let model = RobotModel::load(&reference.robot_path()).unwrap();
            for (name, make) in MISTAKES {
                let mut draw = Draw::new(7, &reference, &model);
                let change = make(&mut draw).unwrap();
                let source = Source {
                    preset: Some(preset.into()),
                    overrides: change.sets.clone(),
                    ..Source::default()
                };
                Config::load(&source).unwrap_or_else(|e| panic!("{preset}: {name}: {e}"));
                assert!(!change.places.is_empty(), "{name}");
                let harmless = draw.harmless(&change.places);
                let hit = |h: &Change| h.places.iter().any(|place| change.places.contains(place));
                assert!(!harmless.iter().any(hit), "{name}");
            }
        }
        let mut names: Vec<&str> = MISTAKES.iter().map(|(name, _)| *name).collect();
        names.dedup();
        assert!(names.len() >= 30);
    }
}
