//! What the salamander is asked to do: walks and swims.

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;

use crate::battery::RATE_HZ;
use crate::truth::free::Beginning;

/// A run: its name, its commands, and how it begins.
pub(crate) struct Script {
    pub name: &'static str,
    pub rows_rad: Vec<Vec<f64>>,
    pub begins: Beginning,
}

/// How long a run is, s.
const RUN_S: f64 = 6.0;
const TURN: f64 = std::f64::consts::TAU;

/// Full after a second.
fn soft(t: f64) -> f64 {
    t.clamp(0.0, 1.0)
}

/// Adds an angle (rad) to the command of a joint.
type Add<'a> = dyn FnMut(&str, f64) + 'a;

/// One row per period, each the nominal pose to which `at` adds what moves at a time (s).
fn rows(model: &RobotModel, at: &dyn Fn(f64, &mut Add<'_>)) -> Vec<Vec<f64>> {
    let names = model.actuated_names();
    let nominal = model.nominal_pos_rad().to_vec();
    (0..=(RUN_S * RATE_HZ) as usize)
        .map(|k| {
            let mut row = nominal.clone();
            at(k as f64 / RATE_HZ, &mut |name, x| {
                if let Some(i) = names.iter().position(|n| *n == name) {
                    row[i] += x;
                }
            });
            row
        })
        .collect()
}

/// Walking, rocking on four feet, lifting one foot after the other.
pub(crate) fn walks(model: &RobotModel, tempo: f64) -> Vec<Script> {
    let walk = rows(model, &|t, add| {
        let phase = TURN * tempo * t;
        for (leg, shift) in [("FL", 0.0), ("HR", 0.0), ("FR", 0.5), ("HL", 0.5)] {
            let p = phase + TURN * shift;
            add(&format!("{leg}_hip"), 0.35 * soft(t) * p.sin());
            add(&format!("{leg}_knee"), -0.45 * soft(t) * p.cos().max(0.0));
        }
        for i in 1..=4 {
            let bend = 0.12 * soft(t) * (phase + 0.6 * f64::from(i)).sin();
            add(&format!("spine_{i}"), bend);
        }
    });
    let rock = rows(model, &|t, add| {
        let (roll, pitch) = (
            0.22 * soft(t) * (TURN * 0.5 * tempo * t).sin(),
            0.18 * soft(t) * (TURN * 0.31 * tempo * t).sin(),
        );
        for leg in ["FL", "FR", "HL", "HR"] {
            let side = if leg.ends_with('L') { 1.0 } else { -1.0 };
            let end = if leg.starts_with('F') { 1.0 } else { -1.0 };
            add(&format!("{leg}_knee"), side * roll + end * pitch);
        }
    });
    let lift = rows(model, &|t, add| {
        let leg = ["FL", "HR", "FR", "HL"][(t / (1.5 / tempo)) as usize % 4];
        let x = (t / (1.5 / tempo)).fract();
        let up = -0.7 * (std::f64::consts::PI * x).sin().powi(2);
        add(&format!("{leg}_knee"), up);
    });
    let from_rest = |(name, rows_rad)| Script { name, rows_rad, begins: BaseHold::Free.into() };
    [("walk", walk), ("rock", rock), ("lift", lift)].map(from_rest).into()
}

/// A hand that presses the trunk under water and rolls it: N, N·m.
const PRESS_N: f32 = 6.0;
const ROLL_NM: f32 = 0.03;

/// Swimming waves of three sizes at three tempos, a turn, swimming and coasting, and bobbing after a hand
/// lets go.
pub(crate) fn swims(model: &RobotModel, tempo: f64) -> Vec<Script> {
    let names = model.actuated_names();
    let spine: Vec<&str> = (names.iter().copied())
        .filter(|n| n.starts_with("spine") || n.starts_with("tail"))
        .collect();
    // one wave on the body, larger towards the tail, on top of a bend; legs folded back
    let wave = |add: &mut Add<'_>, phase: f64, size: f64, bend: f64, legs: f64| {
        for (i, name) in spine.iter().enumerate() {
            let x = i as f64 / spine.len() as f64;
            let along = (phase - TURN * x).sin();
            add(name, size * (0.4 + 0.6 * x) * along + bend);
        }
        for leg in ["FL", "FR", "HL", "HR"] {
            add(&format!("{leg}_hip"), -0.6 * legs);
        }
    };
    let sizes = rows(model, &|t, add| {
        let part = ((t / 2.0) as usize).min(2);
        let within = t - 2.0 * part as f64;
        let (hz, size) = [(0.5, 0.4), (0.9, 0.28), (1.4, 0.15)][part];
        let fade = soft(2.0 * within) * soft(2.0 * (2.0 - within));
        wave(add, TURN * hz * tempo * t, fade * size, 0.0, soft(t));
    });
    let turn = rows(model, &|t, add| {
        let phase = TURN * 0.7 * tempo * t;
        wave(add, phase, 0.3 * soft(t), 0.12 * soft(t), soft(t));
    });
    let coast = rows(model, &|t, add| {
        let size = 0.35 * soft(t) * soft(2.0 * (3.0 - t));
        wave(add, TURN * tempo * t, size, 0.0, soft(t));
    });
    // with legs a little elsewhere, so that no run takes another one's hand for its own repeat
    let still = rows(model, &|_, add| {
        for leg in ["FL", "FR", "HL", "HR"] {
            add(&format!("{leg}_hip"), 0.3 * (1.0 - tempo));
        }
    });
    let pressed = tempo as f32;
    let at_rest = Beginning::from(BaseHold::Water);
    let pressed =
        Beginning { hand: [0.0, 0.0, -PRESS_N * pressed, ROLL_NM * pressed, 0.0, 0.0], ..at_rest };
    [
        ("sizes", sizes, at_rest),
        ("turn", turn, at_rest),
        ("coast", coast, at_rest),
        ("float", still, pressed),
    ]
    .map(|(name, rows_rad, begins)| Script { name, rows_rad, begins })
    .into()
}
