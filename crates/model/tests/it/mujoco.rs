//! The unchanged MJCF in MuJoCo: same masses, frames, joint axes and mass matrix as here, and the robot
//! stands there.
//!
//! Needs a Python with the `mujoco` package, named by `CAUDATA_MUJOCO_PYTHON`; skipped with a message
//! otherwise.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::common::{near, polymander, robots};
use caudata_model::{JointMotion, Kinematics, Pose, RobotModel, pose};

/// Runs MuJoCo on the shipped MJCF; one answer (its lines) per configuration line. `None`: no MuJoCo to
/// compare with.
fn mujoco(configurations: &[String]) -> Option<Vec<Vec<String>>> {
    let Some(python) = std::env::var_os("CAUDATA_MUJOCO_PYTHON") else {
        // Past what the test harness captures, so that it is seen.
        let why = "set CAUDATA_MUJOCO_PYTHON to a Python that has the mujoco package";
        let _ = writeln!(std::io::stderr(), "skipped: comparison with MuJoCo: {why}");
        return None;
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/mujoco_dump.py");
    let mut child = Command::new(python)
        .arg(script)
        .arg(robots().join("polymander.xml"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("CAUDATA_MUJOCO_PYTHON starts");
    child.stdin.take().unwrap().write_all(configurations.join("\n").as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "the MuJoCo script failed");
    let text = String::from_utf8(output.stdout).unwrap();
    let answers: Vec<Vec<String>> = text
        .split("configuration\n")
        .skip(1)
        .map(|a| a.lines().map(str::to_owned).collect())
        .collect();
    assert!(text.contains("\nnv 28\n"), "MuJoCo sees another number of degrees of freedom");
    assert_eq!(answers.len(), configurations.len());
    Some(answers)
}

fn configuration(m: &RobotModel, base: &Pose, joint_pos_rad: &[f64]) -> String {
    let mut words: Vec<String> =
        base.pos_m.iter().chain(&base.quat_wxyz).map(|x| format!("{x:?}")).collect();
    words.extend(m.joints().iter().zip(joint_pos_rad).map(|(j, q)| format!("{}={q:?}", j.name)));
    words.join(" ")
}

/// Records `kind name numbers…` of an answer by name, in order of appearance beside.
fn records(answer: &[String], kind: &str) -> BTreeMap<String, Vec<f64>> {
    answer
        .iter()
        .filter_map(|line| {
            let mut words = line.split_whitespace();
            (words.next() == Some(kind)).then(|| {
                (words.next().unwrap().to_owned(), words.map(|w| w.parse().unwrap()).collect())
            })
        })
        .collect()
}

fn compare(what: &str, ours: impl IntoIterator<Item = f64>, theirs: &[f64], tolerance: f64) {
    let ours: Vec<f64> = ours.into_iter().collect();
    assert_eq!(ours.len(), theirs.len(), "{what}");
    for (i, (a, b)) in ours.iter().zip(theirs).enumerate() {
        near(&format!("{what}[{i}]"), *a, *b, tolerance);
    }
}

/// Velocity of a link's centre of mass and of its rotation for a unit speed of each degree of freedom (world
/// frame). MuJoCo's free joint: three world velocities of the base, then three rates about the base's own
/// axes.
fn jacobian(m: &RobotModel, k: &Kinematics, link: usize) -> Vec<([f64; 3], [f64; 3])> {
    let com = k.links[link].point(m.links()[link].com_m);
    let mut columns = vec![([0.0; 3], [0.0; 3]); 6 + m.joints().len()];
    for i in 0..3 {
        let mut unit = [0.0; 3];
        unit[i] = 1.0;
        columns[i].0 = unit;
        let axis = k.links[0].rotate(unit);
        columns[3 + i] = (pose::cross(axis, pose::sub(com, k.links[0].pos_m)), axis);
    }
    let mut at = Some(link);
    while let Some(l) = at {
        for &j in &m.links()[l].joints {
            assert_eq!(m.joints()[j].motion, JointMotion::Hinge);
            let f = &k.joints[j];
            columns[6 + j] = (pose::cross(f.axis, pose::sub(com, f.anchor_m)), f.axis);
        }
        at = m.links()[l].parent;
    }
    columns
}

/// Joint-space inertia matrix, kg·m² (kg for the base's translations).
fn mass_matrix(m: &RobotModel, k: &Kinematics) -> Vec<Vec<f64>> {
    let n = 6 + m.joints().len();
    let mut out = vec![vec![0.0; n]; n];
    for (l, link) in m.links().iter().enumerate() {
        let columns = jacobian(m, k, l);
        let inertia = pose::rotate_tensor(k.links[l].quat_wxyz, link.inertia_kgm2);
        for a in 0..n {
            let (v, w) = columns[a];
            let iw = inertia.map(|row| pose::dot(row, w));
            for b in 0..n {
                out[a][b] +=
                    link.mass_kg * pose::dot(v, columns[b].0) + pose::dot(iw, columns[b].1);
            }
        }
    }
    for (j, joint) in m.joints().iter().enumerate() {
        out[6 + j][6 + j] += joint.armature_kgm2;
    }
    out
}

#[test]
fn frames_axes_and_mass_matrix_agree() {
    let m = polymander();
    let level = Pose::from_pos([0.0, 0.0, 0.12]);
    let tilted = Pose {
        pos_m: [0.3, -0.2, 0.4],
        quat_wxyz: pose::quat_normalised([0.9, 0.1, -0.3, 0.2]).unwrap(),
    };
    // a bent configuration: every joint somewhere else within its range
    let bent: Vec<f64> = (0..m.joints().len())
        .map(|j| {
            let (lo, hi) = m.joints()[j].range_rad.unwrap();
            lo + (hi - lo) * (0.15 + 0.7 * (j as f64 * 0.37).fract())
        })
        .collect();
    let zero = vec![0.0; m.joints().len()];
    let cases = [(level, zero), (tilted, bent)];
    let lines: Vec<String> = cases.iter().map(|(b, q)| configuration(&m, b, q)).collect();
    let Some(answers) = mujoco(&lines) else {
        return;
    };
    for ((base, q), answer) in cases.iter().zip(&answers) {
        let k = m.kinematics(base, q).unwrap();
        let mass: f64 =
            answer.iter().find_map(|l| l.strip_prefix("mass ")).unwrap().parse().unwrap();
        near("total mass", m.total_mass_kg(), mass, 1e-12);
        let bodies = records(answer, "body");
        assert_eq!(bodies.len(), m.links().len());
        for (link, pose) in m.links().iter().zip(&k.links) {
            let ours = pose.pos_m.into_iter().chain(pose.rotation().into_iter().flatten());
            compare(&link.name, ours, &bodies[&link.name], 1e-10);
        }
        let joints = records(answer, "joint");
        for (joint, frame) in m.joints().iter().zip(&k.joints) {
            let ours = frame.anchor_m.into_iter().chain(frame.axis);
            compare(&joint.name, ours, &joints[&joint.name], 1e-10);
        }
        let sites = records(answer, "site");
        for site in m.sites() {
            let pose = k.links[site.link].compose(&site.link_from_site);
            let ours = pose.pos_m.into_iter().chain(pose.rotation().into_iter().flatten());
            compare(&site.name, ours, &sites[&site.name], 1e-10);
        }
        // MuJoCo lists degrees of freedom in the same order: base, then joints depth first
        let inertia = records(answer, "inertia");
        for (i, row) in mass_matrix(&m, &k).into_iter().enumerate() {
            compare(&format!("mass matrix row {i}"), row, &inertia[&i.to_string()], 1e-12);
        }
    }
}

#[test]
fn it_stands_in_mujoco_too() {
    let m = polymander();
    let q = m.full_pos_rad(m.nominal_pos_rad()).unwrap();
    let line = configuration(&m, &Pose::from_pos([0.0, 0.0, 0.13]), &q) + " drop 3";
    let Some(answers) = mujoco(&[line]) else {
        return;
    };
    let value = |key: &str| -> Vec<f64> {
        let line = answers[0].iter().find_map(|l| l.strip_prefix(key)).unwrap();
        line.split_whitespace().map(|w| w.parse().unwrap()).collect()
    };
    assert_eq!(value("feet_in_contact "), [4.0]);
    let base = value("base ");
    assert!(base[2] > 0.045, "head frame is {} m high", base[2]);
    // cos of the tilt: 1 − 2(x² + y²)
    let upright = 1.0 - 2.0 * (base[4] * base[4] + base[5] * base[5]);
    assert!(upright > 10f64.to_radians().cos(), "tilt {}°", upright.acos().to_degrees());
    assert!(value("speed ")[0] < 0.05, "still moving at {} rad/s or m/s", value("speed ")[0]);
    let touching = answers[0].iter().find_map(|l| l.strip_prefix("touching ")).unwrap();
    for part in touching.split_whitespace() {
        let allowed = part == "floor" || part.ends_with("_foot") || part.starts_with("fin");
        assert!(allowed, "{part} touches the floor");
    }
}
