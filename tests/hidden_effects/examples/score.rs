//! Scores the reports that a set has so far, for a `caudata bench gap --keep ROOT` that was stopped: `score quick|pr|nightly SEED ROOT`. Makes the same
//! cases again (in `ROOT/again`) for their answers, and takes no report whose logs are not the same to the byte.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
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
    let again = root.join("again");
    let mut done: Vec<String> = std::fs::read_dir(root.join("out"))
        .unwrap()
        .map(|e| e.unwrap())
        .filter(|e| e.path().join("report.json").exists())
        .map(|e| e.file_name().into_string().unwrap())
        .collect();
    done.sort();
    let last: usize = done.last().unwrap()[1..].parse().unwrap();
    let secret = b"scoring";
    if !again.join(run::SEALED_NAME).exists() {
        let plans = sets::plan(set, args[1].parse().unwrap(), Some(last + 1));
        run::generate(&plans, &again, secret, 1, |_, _| ()).unwrap();
    }
    let mut answers = run::answers(&again, secret).unwrap();
    answers.answers.retain(|a| done.contains(&a.case));
    for a in &answers.answers {
        let logs = |root: &std::path::Path| {
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
        assert!(logs(&root) == logs(&again), "{} is another case", a.case);
    }
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
