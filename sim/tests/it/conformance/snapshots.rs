//! Snapshot and restore.

use caudata_model::RobotModel;
use caudata_sim::{
    CommandLoss, EngineConfig, InitialState, LaneParams, TerrainConfig, TerrainKind, build,
};

use crate::conformance::determinism::{bits, prepare, streams, thrash};
use crate::conformance::{engine, robots};

pub fn continues_bit_exactly(config: &EngineConfig) {
    check(config, &TerrainConfig::default());
}

pub fn continues_bit_exactly_on_a_height_field(config: &EngineConfig) {
    let rough = TerrainConfig { kind: TerrainKind::Rough, size_m: 8.0, ..TerrainConfig::default() };
    check(config, &rough);
}

/// Everything that remembers is on: gears, filters, profile, windings, supply, lost frames, carried water.
pub fn continues_bit_exactly_with_every_effect(config: &EngineConfig) {
    let wet = TerrainConfig { kind: TerrainKind::DeepWater, ..TerrainConfig::default() };
    check(config, &wet);
}

/// A robot with every effect that has a memory.
fn everything(model: &RobotModel) -> LaneParams {
    let mut p = LaneParams {
        command_delay_s: 0.033,
        supply_resistance_ohm: 0.2,
        command_loss: CommandLoss { share: 0.2, burst: 2.0, seed: 4 },
        ..LaneParams::nominal(model)
    };
    for joint in &mut p.joints {
        joint.command_low_pass_s = 0.02;
        joint.profile_speed_radps = 4.0;
        joint.ki_nm_per_rad_s = 5.0;
        joint.loop_delay_s = 0.007;
        joint.damping_lag_s = 0.005;
        joint.load_friction_driving = 0.1;
        joint.load_friction_driven = 0.1;
        joint.gear_half_gap_rad = 0.002;
        joint.thermal_rise_k_per_a2 = 20.0;
    }
    for link in &mut p.water {
        link.added_mass_x = 0.1;
        link.added_mass_y = 0.8;
        link.added_inertia_z = 0.5;
    }
    p
}

/// 200 periods straight through, against 100, snapshot, restore in a fresh engine, 100 more: all bits equal
/// after every period.
fn check(config: &EngineConfig, terrain: &TerrainConfig) {
    let model = robots::polymander();
    let fresh = || build(model.clone(), 2, config, terrain, 9, 1).unwrap();
    let mut through = fresh();
    let mut inputs = streams(2);
    prepare(through.as_mut(), &model);
    // commands under way and a changed parameter must survive as well
    let late = if terrain.kind == TerrainKind::DeepWater {
        everything(&model)
    } else {
        LaneParams { command_delay_s: 0.033, ..LaneParams::nominal(&model) }
    };
    through.set_params(1, &late).unwrap();
    thrash(through.as_mut(), &model, &mut inputs, 100);
    through.set_params(0, &late).unwrap();
    let bytes = through.snapshot().unwrap();
    let mut restored = fresh();
    restored.restore(&bytes).unwrap();
    assert_eq!(bits(restored.state()), bits(through.state()));
    assert_eq!(restored.params(1), &late);
    assert_eq!(restored.params(0), &late);
    let mut same_inputs = inputs.clone();
    for period in 0..100 {
        thrash(through.as_mut(), &model, &mut inputs, 1);
        thrash(restored.as_mut(), &model, &mut same_inputs, 1);
        assert_eq!(
            bits(through.state()),
            bits(restored.state()),
            "period {period} after the snapshot"
        );
    }
    assert!(through.state().diverged.iter().all(|d| !d));
}

/// Damage, other lane counts, other configurations, other terrains, other robots: refused, and nothing
/// changes.
pub fn refuses_what_is_not_its_own(config: &EngineConfig) {
    let model = robots::polymander();
    let mut e = engine(config, &model, 2);
    let bytes = e.snapshot().unwrap();
    e.reset(0, &InitialState { base_xy_m: [1.0, 2.0], ..InitialState::nominal(&model) }).unwrap();
    let before = bits(e.state());
    let mut damaged = bytes.clone();
    damaged[bytes.len() / 2] ^= 4;
    for wrong in [&damaged[..], &bytes[..bytes.len() - 3], &[], b"not a snapshot"] {
        let message = e.restore(wrong).unwrap_err().to_string();
        assert!(message.starts_with("snapshot cannot be restored"), "{message}");
    }
    let other_config = EngineConfig { substeps: config.substeps + 1, ..config.clone() };
    let valley =
        TerrainConfig { kind: TerrainKind::Valley, size_m: 4.0, ..TerrainConfig::default() };
    let others = [
        engine(config, &model, 3),
        engine(&other_config, &model, 2),
        build(model.clone(), 2, config, &valley, 0, 1).unwrap(),
        engine(config, &robots::table(), 2),
    ];
    for mut other in others {
        assert!(other.restore(&bytes).is_err());
    }
    assert_eq!(bits(e.state()), before);
    e.restore(&bytes).unwrap();
}
