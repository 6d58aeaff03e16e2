//! An evaluation as one page that is opened in a browser: tables, curves, and a replay in three dimensions.
//!
//! The page needs nothing but itself: style, script and data are inside, and it asks no network for anything.
//! [`page`] is a pure function; the script is `page/*.js`, [`COMMON_SCRIPT`] first.

mod film;
mod pack;
mod scene;

use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_task::{BodyPlan, PerJoint};
use serde::Serialize;

pub use film::{Curves, FilmData, motion_row, pose_row};
pub use pack::Packed;
pub use scene::{GroundScene, RobotScene};

use crate::{Envelope, Outcome, ScenarioResult, Settings, SuiteResult, suite};

/// What every page with a robot or a chart begins its script with, in order; each part adds to one object
/// `caudata`: numbers, drawing, the scene, charts, and what text is made with.
pub const COMMON_SCRIPT: [&str; 5] = [
    include_str!("page/core.js"),
    include_str!("page/render.js"),
    include_str!("page/scene.js"),
    include_str!("page/sheet.js"),
    include_str!("page/text.js"),
];
/// What the page of an evaluation adds.
const SCRIPT: [&str; 4] = [
    include_str!("page/replay.js"),
    include_str!("page/plots.js"),
    include_str!("page/tables.js"),
    include_str!("page/main.js"),
];
/// How all pages look.
pub const STYLE: &str = include_str!("page/style.css");
const FRAME: &str = include_str!("page/page.html");

/// Speeds that the paper reports for the robot at a 0.3 m/s command (Tian et al.), m/s.
const PAPER_MPS: [(&str, &str, f64); 4] = [
    ("flat ground", suite::FLAT, 0.23),
    ("rough easy, 2 cm 15°", suite::ROUGH[0], 0.19),
    ("rough medium, 4 cm 15°", suite::ROUGH[1], 0.18),
    ("rough hard, 4 cm 25°", suite::ROUGH[2], 0.17),
];

/// Everything on the page.
#[derive(Debug, Serialize)]
struct Page<'a> {
    about: About,
    paper: Vec<PaperRow>,
    result: &'a SuiteResult,
    robot: RobotScene,
    /// What the servo of each joint can give, in policy order.
    servos: Vec<Envelope>,
    /// Which joints move a leg.
    in_leg: PerJoint<bool>,
    joint_names: Vec<String>,
    foot_names: Vec<String>,
    /// One per scenario.
    shown: Vec<Shown>,
}

/// What was evaluated.
#[derive(Debug, Serialize)]
struct About {
    robot: String,
    robot_hash: String,
    run_id: String,
    training_commit: String,
    env_steps: u64,
    seed: u64,
    settle_s: f64,
}

#[derive(Debug, Serialize)]
struct PaperRow {
    name: &'static str,
    paper_mps: f64,
    measured: Option<ScenarioSpeed>,
}

#[derive(Debug, Serialize)]
struct ScenarioSpeed {
    scenario: usize,
    mean: f64,
    ci_low: f64,
    ci_high: f64,
    walks: Option<bool>,
}

/// Curves and film of one scenario.
#[derive(Debug, Serialize)]
struct Shown {
    curves: Option<Curves>,
    /// Commanded and achieved per command, where there are several.
    grid: Vec<[f32; 6]>,
    film: Option<FilmData>,
}

/// The page, as HTML. `outcomes` are those of `result`'s scenarios, in order.
///
/// # Errors
/// When the data cannot be written as JSON.
pub fn page(
    result: &SuiteResult,
    outcomes: &[Outcome],
    model: &RobotModel,
    policy: &PolicyFile,
    settings: &Settings,
) -> Result<String, serde_json::Error> {
    let metadata = policy.metadata();
    let names = |names: Vec<&str>| names.into_iter().map(str::to_owned).collect();
    let page = Page {
        about: About {
            robot: model.name().to_owned(),
            robot_hash: model.hash_hex(),
            run_id: metadata.run_id.clone(),
            training_commit: metadata.training_commit.clone(),
            env_steps: metadata.env_steps,
            seed: settings.seed,
            settle_s: settings.settle_s,
        },
        paper: PAPER_MPS.iter().map(|row| paper_row(row, result)).collect(),
        result,
        robot: RobotScene::of(model),
        servos: Envelope::of_each(model),
        in_leg: BodyPlan::from_model(model).in_leg,
        joint_names: names(model.actuated_names()),
        foot_names: model.feet().iter().map(|f| f.name.clone()).collect(),
        shown: outcomes.iter().map(|o| shown(o, settings)).collect(),
    };
    let data = serde_json::to_string(&page)?;
    let title = format!("caudata: policy {} on {}", result.policy_version, model.name());
    Ok(filled(&title, &data))
}

fn filled(title: &str, data: &str) -> String {
    let script = [COMMON_SCRIPT.concat(), SCRIPT.concat()].concat();
    fill(FRAME, STYLE, &script, title, data)
}

fn shown(outcome: &Outcome, settings: &Settings) -> Shown {
    let period_s = outcome.period_s;
    let one = outcome.commands < 2;
    Shown {
        curves: if one { Curves::of(&outcome.tracks, period_s) } else { None },
        grid: film::grid(&outcome.tracks, outcome.commands, period_s, settings.settle_s),
        film: FilmData::of(outcome),
    }
}

fn paper_row(row: &(&'static str, &str, f64), result: &SuiteResult) -> PaperRow {
    let (name, scenario, paper_mps) = *row;
    let index = result.scenarios.iter().position(|s| s.name == scenario);
    let speed = |index: usize, s: &ScenarioResult| ScenarioSpeed {
        scenario: index,
        mean: s.vx_mps.mean,
        ci_low: s.vx_mps.ci_low,
        ci_high: s.vx_mps.ci_high,
        walks: s.walks(),
    };
    PaperRow { name, paper_mps, measured: index.map(|i| speed(i, &result.scenarios[i])) }
}

/// Puts style, script, title and data into a frame. `<` never appears in the data as itself: a name in it
/// cannot close the element it is in.
pub fn fill(frame: &str, style: &str, script: &str, title: &str, data: &str) -> String {
    let escaped = data.replace('<', "\\u003c");
    let plain = title.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    frame
        .replace("{{title}}", &plain)
        .replace("{{style}}", style)
        .replace("{{script}}", script)
        .replace("{{data}}", &escaped)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_cannot_leave_its_element() {
        let page = filled("a<b", r#"{"name":"</script><script>alert(1)"}"#);
        assert!(page.contains("a&lt;b"));
        assert!(page.contains(r"\u003c/script>\u003cscript>alert(1)"));
        assert!(!page.contains("{{"));
    }

    #[test]
    fn the_page_asks_no_one_for_anything() {
        let page = filled("t", "{}");
        for outside in ["http://", "https://", "src=", "@import", "url(", "fetch("] {
            assert!(!page.contains(outside), "{outside}");
        }
    }
}
