//! The page of a made-up diagnosis: whole, self-contained, safe. `CAUDATA_WRITE_PAGE=file.html` keeps it to
//! be looked at.

use std::collections::BTreeMap;

use caudata_gap::page::render;
use caudata_gap::plots::{Correlation, Horizon, Hypothesis, Overlay, Plots, Series, Signature};
use caudata_gap::report::{
    Cause, Compute, DataFault, Divergence, Doubt, DoubtKind, Floor, Gain, Grounds, NextExperiment,
    Parameter, Rejected, Report, RunUse, Unexplained, Verdict,
};

fn parameter(value: f64, unit: &str, half: f64) -> Parameter {
    Parameter {
        value,
        unit: unit.to_owned(),
        ci_low: value - half,
        ci_high: value + half,
        at_bound: false,
    }
}

fn divergence(scale: f64) -> Vec<Divergence> {
    let joints = [
        "spine_1", "spine_2", "FL_hip", "FL_knee", "FR_hip", "FR_knee", "HL_hip", "HL_knee",
        "HR_hip", "HR_knee",
    ];
    let cells = [
        ("pos", "all"),
        ("pos", "slow"),
        ("pos", "fast"),
        ("pos", "reversal"),
        ("vel", "all"),
        ("vel", "fast"),
        ("cur", "all"),
        ("cur", "loaded"),
    ];
    let mut out = Vec::new();
    for (j, joint) in joints.iter().enumerate() {
        for (c, (signal, regime)) in cells.iter().enumerate() {
            let ratio = 0.9
                + scale
                    * (if joint.starts_with("FL") { 14.0 } else { 0.5 })
                    * ((j * 7 + c * 3) % 5) as f64
                    / 4.0;
            out.push(Divergence {
                signal: (*signal).to_owned(),
                joint: (*joint).to_owned(),
                regime: (*regime).to_owned(),
                rmse: 0.0015 * ratio,
                noise_floor: 0.0015,
                ratio,
                p: if ratio > 2.0 { 0.001 } else { 0.6 },
            });
        }
    }
    out
}

fn sample() -> (Report, Plots) {
    let friction = Cause {
        effect: "coulomb_friction".to_owned(),
        layer: "transmission".to_owned(),
        location: vec!["FL_hip".to_owned()],
        parameters: BTreeMap::from([("friction_nm".to_owned(), parameter(0.084, "N·m", 0.006))]),
        confidence: 0.93,
        confidence_of_kind: 0.93,
        alternatives: vec![],
        together: Vec::new(),
        synonyms: Vec::new(),
        elsewhere: Vec::new(),
        evidence: vec![
            "The torque jumps by 0.17 N·m at every reversal, at any speed.".to_owned(),
            "Error on held-out runs falls by 71 % (66 to 75).".to_owned(),
        ],
        rejected: vec![Rejected {
            effect: "viscous_friction".to_owned(),
            reason: "explains 22 % less on held-out runs: the jump does not grow with speed"
                .to_owned(),
        }],
        assumed: vec!["servo.preset.xm430.friction_loss_nm".to_owned()],
        grounds: Grounds::default(),
    };
    let delay = Cause {
        effect: "command_delay".to_owned(),
        layer: "timing".to_owned(),
        location: vec![],
        parameters: BTreeMap::from([("delay_s".to_owned(), parameter(0.0123, "s", 0.0009))]),
        confidence: 0.58,
        confidence_of_kind: 0.58,
        alternatives: vec!["command_low_pass".to_owned()],
        together: Vec::new(),
        synonyms: Vec::new(),
        elsewhere: vec![vec!["FR_knee".to_owned()]],
        evidence: vec!["Lag is 12 ms at every frequency.".to_owned()],
        rejected: vec![],
        assumed: vec![],
        grounds: Grounds::default(),
    };
    let way = Cause {
        effect: "pre_sliding".to_owned(),
        layer: "transmission".to_owned(),
        location: vec!["FL_hip".to_owned()],
        parameters: BTreeMap::from([("way_rad".to_owned(), parameter(0.0088, "rad", 0.001))]),
        confidence: 0.1,
        confidence_of_kind: 0.1,
        alternatives: vec![],
        together: Vec::new(),
        synonyms: Vec::new(),
        elsewhere: Vec::new(),
        evidence: vec!["takes 39 % off the misfit of held-out runs".to_owned()],
        rejected: vec![],
        assumed: vec![],
        grounds: Grounds::default(),
    };
    let gain = |b: f64, a: f64| Gain {
        before: b,
        after: a,
        ratio: a / b,
        ci_low: a / b * 0.93,
        ci_high: a / b * 1.08,
    };
    let report = Report {
        verdict: Verdict::Ambiguous,
        summary: "Coulomb friction at FL_hip is 0.084 N·m instead of 0.038; commands arrive 12 ms late, or pass a low-pass: record chirp_small to tell which.".to_owned(),
        divergence: divergence(1.0),
        divergence_after: divergence(0.08),
        causes: vec![friction, delay],
        gain: BTreeMap::from([("pos".to_owned(), gain(0.0213, 0.0058)), ("vel".to_owned(), gain(0.31, 0.12)), ("cur".to_owned(), gain(0.08, 0.047))]),
        leads: vec![way],
        doubts: Vec::new(),
        position_errors: vec![],
        model: vec![],
        local_gaps: vec![],
        unfinished: false,
        unexplained: vec![Unexplained {
            location: "HR_knee cur".to_owned(),
            depends_on: vec!["position".to_owned()],
            description: "A ripple of 4 mA with the joint's angle, 11 periods per turn.".to_owned(),
            nearest: Some("cogging".to_owned()),
        }],
        next_experiment: Some(NextExperiment {
            trial: "chirp_small".to_owned(),
            joints: vec!["FL_hip".to_owned()],
            reason: "50 mrad, 0.5 to 10 Hz, on a stand, 3 times: made to show command_delay, command_low_pass".to_owned(),
            separates: vec!["command_delay".to_owned(), "command_low_pass".to_owned()],
            payload: None,
        }),
        detection_floor: BTreeMap::from([
            ("stribeck_friction@FL_hip".to_owned(), Floor { parameter: "stribeck_nm".to_owned(), value: 0.011, unit: "N·m".to_owned(), excited: true }),
            ("thermal_derating".to_owned(), Floor { parameter: "rise".to_owned(), value: 0.0, unit: "K".to_owned(), excited: false }),
        ]),
        data_faults: vec![DataFault {
            kind: "touch".to_owned(),
            location: "run_3 <FL_hip>".to_owned(),
            detail: "is off by up to 0.05 rad from t = 4.0 to 5.1 s, as if touched".to_owned(),
            fatal: false,
        }],
        runs: vec![
            RunUse { name: "chirp_1".to_owned(), role: "fit".to_owned(), duration_s: 14.0, sha256: "ab".repeat(32) },
            RunUse { name: "gait_1".to_owned(), role: "holdout".to_owned(), duration_s: 20.0, sha256: "cd".repeat(32) },
        ],
        compute: Compute { candidates: 412, rollouts: 5180, simulated_s: 61234.0, seconds: 41.2 },
    };
    (report, plots())
}

fn plots() -> Plots {
    let time_s: Vec<f64> = (0..1400).map(|i| 0.01 * f64::from(i)).collect();
    let wave = |lag: f64, size: f64| -> Vec<f64> {
        time_s.iter().map(|t| size * ((t - lag) * (1.0 + 0.4 * t)).sin()).collect()
    };
    let measured = wave(0.05, 0.19);
    let around = |d: f64| {
        measured
            .iter()
            .enumerate()
            .map(|(i, x)| (!(500..560).contains(&i)).then_some(x + d))
            .collect()
    };
    let overlay = |joint: &str| Overlay {
        run: "chirp_1".to_owned(),
        signal: "pos".to_owned(),
        joint: joint.to_owned(),
        unit: "rad".to_owned(),
        time_s: time_s.clone(),
        command: wave(0.0, 0.2),
        measured: around(0.0),
        measured_low: around(-0.006),
        measured_high: around(0.006),
        before: wave(0.0, 0.23),
        after: wave(0.049, 0.19),
    };
    let speeds: Vec<f64> = (-30..=30).map(|i| 0.1 * f64::from(i)).collect();
    let map = |c: f64| speeds.iter().map(|v| c * v.signum() + 0.006 * v).collect::<Vec<_>>();
    let hz: Vec<f64> = (0..12).map(|i| 0.5 * 1.3f64.powi(i)).collect();
    let series = |label: &str, scatter: bool, x: &[f64], y: Vec<f64>, spread: f64| Series {
        label: label.to_owned(),
        scatter,
        x: x.to_vec(),
        spread: if spread > 0.0 { vec![spread; y.len()] } else { vec![] },
        y,
    };
    Plots {
        overlays: vec![overlay("FL_hip"), overlay("FL_knee"), overlay("FR_hip")],
        signatures: vec![
            Signature {
                effect: "coulomb_friction".to_owned(),
                joint: "FL_hip".to_owned(),
                title: "Friction map".to_owned(),
                x_label: "speed, rad/s".to_owned(),
                y_label: "torque lost, N·m".to_owned(),
                series: vec![
                    series("measured", true, &speeds, map(0.08), 0.0),
                    series("before", false, &speeds, map(0.038), 0.0),
                    series("after", false, &speeds, map(0.084), 0.006),
                ],
            },
            Signature {
                effect: "command_delay".to_owned(),
                joint: String::new(),
                title: "Lag against frequency".to_owned(),
                x_label: "frequency, Hz".to_owned(),
                y_label: "lag, ms".to_owned(),
                series: vec![
                    series(
                        "measured",
                        true,
                        &hz,
                        hz.iter().map(|f| 12.0 + 0.3 * f.sin()).collect(),
                        0.0,
                    ),
                    series("before", false, &hz, vec![0.5; 12], 0.0),
                    series("after", false, &hz, vec![12.3; 12], 0.9),
                    series(
                        "low-pass instead",
                        false,
                        &hz,
                        hz.iter().map(|f| 12.0 / (1.0 + 0.1 * f)).collect(),
                        0.0,
                    ),
                ],
            },
        ],
        horizons: ["pos", "vel"]
            .map(|s| Horizon {
                signal: s.to_owned(),
                unit: "rad".to_owned(),
                horizon_s: vec![0.1, 0.5, 2.0, 14.0],
                before: vec![0.005, 0.016, 0.02, 0.0213],
                after: vec![0.002, 0.004, 0.0055, 0.0058],
                floor: vec![0.0015; 4],
            })
            .to_vec(),
        hypotheses: [
            ("coulomb_friction", 0.71, 0.93, true),
            ("stribeck_friction", 0.64, 0.05, true),
            ("viscous_friction", 0.43, 0.01, false),
            ("gear_backlash", 0.1, 0.0, false),
            ("kp_error", -0.1, 0.0, false),
        ]
        .iter()
        .map(|(e, share, p, set)| Hypothesis {
            effect: (*e).to_owned(),
            location: vec!["FL_hip".to_owned()],
            share_fit: share + 0.05,
            share_holdout: *share,
            ci_low: share - 0.06,
            ci_high: share + 0.05,
            probability: *p,
            in_answer_set: *set,
            accepted: *p > 0.5,
            parameters: BTreeMap::new(),
        })
        .collect(),
        correlation: Correlation {
            names: vec![
                "coulomb_friction@FL_hip.friction_nm".to_owned(),
                "command_delay.delay_s".to_owned(),
            ],
            matrix: vec![vec![1.0, -0.31], vec![-0.31, 1.0]],
        },
    }
}

/// Elements open and close in order; attributes are quoted. (Void elements of HTML are known.)
fn well_formed(html: &str) {
    let mut open: Vec<&str> = Vec::new();
    let mut rest = html.strip_prefix("<!doctype html>").unwrap();
    if let Some(i) = rest.find("<style>") {
        let j = rest.find("</style>").unwrap();
        assert!(!rest[i + 7..j].contains('<'));
    }
    while let Some(i) = rest.find('<') {
        let j = i + rest[i..].find('>').expect("a tag ends");
        let tag = &rest[i + 1..j];
        rest = &rest[j + 1..];
        let name = tag.trim_start_matches('/').split([' ', '/']).next().unwrap();
        if tag.starts_with('/') {
            assert_eq!(open.pop(), Some(name), "in {:?}", &rest[..rest.len().min(80)]);
        } else if !tag.ends_with('/') && !["meta", "br"].contains(&name) {
            assert_eq!(tag.matches('"').count() % 2, 0, "{tag}");
            open.push(name);
        }
    }
    assert!(open.is_empty(), "{open:?}");
}

#[test]
fn the_page_is_whole_and_needs_nothing_else() {
    let (report, plots) = sample();
    let page = render("polymander", &report, Some(&plots));
    if let Some(path) = std::env::var_os("CAUDATA_WRITE_PAGE") {
        std::fs::write(path, &page).unwrap();
    }
    well_formed(&page);
    for foreign in ["http:", "https:", "src=", "<script", "@import", "url("] {
        assert!(!page.contains(foreign), "{foreign}");
    }
    for part in [
        "Ambiguous",
        "Coulomb friction",
        "0.084",
        "Friction map",
        "Lag against frequency",
        "chirp_small",
        "What could have been seen",
        "as if touched",
        "HR_knee cur",
        "command low pass",
        "the same at FR_knee",
        "Leads",
        "Pre sliding",
        "It corrects what the robot file assumes",
    ] {
        assert!(
            page.contains(part) || page.contains(&part.replace("command", "Command")),
            "{part}"
        );
    }
    // every picture has a title and a text for those who do not see it
    assert_eq!(
        page.matches("<svg").count() - page.matches("aria-hidden").count(),
        page.matches("role=\"img\" aria-label=").count() - page.matches("class=\"conf\"").count()
    );
    assert!(
        page.contains("&lt;FL_hip&gt;") && !page.contains("<FL_hip>"),
        "text from logs is made safe"
    );
    assert!(page.len() < 1_000_000);
}

#[test]
fn a_page_of_little_is_still_a_page() {
    for verdict in [
        Verdict::NoGap,
        Verdict::Explained,
        Verdict::PartlyExplained,
        Verdict::Unexplained,
        Verdict::InsufficientData,
        Verdict::DataFault,
    ] {
        let report = Report {
            verdict,
            summary: "s".to_owned(),
            divergence: vec![],
            divergence_after: vec![],
            causes: vec![],
            gain: BTreeMap::new(),
            leads: Vec::new(),
            doubts: Vec::new(),
            position_errors: vec![],
            model: vec![],
            local_gaps: vec![],
            unfinished: false,
            unexplained: vec![],
            next_experiment: None,
            detection_floor: BTreeMap::new(),
            data_faults: vec![],
            runs: vec![],
            compute: Compute::default(),
        };
        well_formed(&render("rig", &report, None));
        // numbers that are none must not break a picture
        let mut odd = sample();
        odd.0.verdict = verdict;
        odd.0.divergence[0].ratio = f64::NAN;
        odd.1.overlays[0].before = vec![f64::NAN; 1400];
        odd.1.overlays[1].time_s.clear();
        odd.1.signatures[0].series.clear();
        let page = render("rig", &odd.0, Some(&odd.1));
        well_formed(&page);
        assert!(!page.contains("NaN") && !page.contains("inf\""), "{verdict:?}");
    }
}

#[test]
fn a_report_of_an_earlier_version_has_no_doubts_and_no_leads() {
    let report = Report {
        verdict: Verdict::PartlyExplained,
        summary: String::new(),
        divergence: vec![],
        divergence_after: vec![],
        causes: vec![],
        leads: Vec::new(),
        doubts: vec![Doubt {
            kind: DoubtKind::InconstantSize,
            location: "FL_knee".to_owned(),
            detail: "It has another size in each run.".to_owned(),
        }],
        gain: BTreeMap::new(),
        position_errors: vec![],
        model: vec![],
        local_gaps: vec![],
        unfinished: false,
        unexplained: vec![],
        next_experiment: None,
        detection_floor: BTreeMap::new(),
        data_faults: vec![],
        runs: vec![],
        compute: Compute::default(),
    };
    let mut json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["doubts"][0]["kind"], "inconstant_size");
    assert_eq!(json["doubts"][0]["where"], "FL_knee");
    let again: Report = serde_json::from_value(json.clone()).unwrap();
    assert_eq!(again, report);
    json.as_object_mut().unwrap().remove("doubts");
    json.as_object_mut().unwrap().remove("leads");
    let old: Report = serde_json::from_value(json).unwrap();
    assert!(old.doubts.is_empty() && old.leads.is_empty());
}
