//! What passive robots gain and lose that they should not.

use caudata_sim::{EngineConfig, InitialState, LaneParams, Precision, TerrainConfig, build};

use crate::conformance::robots;

/// Weightless tumbling chains for 20 s: the velocity of the centre of mass stays, to the integrator's order
/// of dt (single and double precision drift alike; half the step halves it).
/// `caudata sim verify --only conservation` has angular momentum and energy as well.
#[test]
fn tumbling_keeps_its_momentum() {
    let model = robots::tumbler();
    for (precision, slack) in [(Precision::Double, 4e-3), (Precision::Single, 4e-3)] {
        let config = EngineConfig { precision, ..EngineConfig::default() };
        let mut e = build(model.clone(), 1, &config, &TerrainConfig::default(), 1, 1).unwrap();
        let weightless = LaneParams { gravity_mps2: [0.0; 3], ..LaneParams::nominal(&model) };
        e.set_params(0, &weightless).unwrap();
        let init = InitialState {
            base_z_m: Some(1.0),
            base_vel_mps: [0.3, -0.2, 0.1],
            base_angvel_radps: [1.0, 2.0, -1.5],
            joint_vel_radps: vec![2.0],
            ..InitialState::nominal(&model)
        };
        e.reset(0, &init).unwrap();
        let start = e.state().com_vel_mps.clone();
        for _ in 0..1000 {
            e.step(&[0.0], &[0.0; 6]).unwrap();
        }
        for (now, then) in e.state().com_vel_mps.iter().zip(&start) {
            let off = f64::from((now - then).abs());
            println!("{precision:?}: {off:.1e} m/s of drift in 20 s");
            assert!(off < slack, "{precision:?}: drifted by {off} m/s");
        }
    }
}
