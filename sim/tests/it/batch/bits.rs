//! Same inputs, same bits: threads, snapshots, places in a group, widths.

use std::io::Write as _;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_sim::{
    Engine, EngineConfig, InitialState, LaneParams, SimError, State, TerrainConfig, TerrainKind,
    build,
};

use crate::conformance::robots;

const LANES: usize = 40;

fn rough() -> TerrainConfig {
    TerrainConfig { kind: TerrainKind::Rough, size_m: 12.0, ..TerrainConfig::default() }
}

/// An engine whose lane `l` is robot `who(l)`: parameters, start and commands depend on that alone.
fn engine(
    model: &Arc<RobotModel>,
    lanes: usize,
    config: &EngineConfig,
    threads: usize,
    who: impl Fn(usize) -> usize,
) -> Box<dyn Engine> {
    let mut e = build(model.clone(), lanes, config, &rough(), 3, threads).unwrap();
    for lane in 0..lanes {
        let k = who(lane) as f32;
        let params = LaneParams {
            foot_friction: 0.4 + 0.01 * k,
            command_delay_s: 0.001 * k,
            ..LaneParams::nominal(model)
        };
        e.set_params(lane, &params).unwrap();
        let init = InitialState {
            base_xy_m: [0.05 * k - 1.0, 0.03 * k],
            base_rpy_rad: [0.0, 0.0, 0.3 * k],
            ..InitialState::nominal(model)
        };
        e.reset(lane, &init).unwrap();
    }
    e
}

fn command(
    model: &RobotModel,
    lanes: usize,
    period: usize,
    who: impl Fn(usize) -> usize,
) -> Vec<f32> {
    let mut all = Vec::new();
    for lane in 0..lanes {
        let key = Key { env: who(lane) as u64, episode: period as u64, ..Key::for_run(21) };
        let mut stream = Stream::new(key, Purpose::Action);
        let nominal = model.nominal_pos_rad().iter();
        all.extend(nominal.map(|&q| q as f32 + stream.uniform(-0.4, 0.4)));
    }
    all
}

fn bits(state: &State) -> Vec<u32> {
    let fields = state.fields();
    fields
        .iter()
        .flat_map(|f| f.iter().map(|v| v.to_bits()))
        .chain(state.diverged.iter().map(|&d| u32::from(d)))
        .collect()
}

/// 1,000 control periods (10,000 steps) with 1, 2 and 4 threads, and through a snapshot half way.
#[test]
fn ten_thousand_steps_give_the_same_bits_for_any_thread_count_and_through_a_snapshot() {
    let model = robots::polymander();
    let config = EngineConfig::default();
    let wrenches = vec![0.0; 6 * LANES];
    let mut results = Vec::new();
    for (threads, restored) in [(1, false), (2, false), (4, false), (1, true)] {
        let mut e = engine(&model, LANES, &config, threads, |l| l);
        for period in 0..1000 {
            if restored && period == 500 {
                let bytes = e.snapshot().unwrap();
                e = build(model.clone(), LANES, &config, &rough(), 3, 1).unwrap();
                e.restore(&bytes).unwrap();
            }
            e.step(&command(&model, LANES, period, |l| l), &wrenches).unwrap();
        }
        results.push(bits(e.state()));
    }
    for other in &results[1..] {
        assert_eq!(&results[0], other);
    }
}

/// Says that a width is not tested here; anything but that missing width is a failure.
fn lacks_width(error: &SimError, lane_width: u32) {
    let missing = matches!(error, SimError::Config { field: "lane_width", .. });
    assert!(missing, "{error}");
    let _ = writeln!(std::io::stderr(), "skipped: this processor has no {lane_width} lanes");
}

/// FNV-1a over the bits of everything reported; encoders that are at their joints say nothing more.
fn fingerprint(state: &State) -> u64 {
    let ahead = state.encoder_ahead_rad.iter().chain(&state.encoder_ahead_radps);
    assert!(ahead.into_iter().all(|x| x.to_bits() == 0));
    let (encoder_ahead_rad, encoder_ahead_radps) = (Vec::new(), Vec::new());
    let rest = State { encoder_ahead_rad, encoder_ahead_radps, ..state.clone() };
    bits(&rest).iter().fold(0xcbf2_9ce4_8422_2325, |hash, word| {
        (hash ^ u64::from(*word)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

/// What 10,000 steps of random targets on level ground end in, on any processor with 8 or 16 lanes. A change
/// of this number is a change of the physics (or of the report): say so in the commit that changes it.
const GOLDEN: u64 = 0x3a5c_587b_9fdb_b3b1;

#[test]
fn ten_thousand_steps_end_where_they_always_did() {
    let model = robots::polymander();
    for (lane_width, threads, restored) in
        [(8, 1, false), (8, 2, false), (8, 4, false), (8, 1, true), (16, 1, false), (16, 4, false)]
    {
        let config = EngineConfig { lane_width, ..EngineConfig::default() };
        let flat = TerrainConfig::default();
        let mut e = match build(model.clone(), LANES, &config, &flat, 3, threads) {
            Ok(engine) => engine,
            Err(error) => {
                lacks_width(&error, lane_width);
                continue;
            }
        };
        for period in 0..1000 {
            if restored && period == 500 {
                let bytes = e.snapshot().unwrap();
                e = build(model.clone(), LANES, &config, &flat, 3, threads).unwrap();
                e.restore(&bytes).unwrap();
            }
            let targets = command(&model, LANES, period, |l| l);
            e.step(&targets, &[0.0; 6 * LANES]).unwrap();
        }
        assert!(e.state().diverged.iter().all(|d| !d));
        let found = fingerprint(e.state());
        assert_eq!(found, GOLDEN, "{found:#018x}, {lane_width} lanes");
    }
}

/// A lane's result depends neither on its place in a group nor on who else is there.
#[test]
fn a_lane_does_not_know_its_place() {
    let model = robots::polymander();
    let config = EngineConfig::default();
    let run = |lanes: usize, who: &dyn Fn(usize) -> usize| {
        let mut e = engine(&model, lanes, &config, 1, who);
        let wrenches = vec![0.0; 6 * lanes];
        for period in 0..100 {
            e.step(&command(&model, lanes, period, who), &wrenches).unwrap();
        }
        e.state().clone()
    };
    let together = run(LANES, &|l| l);
    let turned = run(LANES, &|l| (l + 7) % LANES);
    let alone = run(1, &|_| 5);
    for (f, field) in together.fields().iter().enumerate() {
        let k = field.len() / LANES;
        let row = |all: &[f32], lane: usize| -> Vec<u32> {
            all[lane * k..(lane + 1) * k].iter().map(|v| v.to_bits()).collect()
        };
        for lane in 0..LANES {
            let same = row(turned.fields()[f], (lane + LANES - 7) % LANES);
            assert_eq!(row(field, lane), same, "field {f}, robot {lane}");
        }
        assert_eq!(row(field, 5), row(alone.fields()[f], 0), "field {f} alone");
    }
}

/// Three lanes of every width that this processor has, after `periods`.
fn per_width(held: bool, periods: usize) -> Vec<(u32, State)> {
    let model = robots::polymander();
    let mut results = Vec::new();
    for width in [1, 4, 8, 16] {
        let config =
            EngineConfig { lane_width: width, fixed_base: held, ..EngineConfig::default() };
        if let Err(error) = build(model.clone(), 3, &config, &rough(), 3, 1) {
            lacks_width(&error, width);
            continue;
        }
        let mut e = engine(&model, 3, &config, 1, |l| l);
        for period in 0..periods {
            e.step(&command(&model, 3, period, |l| l), &[0.0; 18]).unwrap();
        }
        results.push((width, e.state().clone()));
    }
    results
}

/// Held in the air, where nothing is chaotic, all widths agree to rounding (16 and 8 lanes fuse multiply and
/// add, 4 and 1 round twice).
#[test]
fn every_width_computes_the_same() {
    let results = per_width(true, 50);
    let (_, first) = &results[0];
    for (width, other) in &results[1..] {
        for (a, b) in first.joint_pos_rad.iter().zip(&other.joint_pos_rad) {
            assert!((a - b).abs() < 1e-3, "width {width}: {a} and {b} rad");
        }
    }
}

/// 16 and 8 lanes give the same bits, contact and all.
#[test]
fn sixteen_and_eight_lanes_give_the_same_bits() {
    let results = per_width(false, 100);
    let find = |w: u32| results.iter().find(|(width, _)| *width == w);
    if let (Some((_, a)), Some((_, b))) = (find(8), find(16)) {
        assert_eq!(bits(a), bits(b));
    } else {
        let _ = writeln!(std::io::stderr(), "skipped: this processor lacks one of them");
    }
}

/// A drive-line stage that a neighbour needs runs for the whole group: a lane that does not need it must not
/// notice, to the bit.
#[test]
fn a_neighbours_effects_are_nothing_to_a_lane() {
    let model = robots::polymander();
    let config = EngineConfig::default();
    let run = |effects: bool| {
        let mut e = engine(&model, 2, &config, 1, |l| l);
        let mut params = e.params(1).clone();
        if effects {
            for j in &mut params.joints {
                j.command_low_pass_s = 0.03;
                j.profile_speed_radps = 3.0;
                j.dead_band_rad = 0.01;
                j.dead_band_jump = 0.5;
                j.ki_nm_per_rad_s = 2.0;
                j.loop_delay_s = 0.004;
                j.damping_lag_s = 0.003;
                j.back_drive_kp_ratio = 0.7;
                j.winding_scale = 1.2;
                j.resistance_per_k = 0.004;
                j.thermal_rise_k_per_a2 = 30.0;
                j.current_limit_a = 1.0;
                j.braking_current_limit_a = 1.5;
                j.stribeck_nm = 0.02;
                j.load_friction_driving = 0.1;
                j.load_friction_driven = 0.2;
                j.friction_asymmetry_nm = 0.01;
                j.ripple_nm = 0.01;
                j.gear_half_gap_rad = 0.002;
            }
        }
        e.set_params(1, &params).unwrap();
        for period in 0..100 {
            e.step(&command(&model, 2, period, |l| l), &[0.0; 12]).unwrap();
        }
        e.state().clone()
    };
    let (plain, busy) = (run(false), run(true));
    for (a, b) in plain.fields().iter().zip(busy.fields()) {
        let k = a.len() / 2;
        let bits = |v: &[f32]| v[..k].iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(a), bits(b));
    }
    assert_ne!(plain.joint_pos_rad, busy.joint_pos_rad, "lane 1 moves otherwise");
}

/// A lane that gets a lag of its damping while it moves begins with its own speed, to the bit, whether or not a
/// neighbour had one before.
#[test]
fn a_lag_that_comes_during_life_begins_with_the_present_speed() {
    let model = robots::polymander();
    let run = |neighbour_s: f32| {
        let mut e = engine(&model, 2, &EngineConfig::default(), 1, |l| l);
        let lagging = |e: &mut dyn Engine, lane: usize, lag_s: f32| {
            let mut params = e.params(lane).clone();
            params.joints.iter_mut().for_each(|j| j.damping_lag_s = lag_s);
            e.set_params(lane, &params).unwrap();
        };
        lagging(e.as_mut(), 1, neighbour_s);
        for period in 0..30 {
            if period == 15 {
                lagging(e.as_mut(), 0, 0.01);
            }
            e.step(&command(&model, 2, period, |l| l), &[0.0; 12]).unwrap();
        }
        let q = &e.state().joint_pos_rad;
        q[..q.len() / 2].iter().map(|x| x.to_bits()).collect::<Vec<_>>()
    };
    assert_eq!(run(0.0), run(0.008));
}

/// What a lane's loops have under way is its own: delays come, grow, shrink and go, and a neighbour that
/// needs a longer memory all along (or only at first) changes nothing, to the bit.
#[test]
fn a_neighbours_longer_memory_is_nothing_to_a_lane() {
    let model = robots::polymander();
    let config = EngineConfig::default();
    let run = |neighbour_s: [f32; 2]| {
        let mut e = engine(&model, 2, &config, 1, |l| l);
        let late = |e: &mut dyn Engine, lane: usize, delay_s: f32| {
            let mut params = e.params(lane).clone();
            for (a, j) in params.joints.iter_mut().enumerate() {
                j.loop_delay_s = delay_s * (1.0 - 0.05 * a as f32);
            }
            e.set_params(lane, &params).unwrap();
        };
        let mut all = Vec::new();
        for period in 0..60 {
            match period {
                0 => late(e.as_mut(), 1, neighbour_s[0]),
                10 => late(e.as_mut(), 0, 0.0037),
                20 => late(e.as_mut(), 0, 0.011),
                25 => late(e.as_mut(), 1, neighbour_s[1]),
                30 => late(e.as_mut(), 0, 0.005),
                40 => late(e.as_mut(), 0, 0.0),
                50 => late(e.as_mut(), 0, 0.0061),
                _ => (),
            }
            e.step(&command(&model, 2, period, |l| l), &[0.0; 12]).unwrap();
            let state = e.state();
            all.push(state.joint_pos_rad[..state.joints].to_vec());
        }
        all
    };
    let alone = run([0.0, 0.0]);
    for neighbour_s in [[0.04, 0.04], [0.04, 0.0], [0.0, 0.04], [0.002, 0.002]] {
        assert_eq!(alone, run(neighbour_s), "neighbour {neighbour_s:?}");
    }
}
