//! What an explanation comes to.

use serde::Serialize;

use crate::behaviour::Behaviour;

/// The answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// It walks: there is nothing to explain.
    Walks,
    /// A mistake is named, and putting it right makes it walk.
    Explained,
    /// Trained again as it is, from another seed, it walks: chance, or too short a training.
    WalksWhenTrainedAgain,
    /// Suspects, none of which was shown to help before the time was up.
    Suspected,
    /// None of these: with every suspect put right it does not walk either.
    Unexplained,
}

/// A place that may be wrong, and what came of putting it right.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Cause {
    /// The kind of mistake.
    pub id: &'static str,
    /// Keys of the configuration, a term's name in it, or `robot.<joint>`.
    pub places: Vec<String>,
    /// What is wrong, in a sentence.
    pub says: String,
    /// What to change: `key=value` as `--set` takes it, or words about the robot file.
    pub change: Vec<String>,
    /// 1 and more: suspect by itself.
    pub suspicion: f64,
    /// Whether it walks with this put right, alone or together with the other causes; null: not tried.
    pub helps: Option<bool>,
}

/// A short training and how its policy walks.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Trial {
    /// What was put right, by kind; empty: nothing, as the run is.
    pub put_right: Vec<&'static str>,
    /// Its seed.
    pub seed: u64,
    /// Its iterations.
    pub iterations: u64,
    /// How its policy walks.
    pub behaviour: Behaviour,
    /// Wall time, s.
    pub seconds: f64,
}

/// The whole answer.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// The answer.
    pub verdict: Verdict,
    /// What the run's policy does.
    pub behaviour: Behaviour,
    /// What makes it walk once put right: usually one, several where only all of them together do.
    pub causes: Vec<Cause>,
    /// What else was suspected, the most suspect first; what was tried and did not help last.
    pub others: Vec<Cause>,
    /// The trainings, in order.
    pub trials: Vec<Trial>,
    /// Wall time, s.
    pub seconds: f64,
}
