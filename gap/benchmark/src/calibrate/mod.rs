//! Cases by which the evidence for a name is mapped to a probability: robots whose laws are not the catalogue's
//! own, each diagnosed in a process of its own, and every name that was given judged.

pub mod fit;

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::Path;

use caudata_gap::report::{Grounds, Verdict};
use caudata_random::{Key, Purpose, Stream};
use serde::{Deserialize, Serialize};

use crate::battery::Amount;
use crate::case::{Answer, Block};
use crate::file::at;
use crate::generate::GenerateError;
use crate::hidden::{Hidden, OUTSIDE, Scope};
use crate::run::{self, BenchError, Diagnoser};
use crate::score::Given;
use crate::score::outcome::is_true;
use crate::sets::{self, Plan};

/// Every so many cases one is of the arm, which takes three times as long.
const CASES_AN_ARM: usize = 6;
/// Sizes of single effects and of laws outside the catalogue, d.
const SIZES_D: [f64; 3] = [2.0, 4.0, 8.0];

/// A case, judged.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Case {
    /// Which one.
    pub number: usize,
    /// What kind.
    pub block: Block,
    /// Rig.
    pub rig: String,
    /// What was hidden; where it could not be made as large as asked for, that.
    pub hidden: Vec<String>,
    /// What was said; none where there was no report.
    pub verdict: Option<Verdict>,
    /// Every name that was given, leads included.
    pub names: Vec<Name>,
    /// Wall time, s.
    pub seconds: f64,
    /// Why there is no report.
    pub failure: String,
}

/// A name, judged.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Name {
    /// Effect.
    pub effect: String,
    /// What it rests on.
    pub grounds: Grounds,
    /// What the program made of that.
    pub confidence: f64,
    /// Whether it is right.
    pub right: bool,
}

/// Case `number` of `seed`: in ten cases one is healthy, four have one effect, two have two, two have a law that
/// never was in the catalogue, and one has an effect that is left out of it.
fn plan(seed: u64, number: usize) -> Plan {
    let key = Key { seed, actor: number as u64, env: 0, episode: 0 };
    let mut s = Stream::new(key, Purpose::Command);
    let rig = match (number + 1) % CASES_AN_ARM {
        0 => "arm",
        _ => "pendulum",
    };
    let nuisances = s.next_u64();
    let amount = match s.chance(0.5) {
        true => Amount::Short,
        false => Amount::Full,
    };
    let mut plan = Plan { other_laws: true, ..Plan::new(Block::Null, rig, nuisances, amount) };
    let d = SIZES_D[sets::below(&mut s, SIZES_D.len())];
    let joint = sets::joint(rig, &mut s);
    let local = |h: &Hidden| h.scope == Scope::Joint && h.layer != "sensing";
    let one = |h: &Hidden| h.scope != Scope::Chain || rig == "arm";
    (plan.block, plan.effects) = match number % 10 {
        0 => (Block::Null, Vec::new()),
        1..5 => (Block::Single, vec![(sets::any(&mut s, &one), joint, d)]),
        5..7 => {
            let kind = sets::below(&mut s, 10);
            (Block::Pair, sets::pair(kind, rig, &mut s))
        }
        7..9 => {
            let law = &OUTSIDE[sets::below(&mut s, OUTSIDE.len())];
            (Block::Outside, vec![(law, joint, d)])
        }
        _ => {
            let left_out = sets::any(&mut s, &local);
            plan.without = sets::left_out_with(left_out, rig);
            (Block::Outside, vec![(left_out, joint, d)])
        }
    };
    plan
}

/// The first `count` cases of `seed`. They are kept in `folder`, a line each in `SEED.jsonl`; what stands there is
/// not made again.
///
/// # Errors
/// Where a folder cannot be written or a case is damaged; a diagnosis that fails is a case.
pub fn cases(
    seed: u64,
    count: usize,
    folder: &Path,
    diagnoser: &Diagnoser,
    mut each: impl FnMut(&Case),
) -> Result<Vec<Case>, BenchError> {
    let path = folder.join(format!("{seed}.jsonl"));
    let mut out = kept(&path)?;
    out.truncate(count);
    out.iter().for_each(&mut each);
    let mut file = OpenOptions::new().create(true).append(true).open(&path).map_err(at(&path))?;
    for number in out.len()..count {
        let root = folder.join(format!("{seed}-{number:05}"));
        // what was stopped under way leaves half a case
        let clear = || match root.exists() {
            true => fs::remove_dir_all(&root).map_err(at(&root)),
            false => Ok(()),
        };
        clear()?;
        let case = made(number, &plan(seed, number), &root, diagnoser)?;
        clear()?;
        let line = format!("{}\n", serde_json::to_string(&case)?);
        file.write_all(line.as_bytes()).map_err(at(&path))?;
        each(&case);
        out.push(case);
    }
    Ok(out)
}

/// The cases of a file, without a last line that was stopped under way.
fn kept(path: &Path) -> Result<Vec<Case>, BenchError> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let text = fs::read_to_string(path).map_err(at(path))?;
    let whole = &text[..text.rfind('\n').map_or(0, |end| end + 1)];
    if whole.len() < text.len() {
        fs::write(path, whole).map_err(at(path))?;
    }
    let read = |(k, line)| {
        let damaged = |why: String| BenchError::Kept(path.display().to_string(), k + 1, why);
        let case: Case = serde_json::from_str(line).map_err(|e| damaged(e.to_string()))?;
        // what comes next is made by its number
        let own = format!("is case {} where case {k} belongs", case.number);
        if case.number == k { Ok(case) } else { Err(damaged(own)) }
    };
    whole.lines().enumerate().map(read).collect()
}

fn made(
    number: usize,
    plan: &Plan,
    root: &Path,
    diagnoser: &Diagnoser,
) -> Result<Case, BenchError> {
    let mut case = empty(number, plan);
    match run::one_case(number, plan, root, diagnoser) {
        Ok((answer, given)) => case.judge(&answer, &given),
        Err(e @ (GenerateError::TooSmall { .. } | GenerateError::Diverged(_))) => {
            case.failure = e.to_string();
        }
        Err(e) => return Err(e.into()),
    }
    Ok(case)
}

/// A case without a report.
fn empty(number: usize, plan: &Plan) -> Case {
    let told = |(h, _, d): &(&Hidden, usize, f64)| format!("{} {d}", h.id);
    Case {
        number,
        block: plan.block,
        rig: plan.rig.to_owned(),
        hidden: plan.effects.iter().map(told).collect(),
        verdict: None,
        names: Vec::new(),
        seconds: 0.0,
        failure: String::new(),
    }
}

impl Case {
    fn judge(&mut self, answer: &Answer, given: &Given) {
        self.seconds = given.seconds;
        self.failure.clone_from(&given.failure);
        let Some(report) = &given.report else {
            return;
        };
        self.verdict = Some(report.verdict);
        let names = report.causes.iter().chain(&report.leads);
        self.names = names
            .map(|c| Name {
                effect: c.effect.clone(),
                grounds: c.grounds,
                // what is right is judged by kind as well
                confidence: c.confidence_of_kind,
                right: is_true(answer, c, &report.causes),
            })
            .collect();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hidden::CATALOGUE;

    #[test]
    fn a_case_does_not_depend_on_how_many_there_are() {
        let told = |seed, number| {
            let p = plan(seed, number);
            (p.block, p.seed, p.effects.iter().map(|e| e.0.id).collect::<Vec<_>>())
        };
        assert_eq!(told(3, 17), told(3, 17));
        assert_ne!(told(3, 17).1, told(4, 17).1);
        let blocks: Vec<Block> = (0..10).map(|n| plan(3, n).block).collect();
        let count = |b| blocks.iter().filter(|x| **x == b).count();
        assert_eq!(
            [Block::Null, Block::Single, Block::Pair, Block::Outside].map(count),
            [1, 4, 2, 3]
        );
        // what is left out of the catalogue is what is hidden
        let p = plan(3, 9);
        assert!(p.without.iter().any(|w| w == p.effects[0].0.id));
        assert!(CATALOGUE.iter().any(|h| h.id == p.effects[0].0.id));
    }

    #[test]
    fn a_line_that_was_stopped_under_way_is_made_again_and_a_damaged_one_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("3.jsonl");
        let line = |n| format!("{}\n", serde_json::to_string(&empty(n, &plan(3, n))).unwrap());
        fs::write(&path, format!("{}{}{}", line(0), line(1), &line(2)[..40])).unwrap();
        let told = kept(&path).unwrap();
        assert_eq!(told.iter().map(|c| c.number).collect::<Vec<_>>(), [0, 1]);
        assert_eq!(fs::read_to_string(&path).unwrap(), format!("{}{}", line(0), line(1)));
        fs::write(&path, format!("{}{}", &line(0)[..40], line(1))).unwrap();
        let told = kept(&path).unwrap_err().to_string();
        assert!(told.contains("3.jsonl, line 1: "), "{told}");
    }
}
