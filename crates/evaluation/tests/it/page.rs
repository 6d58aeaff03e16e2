//! The page of an evaluation: what is in it is what happened, and its script runs.

use std::path::Path;
use std::process::{Command, Stdio};

use caudata_evaluation::{Estimate, Evaluation, Film, Settings, Suite, report};
use caudata_model::Pose;
use caudata_task::PolicyContract;
use serde_json::{Value, json};

use crate::by_hand::{config, robot, vibrating};

/// A page about a policy that vibrates, and the film of its first scenario.
fn page() -> (String, Film) {
    let (config, model) = (config(), robot());
    let contract = PolicyContract::new(&model, &config.task).unwrap();
    let policy = vibrating(&contract, 7.5);
    let evaluation = Evaluation {
        config: &config,
        model: &model,
        policy: &policy,
        suite: Suite::Transition,
        settings: Settings { episodes: 2, episode_s: 4.0, film: true, ..Settings::default() },
        referee: None,
    };
    let (mut result, outcomes) = evaluation.run(&|| true, &mut |_, _| {}).unwrap();
    // There and back, both beaches, swimming straight and to either side.
    assert_eq!(result.scenarios.len(), 7);
    // as of the suite `steps`
    result.scenarios[0].arrived = Some(Estimate::share(1, 2));
    let page = report::page(&result, &outcomes, &model, &policy, &evaluation.settings).unwrap();
    (page, outcomes[0].film.clone().unwrap())
}

/// The text of the element that begins with `open`.
fn element<'a>(page: &'a str, open: &str) -> &'a str {
    let start = page.find(open).unwrap() + open.len();
    &page[start..][..page[start..].find("</script>").unwrap()]
}

fn data(page: &str) -> Value {
    serde_json::from_str(element(page, r#"<script type="application/json" id="data">"#)).unwrap()
}

/// Whether a program is there to be run; says so where it is not.
fn found(program: &str) -> bool {
    let there = Command::new(program)
        .arg("--version")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success());
    if !there {
        eprintln!("skipped: there is no {program} here");
    }
    there
}

#[test]
fn the_data_is_what_happened() {
    let (page, film) = page();
    assert!(page.len() < 1_500_000, "{} bytes", page.len());
    let data = data(&page);
    assert_eq!(data["shown"].as_array().unwrap().len(), 7);
    let shown = &data["shown"][0]["film"];
    // 4 s at 50 Hz, the last frame missing
    assert_eq!(shown["pose"]["rows"], 199);
    assert_eq!(shown["motion"]["rows"], 199);
    assert_eq!(shown["effort"]["rows"], 100);
    let joints = film.poses[0].joint_pos_rad.len();
    assert_eq!(shown["pose"]["low"].as_array().unwrap().len(), 7 + joints);
    // half a step of the resolution is the largest error: below a tenth of a milliradian and of a millimetre
    // here
    for step in shown["pose"]["step"].as_array().unwrap() {
        assert!(step.as_f64().unwrap() < 2e-4, "{step}");
    }
    let water_m = shown["ground"]["water_m"].as_f64().unwrap();
    assert!((water_m - 0.4).abs() < 1e-6, "{water_m}");
    assert!(shown["ground"]["grid"]["columns"].as_u64().unwrap() > 50);
}

/// The script's own kinematics against the model's: what the replay shows is where the robot was.
#[test]
fn the_script_puts_every_link_where_the_model_does() {
    if !found("node") {
        return;
    }
    let (page, film) = page();
    let harness = r#"
        const fs = require("fs"), vm = require("vm");
        const input = JSON.parse(fs.readFileSync(0, "utf8"));
        const context = vm.createContext({ atob, console });
        vm.runInContext(input.script + "\nthis.caudata = caudata;", context);
        const { caudata } = context, page = input.data, out = [];
        const film = caudata.openFilm(page.shown[0].film);
        for (const frame of input.frames) {
            out.push(caudata.linkPoses(page.robot, caudata.poseAt(film.pose, frame)).map((p) => [...p.pos, ...p.quat]));
        }
        const between = caudata.poseAt(film.pose, 10.5).pos[0];
        console.log(JSON.stringify({ out, between, ground: caudata.groundHeight(film, 0, 0), runs: caudata.runs([0, 1, 1, 0, 1]), ticks: caudata.ticks(0, 1, 5) }));
    "#;
    let frames = [0, 57, 198];
    let script = element(&page, "<script>\n");
    let input = json!({ "script": script, "data": data(&page), "frames": frames }).to_string();
    let answer = run_with_input("node", &["-e", harness], &input);
    let answer: Value = serde_json::from_str(&answer).unwrap();

    let model = robot();
    for (frame, found) in frames.into_iter().zip(answer["out"].as_array().unwrap()) {
        let pose = &film.poses[frame];
        let base = Pose {
            pos_m: pose.base_pos_m.map(f64::from),
            quat_wxyz: pose.base_quat_wxyz.map(f64::from),
        };
        let joints: Vec<f64> = pose.joint_pos_rad.iter().map(|&q| f64::from(q)).collect();
        let expected = model.kinematics(&base, &joints).unwrap().links;
        for (l, (expected, found)) in expected.iter().zip(found.as_array().unwrap()).enumerate() {
            let at = |i: usize| found[i].as_f64().unwrap();
            for i in 0..3 {
                let off = at(i) - expected.pos_m[i];
                assert!(off.abs() < 5e-4, "frame {frame} link {l} axis {i}: {off} m");
            }
            let dot: f64 = (0..4).map(|i| at(3 + i) * expected.quat_wxyz[i]).sum();
            assert!(dot.abs() > 1.0 - 1e-6, "frame {frame} link {l}: {dot}");
        }
    }
    let x = |frame: usize| f64::from(film.poses[frame].base_pos_m[0]);
    let between = answer["between"].as_f64().unwrap();
    assert!((between - (x(10) + x(11)) / 2.0).abs() < 1e-4);
    // the shore's land is 0.1 m above water at 0.4 m
    assert!((answer["ground"].as_f64().unwrap() - 0.5).abs() < 1e-3);
    assert_eq!(answer["runs"], json!([[1, 3], [4, 5]]));
    let ticks: Vec<f64> = serde_json::from_value(answer["ticks"].clone()).unwrap();
    assert_eq!(ticks.len(), 6);
    assert!((ticks[1] - 0.2).abs() < 1e-12);
}

fn run_with_input(program: &str, args: &[&str], input: &str) -> String {
    use std::io::Write;
    let mut child = Command::new(program)
        .args(args)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    stdin.write_all(input.as_bytes()).unwrap();
    drop(stdin);
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{program}: {}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn a_browser_opens_the_page_without_an_error() {
    let Some(browser) =
        ["chromium", "chromium-browser", "google-chrome"].into_iter().find(|b| found(b))
    else {
        eprintln!("skipped: no Chromium here");
        return;
    };
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("page");
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("page.html");
    std::fs::write(&path, page().0).unwrap();
    let Some(document) = dump(browser, &folder, &path) else {
        eprintln!("skipped: {browser} does not run here");
        return;
    };
    assert!(document.contains(r#"data-ready="true""#));
    assert!(document.contains(r#"data-errors="0""#));
    // either the replay was drawn, or the page says why not
    let says_why = document.contains("needs WebGL 2");
    assert!(document.contains("data-drawn=") || says_why);
    for heading in ["Every scenario", "Across the shore"] {
        assert!(document.contains(heading), "{heading}");
    }
    assert!(document.contains("shore: into the water"));
    assert!(document.contains("gets there") && document.contains("50.0 %"));
}

/// The document after its script has run; `None` where the browser cannot.
fn dump(browser: &str, home: &Path, path: &Path) -> Option<String> {
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-dev-shm-usage"])
        .args(["--use-gl=angle", "--use-angle=swiftshader"])
        .args(["--enable-unsafe-swiftshader", "--virtual-time-budget=2000"])
        .arg(format!("--user-data-dir={}", home.join("profile").display()))
        .arg("--dump-dom")
        .arg(format!("file://{}", path.display()))
        .stderr(Stdio::null())
        .output()
        .ok()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    (output.status.success() && text.contains("<html")).then_some(text)
}
