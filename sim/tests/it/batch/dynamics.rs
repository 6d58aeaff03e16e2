//! Accelerations in the air against the plain formulation, on random trees and on the Polymander.

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_sim::batch::smooth::{Accelerations, Motion, accelerations};
use caudata_sim::{EngineConfig, LaneParams, Precision};
use proptest::prelude::*;

use crate::batch::{largest, plain, random_motion, trees};
use crate::conformance::robots;

/// Largest difference over the largest acceleration.
fn apart(got: &Accelerations, want: &Accelerations) -> f64 {
    let flat = |a: &Accelerations| -> Vec<f64> {
        (a.base_mps2.iter().chain(&a.base_radps2)).chain(&a.joint_radps2).copied().collect()
    };
    let (got, want) = (flat(got), flat(want));
    assert_eq!(got.len(), want.len());
    let off = largest(got.iter().zip(&want).map(|(g, w)| g - w));
    off / largest(want)
}

fn check(model: &RobotModel, held: bool, at: &Motion, precision: Precision) -> f64 {
    let config = EngineConfig { fixed_base: held, precision, ..EngineConfig::default() };
    let got = accelerations(model, &config, &LaneParams::nominal(model), at).unwrap();
    apart(&got, &plain::accelerations(model, held, at))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    #[test]
    fn random_trees_move_as_the_plain_formulation_says(seed: u64, bodies in 2_usize..9, free: bool) {
        let mut stream = Stream::new(Key::for_run(seed), Purpose::Action);
        let model = trees::random(bodies, free, &mut stream);
        let at = random_motion(&model, 2.0, &mut stream);
        let off = check(&model, false, &at, Precision::Double);
        prop_assert!(off < 1e-9, "f64 is {off} off");
        let off = check(&model, false, &at, Precision::Single);
        prop_assert!(off < 2e-3, "f32 is {off} off");
    }
}

/// 500 random states of the Polymander, free and held. (The plain formulation has no locked joints and takes
/// the MJCF's armature, which are the nominal ones.)
#[test]
fn the_polymander_moves_as_the_plain_formulation_says() {
    let model = robots::polymander();
    let mut stream = Stream::new(Key::for_run(5), Purpose::Action);
    for held in [false, true] {
        let (mut double, mut single) = (0.0_f64, 0.0_f64);
        for _ in 0..500 {
            let at = random_motion(&model, 1.0, &mut stream);
            double = largest([double, check(&model, held, &at, Precision::Double)]);
            single = largest([single, check(&model, held, &at, Precision::Single)]);
        }
        println!("held {held}: f64 {double:.1e}, f32 {single:.1e} relative");
        assert!(double < 1e-10, "f64 is {double} off");
        assert!(single < 2e-4, "f32 is {single} off");
    }
}
