//! Random trees of bodies on hinges and slides.

use std::fmt::Write;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::Stream;

use crate::conformance::robots;

/// `bodies` bodies, each hanging somewhere on an earlier one by one or two joints with random axes, on a free
/// or a fixed base.
pub fn random(bodies: usize, free: bool, stream: &mut Stream) -> Arc<RobotModel> {
    let mut children: Vec<Vec<usize>> = vec![Vec::new(); bodies];
    for b in 1..bodies {
        let parent = stream.uniform_f64(0.0, b as f64) as usize;
        children[parent.min(b - 1)].push(b);
    }
    let mut names = Vec::new();
    let mut text = String::new();
    body(0, &children, free, stream, &mut names, &mut text);
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let base = if free { "free" } else { "fixed" };
    let toml = robots::robot_toml(base, &names, "[frames]\ntorso = \"b0\"\n");
    robots::load(&toml, &text, &names)
}

fn body(
    b: usize,
    children: &[Vec<usize>],
    free: bool,
    stream: &mut Stream,
    names: &mut Vec<String>,
    text: &mut String,
) {
    let three = |most: f64, stream: &mut Stream| -> String {
        (0..3).map(|_| stream.uniform_f64(-most, most).to_string()).collect::<Vec<_>>().join(" ")
    };
    let pos = three(0.3, stream);
    let quat = format!("{} {}", stream.uniform_f64(0.3, 1.0), three(1.0, stream));
    write!(text, r#"<body name="b{b}" pos="{pos}" quat="{quat}">"#).unwrap();
    let mass = stream.uniform_f64(0.1, 1.0);
    let com = three(0.1, stream);
    // any three numbers in 1..1.9 fulfil the triangle inequality
    let [x, y, z] = [(); 3].map(|()| 0.002 * stream.uniform_f64(1.0, 1.9));
    write!(text, r#"<inertial pos="{com}" mass="{mass}" diaginertia="{x} {y} {z}"/>"#).unwrap();
    if b == 0 && free {
        text.push_str("<freejoint/>");
    } else {
        let joints = 1 + (stream.uniform_f64(0.0, 1.0) > 0.7) as usize;
        for k in 0..joints {
            let name = format!("j{b}_{k}");
            let kind = if stream.uniform_f64(0.0, 1.0) > 0.75 { "slide" } else { "hinge" };
            // some along a frame axis, either way round, most not
            // (a second slide along the same axis would have no inertia of its own)
            let pick = if k == 0 { 10.0 } else { 0.0 };
            let axis = match 3 - (stream.uniform_f64(0.0, pick) as u32).min(3) {
                0 => "1 0 0".to_owned(),
                1 => "0 -1 0".to_owned(),
                2 => "0 0 -1".to_owned(),
                _ => format!("{} {}", three(1.0, stream).rsplit_once(' ').unwrap().0, 0.7),
            };
            let anchor = if kind == "hinge" { three(0.05, stream) } else { "0 0 0".to_owned() };
            write!(
                text,
                r#"<joint name="{name}" type="{kind}" axis="{axis}" pos="{anchor}" range="-1000 1000"/>"#
            )
            .unwrap();
            names.push(name);
        }
    }
    for &c in &children[b] {
        body(c, children, free, stream, names, text);
    }
    text.push_str("</body>");
}
