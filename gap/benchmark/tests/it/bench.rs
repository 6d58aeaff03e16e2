//! The benchmark itself: the seal, the canary, and a quick set with the floors that were measured.

use std::path::{Path, PathBuf};

use caudata_gap_benchmark::case::{Answer, Block};
use caudata_gap_benchmark::run::{self, Diagnoser};
use caudata_gap_benchmark::score::{Given, Outcome, Summary, judge};
use caudata_gap_benchmark::sets::{self, SetName};

const SECRET: &[u8] = b"known to the examiner alone";
/// Seed of the quick set.
const SEED: u64 = 7;

fn diagnoser() -> Diagnoser {
    Diagnoser {
        program: PathBuf::from(env!("CARGO_BIN_EXE_caudata-diagnose-case")),
        arguments: Vec::new(),
        limit_s: run::DEFAULT_LIMIT_S,
    }
}

/// Every file below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut all = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            all.extend(files(&path));
        } else {
            all.push(path);
        }
    }
    all
}

fn links() -> Vec<(String, String)> {
    vec![("swing".to_owned(), "arm".to_owned())]
}

/// Judges `reports` against the answers of other cases.
fn shuffled(answers: &[Answer], outcomes: &[Outcome], root: &Path) -> Vec<Outcome> {
    let singles: Vec<usize> =
        (0..answers.len()).filter(|&i| answers[i].block == Block::Single).collect();
    singles
        .iter()
        .enumerate()
        .map(|(k, &i)| {
            let other = singles[(k + 1) % singles.len()];
            let text = std::fs::read_to_string(
                root.join("out").join(&outcomes[i].case).join("report.json"),
            )
            .unwrap();
            let given = Given {
                report: serde_json::from_str(&text).ok(),
                failure: String::new(),
                seconds: 0.0,
            };
            judge(&answers[other], &given, &links())
        })
        .collect()
}

#[test]
fn a_quick_set_is_answered_sealed_and_worthless_with_shuffled_labels() {
    let root = tempfile::tempdir().unwrap();
    let plans = sets::plan(SetName::Quick, SEED, None);
    let (made, left_out) = run::generate(&plans, root.path(), SECRET, 2, |_, _| ()).unwrap();
    assert!(left_out.is_empty(), "{left_out:?}");
    assert_eq!(made, plans.len());

    // The seal: nothing in a case folder or in its name says what is hidden, and the answers do not open with
    // another secret.
    let words: Vec<&str> = plans.iter().flat_map(|p| p.effects.iter().map(|e| e.0.id)).collect();
    for file in files(&root.path().join(run::CASES_NAME)) {
        let robot = file.extension().is_some_and(|e| e == "xml")
            || file.to_string_lossy().ends_with(".robot.toml");
        if robot {
            // the nominal robot, the same in every case of its rig
            continue;
        }
        let said = format!(
            "{} {}",
            file.display(),
            String::from_utf8_lossy(&std::fs::read(&file).unwrap())
        );
        assert!(!words.iter().any(|w| said.contains(w)), "{} names an effect", file.display());
    }
    let sealed = std::fs::read(root.path().join(run::SEALED_NAME)).unwrap();
    assert!(!words.iter().any(|w| sealed.windows(w.len()).any(|s| s == w.as_bytes())));
    assert!(run::answers(root.path(), b"a guess").is_err());

    let (outcomes, answers) =
        run::diagnose(root.path(), SECRET, &diagnoser(), 2, |_, _| ()).unwrap();
    let said: Vec<String> = outcomes
        .iter()
        .zip(&answers.answers)
        .map(|(o, a)| {
            let truth: Vec<&str> = a.effects.iter().map(|e| e.effect.as_str()).collect();
            format!(
                "{} {:?} {truth:?} {}: {} {:?} {}",
                o.case, o.block, o.decoy, o.verdict, o.given, o.failure
            )
        })
        .collect();
    let said = said.join("\n");
    let summary = Summary::of(&outcomes);
    assert_eq!(summary.failed, 0, "{said}");
    // Names are scored on the large sets (docs/reference/hidden-effects.md). Here each effect is large (d =
    // 8): these are floors, not figures.
    assert_eq!(summary.first_large.of, 5, "{said}");
    assert!(summary.first_large.hits >= 4, "{said}");
    assert_eq!(summary.false_alarms.hits, 0, "{said}");
    assert_eq!(summary.null_gaps.hits, 0, "{said}");
    assert_eq!(summary.decoys_named.hits, 0, "{said}");
    assert!(summary.joint.hits >= 4, "{said}");
    assert!(summary.wrong_per_case <= 0.2, "{said}");

    // The canary: the same reports against shuffled labels are at chance. Five different effects, so none
    // should be right.
    let canary = Summary::of(&shuffled(&answers.answers, &outcomes, root.path()));
    assert_eq!(canary.first_large.of, 5);
    assert_eq!(canary.first_large.hits, 0, "{said}");
}

#[test]
fn a_case_is_the_same_bits_again() {
    let make = || {
        let root = tempfile::tempdir().unwrap();
        let plans = sets::plan(SetName::Quick, SEED, Some(2));
        run::generate(&plans, root.path(), SECRET, 2, |_, _| ()).unwrap();
        let mut all = files(&root.path().join(run::CASES_NAME));
        all.sort();
        all.iter()
            .map(|f| (f.strip_prefix(root.path()).unwrap().to_owned(), std::fs::read(f).unwrap()))
            .collect::<Vec<_>>()
    };
    let (one, two) = (make(), make());
    assert!(!one.is_empty() && one == two);
}
