//! The nominal robot in the diagnosing engine: what it predicts for a run. Measures the null discrepancy.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::{EngineConfig, InitialState, LaneParams, SimError, TerrainConfig};

use crate::truth::sim::Commands;

/// Step of the engine, s: that of the diagnosis.
const DT_S: f64 = 0.002;

/// What an engine run predicts, `[A][rows]`, at the rows' instants.
#[derive(Clone, Debug, Default)]
pub struct Prediction {
    /// rad.
    pub pos_rad: Vec<Vec<f64>>,
    /// rad/s.
    pub vel_radps: Vec<Vec<f64>>,
    /// Motor torque over the torque constant, A.
    pub current_a: Vec<Vec<f64>>,
}

impl Prediction {
    fn of(servos: usize) -> Self {
        Self {
            pos_rad: vec![Vec::new(); servos],
            vel_radps: vec![Vec::new(); servos],
            current_a: vec![Vec::new(); servos],
        }
    }
}

/// Position, speed and current of servo `a`.
fn reading(
    engine: &dyn caudata_sim::Engine,
    model: &RobotModel,
    lane: usize,
    a: usize,
) -> [f64; 3] {
    let state = engine.state();
    let joint = model.actuated()[a];
    let torque_nm = state.motor_torque_nm[lane * model.actuated().len() + a];
    let constant = engine.params(lane).joints[a].torque_constant_nm_per_a;
    [
        f64::from(state.encoder_pos_rad(lane, joint, a)),
        f64::from(state.encoder_vel_radps(lane, joint, a)),
        f64::from(torque_nm) / f64::from(constant),
    ]
}

/// Runs every set of parameters on the same commands; the robot stands at the first row for a second before.
///
/// # Errors
/// [`SimError`] where parameters are not physical.
pub fn predict(
    model: &Arc<RobotModel>,
    variants: &[LaneParams],
    commands: &Commands,
    times_s: &[f64],
) -> Result<Vec<Prediction>, SimError> {
    let config =
        EngineConfig { dt_s: DT_S, substeps: 1, fixed_base: true, ..EngineConfig::default() };
    let lanes = variants.len();
    let servos = model.actuated().len();
    let ground = TerrainConfig::default();
    let mut engine = caudata_sim::build(Arc::clone(model), lanes, &config, &ground, 1, 1)?;
    let in_lanes = |row: &[f64]| -> Vec<f32> {
        (0..lanes).flat_map(|_| row.iter().map(|&x| x as f32)).collect()
    };
    let mut targets = in_lanes(&commands.rows_rad[0]);
    for (lane, params) in variants.iter().enumerate() {
        let start = InitialState {
            joint_pos_rad: targets[lane * servos..(lane + 1) * servos].to_vec(),
            ..InitialState::nominal(model)
        };
        engine.set_params(lane, params)?;
        engine.reset(lane, &start)?;
    }
    let wrenches = vec![0.0; 6 * lanes];
    for _ in 0..(1.0 / DT_S) as usize {
        engine.step(&targets, &wrenches)?;
    }
    let mut out = vec![Prediction::of(servos); lanes];
    let read = |engine: &dyn caudata_sim::Engine| -> Vec<[f64; 3]> {
        let each = (0..lanes).flat_map(|lane| (0..servos).map(move |a| (lane, a)));
        each.map(|(lane, a)| reading(engine, model, lane, a)).collect()
    };
    let mut now = read(engine.as_ref());
    let mut before: Vec<[f64; 3]> = Vec::new();
    let (mut step, mut row) = (0u64, 0usize);
    for &t in times_s {
        while (step as f64) * DT_S < t {
            let middle = (step as f64 + 0.5) * DT_S;
            let mut moved = false;
            while row + 1 < commands.sent_s.len() && commands.sent_s[row + 1] <= middle {
                row += 1;
                moved = true;
            }
            if moved {
                targets = in_lanes(&commands.rows_rad[row]);
            }
            engine.step(&targets, &wrenches)?;
            step += 1;
            before = std::mem::replace(&mut now, read(engine.as_ref()));
        }
        let back = (step as f64 * DT_S - t) / DT_S;
        for lane in 0..lanes {
            for a in 0..servos {
                let i = lane * servos + a;
                let mix = |c: usize| {
                    let old = before.get(i).map_or(now[i][c], |b| b[c]);
                    now[i][c] + (old - now[i][c]) * back
                };
                out[lane].pos_rad[a].push(mix(0));
                out[lane].vel_radps[a].push(mix(1));
                out[lane].current_a[a].push(mix(2));
            }
        }
    }
    Ok(out)
}
