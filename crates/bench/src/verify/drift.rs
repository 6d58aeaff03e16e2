//! Conservation: the robot let loose in weightlessness, without servos, friction or damping.

use std::sync::Arc;

use caudata_model::BaseKind;
use caudata_random::{Key, Purpose, Stream};
use caudata_sim::{InitialState, LaneParams, Momenta, TerrainConfig, build};

use super::accelerations::smooth;
use super::error::VerifyError;
use super::row::{Bench, Row, largest};

/// How long.
const FLIGHT_S: f64 = 2.0;
/// Lanes, each with its own tumble.
const LANES: usize = 16;

/// Largest relative change of momentum, angular momentum and energy over the flight, over all lanes; at 2 ms
/// and at 1 ms.
pub(crate) fn check(bench: &mut Bench<'_>) -> Result<Vec<Row>, VerifyError> {
    let model = Arc::clone(&bench.model);
    let mut rows = Vec::new();
    if model.base() == BaseKind::Fixed {
        let why = "the robot is bolted down";
        let skipped = |subject: &super::row::Subject| {
            Row::skipped("conservation", &subject.name, "drift", "", why)
        };
        return Ok(bench.settings.subjects.iter().map(skipped).collect());
    }
    for subject in bench.settings.subjects.clone() {
        for dt_s in [0.002, 0.001] {
            let config = bench.config(&subject, dt_s);
            let threads = bench.settings.threads;
            let flat = TerrainConfig::default();
            let mut engine = build(Arc::clone(&model), LANES, &config, &flat, 1, threads)?;
            let params = loose(&LaneParams::nominal(&model));
            for lane in 0..LANES {
                engine.set_params(lane, &params)?;
                engine.reset(lane, &tumble(bench, lane as u64))?;
            }
            let all = |engine: &dyn caudata_sim::Engine| -> Result<Vec<Momenta>, VerifyError> {
                (0..LANES)
                    .map(|lane| Ok(Momenta::of(&model, &params, engine.state(), lane)?))
                    .collect()
            };
            let before = all(engine.as_ref())?;
            let targets = vec![0.0; LANES * model.actuated().len()];
            for _ in 0..(FLIGHT_S / config.control_period_s()).round() as usize {
                engine.step(&targets, &[0.0; 6 * LANES])?;
            }
            let after = all(engine.as_ref())?;
            let worst = |of: &dyn Fn(&Momenta, &Momenta) -> f64| {
                let pairs = before.iter().zip(&after);
                pairs.map(|(a, b)| of(a, b)).fold(0.0, largest)
            };
            // the springs are off: all energy is kinetic
            let energy = |m: &Momenta| m.kinetic_j;
            let what = |name: &str| format!("{name} drift in {FLIGHT_S} s at {} ms", 1e3 * dt_s);
            let name = &subject.name;
            #[rustfmt::skip]
            rows.extend([
                Row::judged("conservation", name, what("momentum"), (worst(&|a, b| change(a.linear_ns, b.linear_ns)), ""), 5e-3, "relative, worst of 16 tumbles"),
                Row::judged("conservation", name, what("angular momentum"), (worst(&|a, b| change(a.angular_nms, b.angular_nms)), ""), 1e-2, ""),
                Row::judged("conservation", name, what("energy"), (worst(&|a, b| ((energy(b) - energy(a)) / energy(a)).abs()), ""), 2e-2, ""),
            ]);
        }
    }
    Ok(rows)
}

fn change(before: [f64; 3], after: [f64; 3]) -> f64 {
    use caudata_model::pose::{norm, sub};
    norm(sub(after, before)) / norm(before)
}

/// Without weight, servos, friction, damping, springs, or end stops.
fn loose(nominal: &LaneParams) -> LaneParams {
    let mut p = smooth(nominal);
    p.gravity_mps2 = [0.0; 3];
    for joint in &mut p.joints {
        joint.spring_nm_per_rad = 0.0;
        joint.low_rad = -caudata_sim::effects::ENDLESS_RAD;
        joint.high_rad = caudata_sim::effects::ENDLESS_RAD;
    }
    for hinge in &mut p.hinges {
        hinge.spring_nm_per_rad = 0.0;
        hinge.low_rad = -caudata_sim::effects::ENDLESS_RAD;
        hinge.high_rad = caudata_sim::effects::ENDLESS_RAD;
    }
    p.backlash_half_width_rad.fill(1.0);
    p
}

/// High up, turning and folding slowly.
fn tumble(bench: &Bench<'_>, lane: u64) -> InitialState {
    let key = Key { episode: lane, ..Key::for_run(bench.settings.seed) };
    let mut stream = Stream::new(key, Purpose::Reset);
    let mut draw = |half: f32| stream.uniform(-half, half);
    let mut init = InitialState::nominal(&bench.model);
    init.base_z_m = Some(100.0);
    init.base_vel_mps = std::array::from_fn(|_| draw(1.0));
    init.base_angvel_radps = std::array::from_fn(|_| draw(1.0));
    for v in &mut init.joint_vel_radps {
        *v = draw(0.5);
    }
    init
}
