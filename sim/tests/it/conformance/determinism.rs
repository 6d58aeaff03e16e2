//! Same inputs, same bits: threads, neighbours, history. And what bad inputs do.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_sim::{
    Engine, EngineConfig, InitialState, LaneParams, SimError, State, TerrainConfig, TerrainKind,
    build,
};

use crate::conformance::{engine, nominal_targets, robots};

fn rugged() -> TerrainConfig {
    TerrainConfig { size_m: 8.0, height_m: 0.03, ..TerrainConfig::of(TerrainKind::Rugged) }
}

/// Lanes at different places, with different friction, thrashing at random.
pub fn prepare(e: &mut dyn Engine, model: &RobotModel) {
    for lane in 0..e.lanes() {
        let params =
            LaneParams { foot_friction: 0.5 + 0.05 * lane as f32, ..LaneParams::nominal(model) };
        e.set_params(lane, &params).unwrap();
        e.reset(
            lane,
            &InitialState { base_xy_m: [0.3 * lane as f32, 0.0], ..InitialState::nominal(model) },
        )
        .unwrap();
    }
}

/// `periods` steps of random targets and pushes; the same for the same `seed` and lane.
pub fn thrash(e: &mut dyn Engine, model: &RobotModel, streams: &mut [Stream], periods: usize) {
    let nominal = nominal_targets(model, 1);
    for _ in 0..periods {
        let mut targets = Vec::new();
        let mut wrenches = Vec::new();
        for stream in streams.iter_mut() {
            targets.extend(nominal.iter().map(|q| q + stream.uniform(-0.5, 0.5)));
            wrenches.extend((0..6).map(|i| if i < 3 { stream.uniform(-3.0, 3.0) } else { 0.0 }));
        }
        e.step(&targets, &wrenches).unwrap();
    }
}

pub fn streams(lanes: usize) -> Vec<Stream> {
    (0..lanes)
        .map(|env| Stream::new(Key { env: env as u64, ..Key::for_run(11) }, Purpose::Action))
        .collect()
}

fn thrashed(config: &EngineConfig, model: &Arc<RobotModel>, threads: usize) -> State {
    let mut e = build(model.clone(), 5, config, &rugged(), 4, threads).unwrap();
    prepare(e.as_mut(), model);
    thrash(e.as_mut(), model, &mut streams(5), 60);
    e.state().clone()
}

/// Bits, not values: −0 and +0 differ.
pub fn bits(s: &State) -> Vec<u32> {
    s.fields().iter().flat_map(|f| f.iter().map(|v| v.to_bits())).collect()
}

pub fn same_bits_for_any_thread_count(config: &EngineConfig) {
    let model = robots::polymander();
    let one = thrashed(config, &model, 1);
    assert!(one.diverged.iter().all(|d| !d));
    for threads in [2, 3, 64] {
        assert_eq!(bits(&one), bits(&thrashed(config, &model, threads)), "{threads} threads");
    }
}

/// Lane 1 is told nonsense until it breaks down; lanes 0 and 2 have the same bits as without it.
pub fn lanes_do_not_touch_each_other(config: &EngineConfig) {
    let model = robots::polymander();
    let mut results = Vec::new();
    for wild in [false, true] {
        let mut e = build(model.clone(), 3, config, &rugged(), 4, 2).unwrap();
        prepare(e.as_mut(), &model);
        if wild {
            // a push of a thousand newtons on 2.6 kg passes 50 m/s within a few periods
            let mut wrenches = [0.0; 18];
            wrenches[6] = 1000.0;
            for _ in 0..30 {
                e.step(&nominal_targets(&model, 3), &wrenches).unwrap();
            }
            assert_eq!(e.state().diverged, [false, true, false]);
            assert!(e.state().fields().iter().all(|f| f.iter().all(|v| v.is_finite())));
        } else {
            for _ in 0..30 {
                e.step(&nominal_targets(&model, 3), &[0.0; 18]).unwrap();
            }
        }
        results.push(e.state().clone());
    }
    for (calm, wild) in results[0].fields().iter().zip(results[1].fields()) {
        let k = calm.len() / 3;
        assert_eq!(calm[..k], wild[..k]);
        assert_eq!(calm[2 * k..], wild[2 * k..]);
    }
}

/// A lane that was thrashed, broken and reset runs like a fresh one.
pub fn reset_forgets_the_past(config: &EngineConfig) {
    let model = robots::polymander();
    let mut fresh = engine(config, &model, 1);
    let mut used = engine(config, &model, 1);
    thrash(used.as_mut(), &model, &mut streams(1), 20);
    used.step(&[f32::NAN; 16], &[0.0; 6]).unwrap();
    assert_eq!(used.state().diverged, [true]);
    for e in [&mut fresh, &mut used] {
        prepare(e.as_mut(), &model);
        thrash(e.as_mut(), &model, &mut streams(1), 40);
    }
    assert_eq!(used.state().diverged, [false]);
    assert_eq!(bits(fresh.state()), bits(used.state()));
}

/// Not-a-number in one lane's targets or push marks that lane, keeps its last state, and lets the others go
/// on.
pub fn bad_targets_stop_their_lane_only(config: &EngineConfig) {
    let model = robots::table();
    let mut e = engine(config, &model, 3);
    let before = e.state().clone();
    let mut wrenches = [0.0; 18];
    wrenches[12] = f32::INFINITY;
    e.step(&[f32::NAN, 0.5, 0.0], &wrenches).unwrap();
    assert_eq!(e.state().diverged, [true, false, true]);
    assert_eq!(e.state().base_pos_m[..3], before.base_pos_m[..3]);
    e.step(&[0.0; 3], &[0.0; 18]).unwrap();
    assert_eq!(e.state().diverged, [true, false, true], "until its reset");
    e.reset(0, &InitialState::nominal(&model)).unwrap();
    e.step(&[0.0; 3], &[0.0; 18]).unwrap();
    assert_eq!(e.state().diverged, [false, false, true]);
}

pub fn arrays_of_wrong_length_are_refused(config: &EngineConfig) {
    let model = robots::table();
    let mut e = engine(config, &model, 2);
    let error = e.step(&[0.0; 3], &[0.0; 12]).unwrap_err();
    assert_eq!(error.to_string(), "targets_rad has 3 values, expected 2");
    assert!(matches!(
        e.step(&[0.0; 2], &[0.0; 6]),
        Err(SimError::Shape { what: "wrenches", got: 6, expected: 12 })
    ));
    assert!(matches!(e.reset(2, &InitialState::nominal(&model)), Err(SimError::Lane { .. })));
    assert!(build(model, 0, config, &TerrainConfig::default(), 0, 1).is_err(), "no lanes");
}
