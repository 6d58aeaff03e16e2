//! Diagnoses log folders without the command line's comforts:
//! `diagnose ROBOT.robot.toml [--holdout] DIR… [--holdout DIR…] [--without ID] [--only ID]`; folders before `--holdout` are fitted to.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use caudata_gap::replay::{Data, Replayer, SegmentOptions};
use caudata_gap::trial::{Kind, Trial};
use caudata_gap::{Diagnosis, Options, Request, Role, Run, diagnose, extension};
use caudata_model::RobotModel;
use caudata_runlog::RunLog;

fn main() {
    let mut args = std::env::args().skip(1);
    let robot = args.next().expect("a robot file");
    let robot = Path::new(&robot);
    let toml = std::fs::read(robot).unwrap();
    let text = String::from_utf8(toml.clone()).unwrap();
    let mjcf_name = text
        .lines()
        .find_map(|l| l.strip_prefix("mjcf = \""))
        .and_then(|l| l.split('"').next())
        .unwrap();
    let mjcf = std::fs::read(robot.with_file_name(mjcf_name)).unwrap();
    let mut runs = Vec::new();
    let mut options = Options::default();
    let mut role = Role::Fit;
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--holdout" => role = Role::Holdout,
            "--without" => options.without.push(args.next().unwrap()),
            "--only" => options.only.push(args.next().unwrap()),
            "--threads" => options.threads = args.next().unwrap().parse().unwrap(),
            dir => runs.push(Run {
                name: Path::new(dir)
                    .file_name()
                    .unwrap()
                    .to_string_lossy()
                    .into_owned(),
                log: RunLog::read(Path::new(dir)).unwrap(),
                role,
                sha256: String::new(),
            }),
        }
    }
    let begin = Instant::now();
    let request = Request {
        robot_toml: toml,
        mjcf,
        label: robot.display().to_string(),
        runs,
        data_faults: Vec::new(),
        options,
    };
    let d = diagnose(&request, &mut |p| {
        println!(
            "{:7.1} s  {:?} {} {}",
            begin.elapsed().as_secs_f64(),
            p.stage,
            p.round,
            p.model
        )
    })
    .unwrap();
    let r = &d.report;
    println!(
        "{:?} in {:.1} s: {}",
        r.verdict,
        begin.elapsed().as_secs_f64(),
        r.summary
    );
    for c in &r.causes {
        println!(
            "  {} {:?} confidence {:.2} alternatives {:?}",
            c.effect, c.location, c.confidence, c.alternatives
        );
        for (n, p) in &c.parameters {
            println!(
                "      {n} = {:.5} {} [{:.5}, {:.5}]{}",
                p.value,
                p.unit,
                p.ci_low,
                p.ci_high,
                if p.at_bound { " AT BOUND" } else { "" }
            );
        }
        println!("      {}", c.evidence[0]);
        for x in c.rejected.iter().take(4) {
            println!("      not {}: {}", x.effect, x.reason);
        }
    }
    for (k, g) in &r.gain {
        println!(
            "  {k}: {:.5} -> {:.5} ({:.3}; {:.3}..{:.3})",
            g.before, g.after, g.ratio, g.ci_low, g.ci_high
        );
    }
    for h in d.plots.hypotheses.iter().take(12) {
        println!(
            "    hypothesis {} {:?} fit {:.2} holdout {:.2} p {:.2} {:?}",
            h.effect, h.location, h.share_fit, h.share_holdout, h.probability, h.parameters
        );
    }
    for u in r.unexplained.iter().take(3) {
        println!(
            "  left: {} {:?} {} nearest {:?}",
            u.location, u.depends_on, u.description, u.nearest
        );
    }
    for cell in r.divergence.iter().take(10) {
        println!(
            "  apart: {} {} {}: {:.5}, floor {:.5}",
            cell.signal, cell.joint, cell.regime, cell.rmse, cell.noise_floor
        );
    }
    println!("  next: {:?}", r.next_experiment);
    println!("  compute: {:?}", r.compute);
    errors(&request, &d);
}

/// Mean absolute error of positions, run by run, before and after.
fn errors(request: &Request, d: &Diagnosis) {
    let model =
        Arc::new(RobotModel::from_bytes("robot", &request.robot_toml, &request.mjcf).unwrap());
    let trials: Vec<Trial> = (request.runs.iter())
        .map(|r| Trial::new(&model, r).unwrap())
        .collect();
    let whole = SegmentOptions {
        loose_s: f64::INFINITY,
        ..SegmentOptions::default()
    };
    let data = Data::new(&model, trials, whole);
    let terms = extension::terms(&d.extension, &model).unwrap();
    let replayer = Replayer::new(model, request.options.threads).unwrap();
    let p = replayer.predict(&data, &[Vec::new(), terms]).unwrap();
    for s in &data.segments {
        let of = |prediction: &[f32]| {
            let (mut sum, mut n) = (0.0, 0.0);
            for k in (s.pieces.iter())
                .filter(|p| p.kind == Kind::Position)
                .flat_map(|p| p.range.clone())
            {
                sum += (data.value[k] - f64::from(prediction[k])).abs();
                n += 1.0;
            }
            sum / f64::max(n, 1.0)
        };
        println!(
            "  {:?} {}: mean absolute error of pos {:.4} -> {:.4} rad",
            data.trials[s.trial].role,
            data.trials[s.trial].name,
            of(&p[0]),
            of(&p[1])
        );
    }
}
