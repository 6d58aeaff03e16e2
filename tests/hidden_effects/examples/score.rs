//! Scores the reports that a set has so far, for a `caudata bench gap --keep ROOT` or an example `set` that was stopped: `score quick|pr|nightly SEED ROOT`.
//! Answers that `set` wrote are read; for those of the command, which nobody can read, the same cases are made again (in `ROOT/again`), and no report is
//! taken whose logs are not the same to the byte.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use std::path::Path;

use caudata_hidden_effects::case::Answers;
use caudata_hidden_effects::run;
use caudata_hidden_effects::score::Summary;
use caudata_hidden_effects::sets::{self, SetName};
fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let set = match args[0].as_str() {
        "quick" => SetName::Quick,
        "pr" => SetName::Pr,
        _ => SetName::Nightly,
    };
    let root = std::path::PathBuf::from(&args[2]);
    let mut done: Vec<String> = std::fs::read_dir(root.join("out"))
        .unwrap()
        .map(|e| e.unwrap())
        .filter(|e| e.path().join("report.json").exists())
        .map(|e| e.file_name().into_string().unwrap())
        .collect();
    done.sort();
    let mut answers = match run::answers(&root, b"development") {
        Ok(answers) => answers,
        Err(_) => made_again(set, args[1].parse().unwrap(), &root, &done),
    };
    let all = answers.answers.len();
    answers.answers.retain(|a| done.contains(&a.case));
    println!("{} of {all} cases have a report", answers.answers.len());
    let outcomes = run::judge_kept(&root, &answers).unwrap();
    for (o, a) in outcomes.iter().zip(&answers.answers) {
        let truth: Vec<String> = (a.effects.iter())
            .map(|e| format!("{}@{} d={:.1}", e.effect, e.joint, e.d))
            .collect();
        let of = |x: Option<f64>| x.map_or("-".to_owned(), |x| format!("{x:.3}"));
        let parameters: Vec<String> = (o.truth.iter())
            .map(|t| {
                let (error, half) = (of(t.parameter_error), of(t.interval_half));
                format!("error {error} half {half} holds {:?}", t.interval_holds)
            })
            .collect();
        println!(
            "{} {} {:?} {} {} truth {truth:?} {} | {:?} set {} | {parameters:?} gain {} {:.0} s",
            if o.right { "ok  " } else { "MISS" },
            o.case,
            o.block,
            o.rig,
            o.decoy,
            o.verdict,
            o.given,
            o.set_size,
            of(o.gain_ratio),
            o.seconds,
        );
    }
    for (what, value, owed) in Summary::of(&outcomes).rows() {
        println!("{what:50} {value:32} {owed}");
    }
}

/// The answers of the cases up to the last one that is `done`.
fn made_again(set: SetName, seed: u64, root: &Path, done: &[String]) -> Answers {
    let again = root.join("again");
    let last: usize = done.last().unwrap()[1..].parse().unwrap();
    let secret = b"scoring";
    if !again.join(run::SEALED_NAME).exists() {
        let plans = sets::plan(set, seed, Some(last + 1));
        run::generate(&plans, &again, secret, 1, |_, _| ()).unwrap();
    }
    let answers = run::answers(&again, secret).unwrap();
    for a in answers.answers.iter().filter(|a| done.contains(&a.case)) {
        let logs = |root: &Path| {
            let mut all: Vec<_> = std::fs::read_dir(root.join(run::CASES_NAME).join(&a.case))
                .unwrap()
                .map(|e| e.unwrap().path().join("log.csv"))
                .filter(|p| p.exists())
                .collect();
            all.sort();
            all.into_iter()
                .map(|p| std::fs::read(p).unwrap())
                .collect::<Vec<_>>()
        };
        assert!(logs(root) == logs(&again), "{} is another case", a.case);
    }
    answers
}
