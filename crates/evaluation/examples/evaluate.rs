//! Evaluates a policy and writes its page, without the command line:
//! `cargo run --release -p caudata-evaluation --example evaluate -- P.onnx SUITE EPISODES OUT.html`

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use caudata_config::ConfigArgs;
use caudata_evaluation::{Evaluation, Settings, Suite, report};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;

type Fallible<T> = Result<T, Box<dyn std::error::Error>>;

fn main() -> Fallible<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let [policy, suite, episodes, out] = words.as_slice() else {
        return Err("usage: evaluate P.onnx SUITE EPISODES OUT.html".into());
    };
    let config = ConfigArgs {
        preset: Some("quick".into()),
        ..ConfigArgs::default()
    }
    .load()?;
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/polymander.robot.toml");
    let model = Arc::new(RobotModel::load(&robot)?);
    let policy = PolicyFile::parse(std::fs::read(policy)?.into())?;
    let named = |s: &Suite| s.name() == suite;
    let evaluation = Evaluation {
        config: &config,
        model: &model,
        policy: &policy,
        suite: Suite::ALL.into_iter().find(named).ok_or("no such suite")?,
        settings: Settings {
            episodes: episodes.parse()?,
            film: true,
            ..Settings::default()
        },
        both_engines: false,
    };
    let mut from = Instant::now();
    let (result, outcomes) = evaluation.run(&|| true, &mut |engine, s| {
        println!(
            "{engine:7} {:28} {:5.2} s  vx {:.3}  falls {:.3}  power {:5.1} W  vibration {:.4}  {:?}",
            s.name,
            from.elapsed().as_secs_f64(),
            s.vx_mps.mean,
            s.fall_share.mean,
            s.power_w.mean,
            s.vibration_share.mean,
            s.gates.as_ref().map(|g| g.missed()),
        );
        from = Instant::now();
    })?;
    for row in &result.acceptance {
        let (measured, met) = (row.measured.unwrap_or(f64::NAN), row.met);
        println!("{:60} {:8.4} {met} {}", row.name, measured, row.note);
    }
    let page = report::page(&result, &outcomes, &model, &policy, &evaluation.settings)?;
    println!(
        "{} bytes, {:.2} s",
        page.len(),
        from.elapsed().as_secs_f64()
    );
    std::fs::write(PathBuf::from(out), page)?;
    Ok(())
}
