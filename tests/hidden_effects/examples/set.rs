//! Runs a set without the command line: `set quick|pr|nightly SEED CASES JOBS ROOT [SKIP [BLOCK,…]]`; the diagnosing program lies beside the examples' folder.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use caudata_hidden_effects::run::{self, Diagnoser};
use caudata_hidden_effects::score::Summary;
use caudata_hidden_effects::sets::{self, SetName};
fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let set = match args[0].as_str() {
        "quick" => SetName::Quick,
        "pr" => SetName::Pr,
        _ => SetName::Nightly,
    };
    let most: usize = args[2].parse().unwrap();
    let jobs: usize = args[3].parse().unwrap();
    let root = std::path::PathBuf::from(&args[4]);
    let skip: usize = args.get(5).map_or(0, |s| s.parse().unwrap());
    // names as in `Block`'s debug form, for instance Single,Pair
    let blocks: Vec<String> = args
        .get(6)
        .map_or_else(Vec::new, |s| s.split(',').map(str::to_owned).collect());
    let secret = b"development";
    if !root.join(run::SEALED_NAME).exists() {
        let plans: Vec<_> = sets::plan(set, args[1].parse().unwrap(), None)
            .into_iter()
            .filter(|p| blocks.is_empty() || blocks.contains(&format!("{:?}", p.block)))
            .skip(skip)
            .take(most)
            .collect();
        let (made, left) = run::generate(&plans, &root, secret, jobs, |_, _| ()).unwrap();
        println!("{made} cases; left out: {left:#?}");
    }
    let program = std::env::current_exe()
        .unwrap()
        .parent()
        .unwrap()
        .parent()
        .unwrap()
        .join("caudata-diagnose-case");
    let diagnoser = Diagnoser {
        program,
        arguments: vec!["--threads".into(), "1".into()],
        keep_variables: vec![],
        limit_s: 900.0,
    };
    let (outcomes, answers) = run::diagnose(&root, secret, &diagnoser, jobs, |_, _| ()).unwrap();
    for (o, a) in outcomes.iter().zip(&answers.answers) {
        let truth: Vec<String> = a
            .effects
            .iter()
            .map(|e| format!("{}@{} d={:.1}", e.effect, e.joint, e.d))
            .collect();
        println!(
            "{} {} {:?} {} truth {truth:?} together {:.1} {} | {} {:?} wrong {} err {:?} ci {:?} half {:?} gain {:?} {:.0} s {}",
            if o.right { "ok  " } else { "MISS" },
            o.case,
            o.block,
            o.rig,
            o.together_d,
            o.decoy,
            o.verdict,
            o.given,
            o.wrong,
            o.truth
                .iter()
                .map(|t| t.parameter_error.map(|e| (e * 1000.0).round() / 1000.0))
                .collect::<Vec<_>>(),
            o.truth.iter().map(|t| t.interval_holds).collect::<Vec<_>>(),
            o.truth
                .iter()
                .map(|t| t.interval_half.map(|h| (h * 1000.0).round() / 1000.0))
                .collect::<Vec<_>>(),
            o.gain_ratio.map(|g| (g * 100.0).round() / 100.0),
            o.seconds,
            o.failure
        );
    }
    for (what, value, owed) in Summary::of(&outcomes).rows() {
        println!("{what:50} {value:32} {owed}");
    }
}
