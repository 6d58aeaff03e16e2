//! A real servo that swings a weight (recordings of the BAM project, not part of this repository): what
//! diagnosis makes of them, beside the usual models of friction fitted to the same runs with the same
//! simulator. The folder is `CAUDATA_DATA` or `../shared/data` beside the repository; without it the test
//! says so and ends.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_gap::effects;
use caudata_gap::import::bam;
use caudata_gap::replay::{Data, Replayer, SegmentOptions, Term, Variant};
use caudata_gap::trial::{Kind, Role, Run, Trial};
use caudata_gap::{Options, Request, diagnose, extension};
use caudata_model::RobotModel;
use caudata_runlog::RunLog;

fn recordings() -> Option<PathBuf> {
    let given = std::env::var_os("CAUDATA_DATA").map(PathBuf::from);
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let folder = given.unwrap_or(beside).join("xl330_pendulum");
    folder.is_dir().then_some(folder)
}

fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// All gains but 200 and all trajectories but `sin_sin` are fitted to.
fn runs(folder: &Path, model: &RobotModel) -> Vec<Run> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.extension().is_some_and(|e| e == "json"))
        .collect();
    files.sort();
    let out = tempfile::tempdir().unwrap();
    files
        .iter()
        .map(|file| {
            let imported = bam::read(file, model).unwrap();
            let held = imported.name.starts_with("sin_sin") || imported.name.contains("kp200");
            let log = RunLog::read(&imported.write(out.path()).unwrap()).unwrap();
            Run {
                name: imported.name,
                log,
                role: if held { Role::Holdout } else { Role::Fit },
                sha256: String::new(),
            }
        })
        .collect()
}

/// Every run in one piece, from its first row to its last, however long nothing holds the joint.
fn whole_runs() -> SegmentOptions {
    SegmentOptions { loose_s: f64::INFINITY, ..SegmentOptions::default() }
}

/// The runs, replayed in one go, and the places of position samples per run.
struct Bench {
    replayer: Replayer,
    data: Data,
}

impl Bench {
    /// Mean absolute error of position, run by run, rad. `[V][runs]`
    fn errors(&self, variants: &[Variant]) -> Vec<Vec<f64>> {
        let predictions = self.replayer.predict(&self.data, variants).unwrap();
        let of = |p: &Vec<f32>| -> Vec<f64> {
            (self.data.segments.iter())
                .map(|s| {
                    let (mut sum, mut n) = (0.0, 0.0);
                    for k in (s.pieces.iter())
                        .filter(|p| p.kind == Kind::Position)
                        .flat_map(|p| p.range.clone())
                    {
                        let off = (self.data.value[k] - f64::from(p[k])).abs();
                        sum += if off.is_finite() { off } else { 10.0 };
                        n += 1.0;
                    }
                    sum / f64::max(n, 1.0)
                })
                .collect()
        };
        predictions.iter().map(of).collect()
    }

    fn mean(&self, errors: &[f64], take: impl Fn(&Trial) -> bool) -> f64 {
        let of: Vec<f64> = (self.data.segments.iter().zip(errors))
            .filter(|(s, _)| take(&self.data.trials[s.trial]))
            .map(|(_, e)| *e)
            .collect();
        of.iter().sum::<f64>() / of.len() as f64
    }

    /// Fits the parameters of `ids` to the runs of role fit by pattern search on the mean absolute error
    /// itself: what is reported is what is minimised, which favours these models.
    fn fitted(&self, ids: &[&str]) -> Variant {
        let model = self.replayer.model().clone();
        let mut terms: Variant = ids
            .iter()
            .map(|id| {
                let effect = effects::find(id).unwrap();
                let place = effect.places(&model)[0].clone();
                let values = effect.neutral(&model, &place);
                Term { effect, place, values }
            })
            .collect();
        let cost = |e: &[f64]| self.mean(e, |t| t.role == Role::Fit);
        let mut best = cost(&self.errors(std::slice::from_ref(&terms))[0]);
        let mut share = 0.25;
        while share > 0.002 {
            let mut tries: Vec<Variant> = Vec::new();
            for (i, term) in terms.iter().enumerate() {
                for p in 0..term.values.len() {
                    let (low, high) = term.effect.bounds(&model, &term.place, p);
                    // ranges are wide: steps go with the value where there is one
                    let step = share
                        * (0.2 * (high - low)).min(
                            2.0 * term.values[p].abs()
                                + 20.0 * term.effect.scale(&model, &term.place, p).abs(),
                        );
                    for by in [-step, -0.3 * step, 0.3 * step, step] {
                        let mut next = terms.clone();
                        next[i].values[p] = (next[i].values[p] + by).clamp(low, high);
                        tries.push(next);
                    }
                }
            }
            let errors = self.errors(&tries);
            let (k, least) = errors
                .iter()
                .map(|e| cost(e))
                .enumerate()
                .min_by(|a, b| a.1.total_cmp(&b.1))
                .unwrap();
            if least < best * (1.0 - 1e-4) {
                best = least;
                terms = tries[k].clone();
            } else {
                share *= 0.5;
            }
        }
        terms
    }
}

#[test]
fn a_real_servo_is_explained_better_than_by_the_usual_models() {
    let Some(folder) = recordings() else {
        say("skipped: the recordings are not here (CAUDATA_DATA)");
        return;
    };
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    let robot_toml = std::fs::read(robots.join("xl330_pendulum.robot.toml")).unwrap();
    let mjcf = std::fs::read(robots.join("xl330_pendulum.xml")).unwrap();
    let model = Arc::new(RobotModel::from_bytes("xl330", &robot_toml, &mjcf).unwrap());
    let runs = runs(&folder, &model);
    assert_eq!(runs.len(), 16);
    let trials = runs.iter().map(|r| caudata_gap::reading::trial(&model, r).unwrap()).collect();
    let bench = Bench {
        replayer: Replayer::new(Arc::clone(&model), 2).unwrap(),
        data: Data::new(&model, trials, whole_runs()),
    };
    let found = diagnose(
        &Request {
            robot_toml,
            mjcf,
            label: "xl330".to_owned(),
            runs,
            data_faults: Vec::new(),
            options: Options::default(),
        },
        &mut |_| (),
    )
    .unwrap();
    let ours = extension::terms(&found.extension, &model).unwrap();
    // All of them with a free gain and a free rotor: what is compared is friction.
    let models: Vec<(&str, Variant)> = vec![
        ("robot file as it is", Vec::new()),
        ("PD + viscous", bench.fitted(&["kp_error", "armature", "viscous_friction"])),
        (
            "PD + viscous + Coulomb",
            bench.fitted(&["kp_error", "armature", "viscous_friction", "coulomb_friction"]),
        ),
        (
            "PD + viscous + Coulomb + Stribeck",
            bench.fitted(&[
                "kp_error",
                "armature",
                "viscous_friction",
                "coulomb_friction",
                "stribeck_friction",
            ]),
        ),
        ("diagnosis", ours),
    ];
    let variants: Vec<Variant> = models.iter().map(|m| m.1.clone()).collect();
    let errors = bench.errors(&variants);
    say("mean absolute error of position, rad: fitted | kp 200 | sin_sin");
    let rows: Vec<[f64; 3]> = errors
        .iter()
        .map(|e| {
            [
                bench.mean(e, |t| t.role == Role::Fit),
                bench.mean(e, |t| t.name.contains("kp200")),
                bench.mean(e, |t| t.name.starts_with("sin_sin")),
            ]
        })
        .collect();
    for ((name, _), r) in models.iter().zip(&rows) {
        say(&format!("{name:36} {:.4}  {:.4}  {:.4}", r[0], r[1], r[2]));
    }
    say(&format!("{:?}: {}", found.report.verdict, found.report.summary));
    for c in &found.report.causes {
        say(&format!(
            "  {} {:.2} {:?}",
            c.effect,
            c.confidence,
            c.parameters
                .iter()
                .map(|(n, p)| format!("{n} {:.4} [{:.4}, {:.4}]", p.value, p.ci_low, p.ci_high))
                .collect::<Vec<_>>()
        ));
        for r in c.rejected.iter().take(3) {
            say(&format!("     not {}: {}", r.effect, r.reason));
        }
    }
    let ours = rows[4];
    for (row, (name, _)) in rows[..4].iter().zip(&models) {
        assert!(ours[1] < row[1], "kp 200: {name} is better");
        assert!(ours[2] < row[2], "sin_sin: {name} is better");
    }
    assert!(ours[2] <= 0.055, "sin_sin {:.4}", ours[2]);
    let names: Vec<&str> = found.report.causes.iter().map(|c| c.effect.as_str()).collect();
    let by_load = ["load_dependent_friction", "drive_asymmetry", "load_stiction"];
    assert!(names.iter().any(|n| by_load.contains(n)), "{names:?}");
}
