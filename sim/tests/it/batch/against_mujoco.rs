//! Accelerations in the air against MuJoCo on the same MJCF. Skipped with a message where no Python with
//! MuJoCo is named by `CAUDATA_MUJOCO_PYTHON`.

use std::io::Write;
use std::process::{Command, Stdio};

use caudata_random::{Key, Purpose, Stream};
use caudata_sim::batch::smooth::{Motion, accelerations};
use caudata_sim::{EngineConfig, LaneParams, Precision};

use crate::batch::{largest, random_motion};
use crate::conformance::robots;

const STATES: usize = 500;

/// Reads states as JSON, answers with qacc; free or held in the air, contacts and passive forces off.
const SCRIPT: &str = r#"
import json, sys, mujoco, numpy as np
job = json.load(sys.stdin)
spec = mujoco.MjSpec.from_file(job["xml"])
if job["held"]:
    for j in list(spec.joints):
        if j.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(j)
m = spec.compile()
m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
m.actuator_gainprm[:] = 0; m.actuator_biasprm[:] = 0
m.jnt_stiffness[:] = 0; m.dof_damping[:] = 0
d = mujoco.MjData(m)
out = []
for s in job["states"]:
    if not job["held"]:
        d.qpos[:7] = s["pose"]
        R = np.zeros(9); mujoco.mju_quat2Mat(R, np.array(s["pose"][3:])); R = R.reshape(3, 3)
        d.qvel[:3] = s["vel"]; d.qvel[3:6] = R.T @ np.array(s["ang"])
    k = 0 if job["held"] else 7
    v = 0 if job["held"] else 6
    d.qpos[k:] = s["q"]; d.qvel[v:] = s["qd"]; d.qfrc_applied[:] = 0; d.qfrc_applied[v:] = s["tau"]
    mujoco.mj_forward(m, d)
    a = d.qacc.copy()
    if not job["held"]:
        a[3:6] = R @ a[3:6]
    out.append(list(a))
print(json.dumps(out))
"#;

#[test]
fn accelerates_as_mujoco_does() {
    let Ok(python) = std::env::var("CAUDATA_MUJOCO_PYTHON") else {
        let _ = writeln!(
            std::io::stderr(),
            "skipped: CAUDATA_MUJOCO_PYTHON names no Python with MuJoCo"
        );
        return;
    };
    let model = robots::polymander();
    let mut stream = Stream::new(Key::for_run(6), Purpose::Action);
    for held in [false, true] {
        let motions: Vec<Motion> = (0..STATES)
            .map(|_| {
                let mut at = random_motion(&model, 1.0, &mut stream);
                if held {
                    // MuJoCo's held base stands where the MJCF puts it
                    at.world_from_base = caudata_model::Pose::from_pos([0.0, 0.0, 0.12]);
                }
                at
            })
            .collect();
        let wanted = ask(&python, held, &motions);
        for (precision, limit) in [(Precision::Double, 1e-6), (Precision::Single, 1e-4)] {
            let config = EngineConfig { fixed_base: held, precision, ..EngineConfig::default() };
            let mut worst = 0.0_f64;
            for (at, want) in motions.iter().zip(&wanted) {
                let got = accelerations(&model, &config, &LaneParams::nominal(&model), at).unwrap();
                let mut all = Vec::new();
                if !held {
                    all.extend(got.base_mps2);
                    all.extend(got.base_radps2);
                }
                all.extend(got.joint_radps2);
                assert_eq!(all.len(), want.len());
                let off = largest(all.iter().zip(want).map(|(g, w)| g - w));
                worst = largest([worst, off / largest(want.iter().copied())]);
            }
            println!("held {held}, {precision:?}: {worst:.1e} relative, worst of {STATES} states");
            assert!(worst < limit, "held {held}, {precision:?}: {worst}");
        }
    }
}

fn ask(python: &str, held: bool, motions: &[Motion]) -> Vec<Vec<f64>> {
    let states: Vec<serde_json::Value> = motions
        .iter()
        .map(|m| {
            let ([x, y, z], [w, i, j, k]) = (m.world_from_base.pos_m, m.world_from_base.quat_wxyz);
            serde_json::json!({
                "pose": [x, y, z, w, i, j, k], "vel": m.base_vel_mps, "ang": m.base_angvel_radps,
                "q": m.joint_pos_rad, "qd": m.joint_vel_radps, "tau": m.joint_torque_nm,
            })
        })
        .collect();
    let xml = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.xml");
    let job = serde_json::json!({ "xml": xml, "held": held, "states": states });
    let mut child = Command::new(python)
        .args(["-c", SCRIPT])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("Python starts");
    let mut input = child.stdin.take().unwrap();
    input.write_all(job.to_string().as_bytes()).unwrap();
    drop(input);
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "MuJoCo's side failed");
    serde_json::from_slice(&output.stdout).unwrap()
}
