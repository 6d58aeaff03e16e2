//! The true state of all lanes as arrays: what rewards and observations that are written in Python read.

use caudata_env::{Truth, VecEnv};
use caudata_sim::State;
use numpy::{PyArray, PyArrayDyn, PyArrayMethods, PyReadwriteArrayDyn};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Where a signal comes from.
#[derive(Clone, Copy)]
enum Source {
    /// One lane's values, in the task's order and frames.
    Truth(fn(&Truth) -> &[f32]),
    /// All lanes' values, as the engine keeps them.
    State(fn(&State) -> &[f32]),
    /// The command that was to be followed in the step.
    Command,
    /// Phases of the gait clock.
    Phase,
}

use Source::{Command, Phase, State as S, Truth as T};

/// Name, source, and how many numbers belong together (3: the last axis is a vector).
/// `python/caudata/_signals.py` says what each is.
#[rustfmt::skip]
const TABLE: [(&str, Source, usize); 24] = [
    ("command", Command, 1),
    ("phase_rad", Phase, 1),
    ("joint_pos_rad", T(|t| &t.joint_pos_rad), 1),
    ("joint_vel_radps", T(|t| &t.joint_vel_radps), 1),
    ("motor_torque_nm", T(|t| &t.motor_torque_nm), 1),
    ("mech_power_w", T(|t| &t.mech_power_w), 1),
    ("heading_rad", T(|t| std::slice::from_ref(&t.heading_rad)), 1),
    ("com_vel_mps", T(|t| &t.com_vel_mps), 1),
    ("yaw_rate_radps", T(|t| std::slice::from_ref(&t.yaw_rate_radps)), 1),
    ("com_height_m", T(|t| std::slice::from_ref(&t.com_height_m)), 1),
    ("gyro_radps", T(|t| &t.gyro_radps), 1),
    ("gravity", T(|t| &t.gravity), 1),
    ("foot_height_m", T(|t| &t.foot_height_m), 1),
    ("foot_vel_mps", T(|t| t.foot_vel_mps.as_flattened()), 3),
    ("foot_force_n", T(|t| t.foot_force_n.as_flattened()), 3),
    ("trunk_force_n", T(|t| std::slice::from_ref(&t.trunk_force_n)), 1),
    ("submerged", T(|t| std::slice::from_ref(&t.submerged)), 1),
    ("base_pos_m", S(|s| &s.base_pos_m), 1),
    ("base_quat_wxyz", S(|s| &s.base_quat_wxyz), 1),
    ("base_vel_mps", S(|s| &s.base_vel_mps), 1),
    ("base_angvel_radps", S(|s| &s.base_angvel_radps), 1),
    ("com_pos_m", S(|s| &s.com_pos_m), 1),
    ("foot_pos_m", S(|s| &s.foot_pos_m), 3),
    ("tail_force_n", S(|s| &s.tail_force_n), 1),
];

/// The arrays, and the commands that the step now to be done is to follow.
pub struct Signals {
    arrays: Vec<(&'static str, Source, Py<PyArrayDyn<f32>>)>,
}

impl Signals {
    /// Arrays for the lanes of `env`: `[N]` of single numbers, `[N, k]`, `[N, F, 3]` of vectors per foot.
    pub fn new(py: Python<'_>, env: &VecEnv) -> Self {
        let (lanes, truth) = (env.lanes(), env.truth(0));
        let array = |(name, source, group): (&'static str, Source, usize)| {
            let width = match source {
                Command => env.command(0).len(),
                Phase => env.phases_rad(0).len(),
                T(of) => of(&truth).len(),
                S(of) => of(env.state()).len() / lanes,
            };
            let shape = match (group, width) {
                (1, 1) => vec![lanes],
                (1, width) => vec![lanes, width],
                (group, width) => vec![lanes, width / group, group],
            };
            let array = PyArray::zeros(py, shape, false);
            (name, source, array.unbind())
        };
        Self { arrays: TABLE.into_iter().map(array).collect() }
    }

    /// The arrays by name: the same ones each time.
    pub fn by_name<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let out = PyDict::new(py);
        for (name, _, array) in &self.arrays {
            out.set_item(name, array.bind(py))?;
        }
        Ok(out)
    }

    /// Holds the arrays, so that they can be filled while Python runs on.
    pub fn hold<'py>(&self, py: Python<'py>) -> PyResult<Vec<PyReadwriteArrayDyn<'py, f32>>> {
        let hold = |(_, _, array): &(_, _, Py<PyArrayDyn<f32>>)| array.bind(py).try_readwrite();
        Ok(self.arrays.iter().map(hold).collect::<Result<_, _>>()?)
    }

    /// What to do with each array, in their order.
    pub fn filler(&self) -> Filler {
        Filler(self.arrays.iter().map(|(_, source, _)| *source).collect())
    }
}

/// Fills arrays in the order of [`Signals`].
pub struct Filler(Vec<Source>);

impl Filler {
    /// Everything as it is now; `commands` where they are others than those that hold now. `[N]`
    pub fn fill(&self, into: &mut [&mut [f32]], env: &VecEnv, commands: Option<&[[f32; 3]]>) {
        let lanes = env.lanes();
        for (source, out) in self.0.iter().zip(into.iter_mut()) {
            if let S(of) = source {
                out.copy_from_slice(of(env.state()));
            }
        }
        for lane in 0..lanes {
            let truth = env.truth(lane);
            let phases = env.phases_rad(lane);
            let command = commands.map_or_else(|| env.command(lane), |c| c[lane]);
            for (source, out) in self.0.iter().zip(into.iter_mut()) {
                let values: &[f32] = match source {
                    T(of) => of(&truth),
                    Command => &command,
                    Phase => &phases,
                    S(_) => continue,
                };
                out[lane * values.len()..][..values.len()].copy_from_slice(values);
            }
        }
    }
}
