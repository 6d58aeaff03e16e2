//! Many environments of one task, for Python.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use caudata_config::{Config, Source, robot_assignment};
use caudata_durable::set_home;
use caudata_env::{EpisodeStats, StepOutput, VecEnv};
use caudata_model::{Pose, RobotModel};
use caudata_render::{Moment, Quality, View, portrait};
use caudata_task::reward::TERMS;
use numpy::{
    PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray2, PyReadwriteArray1,
    PyReadwriteArray2,
};
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::MutexExt;
use pyo3::types::{PyBytes, PyDict};

use crate::policy::{Network, Origin, policy_file};
use crate::refused;
use crate::signals::Signals;

/// `N` lanes of one task on the batch engine. Everything is `float32` in SI units and radians.
#[pyclass(frozen, module = "caudata._caudata")]
pub struct Environments {
    config: Config,
    model: Arc<RobotModel>,
    env: Mutex<VecEnv>,
    /// `None`: nobody reads them, and they are not filled.
    signals: Option<Signals>,
    /// Size of the last picture, and distance of the camera in the first of that size.
    distance_m: Mutex<([u32; 2], Option<f64>)>,
}

impl Environments {
    /// A thread that waits here lets Python go on: whoever has the environments may need it to hand them
    /// back.
    fn lock(&self, py: Python<'_>) -> MutexGuard<'_, VecEnv> {
        let locked = self.env.lock_py_attached(py);
        locked.unwrap_or_else(PoisonError::into_inner)
    }

    /// Fills the signals with what is now, and `observations` `[N, D]` with the present ones.
    fn show(&self, py: Python<'_>, observations: &mut PyReadwriteArray2<'_, f32>) -> PyResult<()> {
        let env = self.lock(py);
        if let Some(signals) = &self.signals {
            let mut held = signals.hold(py)?;
            let mut into = slices(&mut held)?;
            signals.filler().fill(&mut into, &env, None);
        }
        observations.as_slice_mut()?.copy_from_slice(env.observations());
        Ok(())
    }
}

#[pymethods]
impl Environments {
    /// Environments as a preset, a TOML file and overrides (`key=value`) describe them, later ones winning;
    /// on another robot than theirs where one is given. With neither preset nor file it is the preset made for
    /// the robot. Robots and policies by a relative path are also looked for below `home`.
    #[new]
    #[pyo3(signature = (lanes, seed, threads, home, robot=None, preset=None, file=None, overrides=Vec::new(),
        signals=false))]
    fn new(
        py: Python<'_>,
        lanes: u32,
        seed: u64,
        threads: u32,
        home: PathBuf,
        robot: Option<PathBuf>,
        preset: Option<String>,
        file: Option<PathBuf>,
        overrides: Vec<String>,
        signals: bool,
    ) -> PyResult<Self> {
        set_home(&home);
        let mut source = Source { preset, file, overrides }
            .set(format!("actors.lanes={lanes}"))
            .set(format!("actors.threads={threads}"));
        // A preset may follow from the robot, so that it has to be known before the preset is read.
        source.overrides.extend(robot.as_deref().map(robot_assignment));
        source.or_preset("quick");
        let config = Config::load(&source).map_err(refused)?;
        let model = Arc::new(RobotModel::load(&config.robot_path()).map_err(refused)?);
        let env = build(&config, &model, seed)?;
        Ok(Self {
            signals: signals.then(|| Signals::new(py, &env)),
            env: Mutex::new(env),
            config,
            model,
            distance_m: Mutex::default(),
        })
    }

    /// Number of lanes N, of observation values D, of actions A.
    #[getter]
    fn shape(&self, py: Python<'_>) -> (usize, usize, usize) {
        let env = self.lock(py);
        (env.lanes(), env.obs_dim(), env.act_dim())
    }

    /// What a policy for these environments must be made for, as JSON.
    #[getter]
    fn contract(&self, py: Python<'_>) -> PyResult<String> {
        serde_json::to_string(self.lock(py).contract()).map_err(refused)
    }

    /// The whole configuration in effect, as TOML.
    #[getter]
    fn configuration(&self) -> PyResult<String> {
        self.config.to_toml().map_err(refused)
    }

    /// A policy for these environments as the bytes of an ONNX file: `network` is what it computes.
    fn policy_file<'py>(
        &self,
        py: Python<'py>,
        network: Network,
        origin: Origin,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let contract = self.lock(py).contract().clone();
        let bytes = policy_file(contract, self.config.hash_hex(), network, origin);
        Ok(PyBytes::new(py, &bytes.map_err(refused)?))
    }

    /// Hash of the contract, 64 hex digits.
    #[getter]
    fn contract_hash(&self, py: Python<'_>) -> String {
        self.lock(py).contract().hash_hex()
    }

    /// Longest episode, control steps.
    #[getter]
    fn episode_steps(&self, py: Python<'_>) -> u32 {
        self.lock(py).task().episode_steps
    }

    /// Names of the reward's terms.
    #[getter]
    fn terms(&self) -> Vec<&'static str> {
        TERMS.iter().map(|term| term.name).collect()
    }

    /// The arrays of the true state by name; they are the same ones after every step, filled anew.
    #[getter]
    fn signals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        match &self.signals {
            Some(signals) => signals.by_name(py),
            None => Err(PyValueError::new_err(
                "signals are not read in these environments; make them with signals=True",
            )),
        }
    }

    /// Starts a new episode in every lane; with a seed, the episodes that this seed begins with.
    #[pyo3(signature = (observations, seed=None))]
    fn reset(
        &self,
        py: Python<'_>,
        mut observations: PyReadwriteArray2<'_, f32>,
        seed: Option<u64>,
    ) -> PyResult<()> {
        match seed {
            Some(seed) => *self.lock(py) = build(&self.config, &self.model, seed)?,
            None => self.lock(py).reset_all().map_err(refused)?,
        }
        self.show(py, &mut observations)
    }

    /// Makes every lane follow one command for good: forward and leftward velocity (m/s), yaw rate (rad/s).
    /// `[N, 3]`
    fn hold_commands(
        &self,
        py: Python<'_>,
        commands: PyReadonlyArray2<'_, f32>,
        mut observations: PyReadwriteArray2<'_, f32>,
    ) -> PyResult<()> {
        let (rows, rest) = commands.as_slice()?.as_chunks::<3>();
        if !rest.is_empty() {
            return Err(PyValueError::new_err("a command has three numbers"));
        }
        self.lock(py).hold_commands(rows).map_err(refused)?;
        self.show(py, &mut observations)
    }

    /// Fills the signals and `observations` with what is now: after a step in which episodes ended, the
    /// starts of the next ones.
    fn look(&self, py: Python<'_>, mut observations: PyReadwriteArray2<'_, f32>) -> PyResult<()> {
        self.show(py, &mut observations)
    }

    /// A lane's robot as it is now, RGB. `[height, width, 3]`
    fn picture<'py>(
        &self,
        py: Python<'py>,
        lane: usize,
        width: u32,
        height: u32,
    ) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let (moment, terrain) = {
            let env = self.lock(py);
            if lane >= env.lanes() {
                let message = format!("lane {lane} of {}: they count from 0", env.lanes());
                return Err(PyIndexError::new_err(message));
            }
            (moment(&env, lane), Arc::clone(&env.engine().rig().terrain))
        };
        let quality =
            Quality { width, height, rays: 2, threads: self.config.actors.threads as usize };
        let drawn = py.detach(|| {
            let mut last = self.distance_m.lock().unwrap_or_else(PoisonError::into_inner);
            if last.0 != [width, height] {
                *last = ([width, height], None);
            }
            portrait(&self.model, &moment, &terrain, (View::Iso, 0.0), &mut last.1, &quality)
        });
        let image = drawn.map_err(refused)?;
        let flat = PyArray1::from_slice(py, image.rgb());
        flat.reshape([height as usize, width as usize, 3])
    }

    /// Tells how many environment steps were done in all; pushes and costs may grow with it.
    fn set_progress(&self, py: Python<'_>, env_steps_total: u64) {
        self.lock(py).set_progress(env_steps_total);
    }

    /// One control step. `actions` `[N, A]`; what it gives is written into the other arrays, `[N, D]` and
    /// `[N]`. A lane whose episode ends begins the next one in the same step. Returns the episodes that
    /// ended, `None` if there are none. Signals are those of the step, before any lane began anew.
    fn step<'py>(
        &self,
        py: Python<'py>,
        actions: PyReadonlyArray2<'py, f32>,
        mut observations: PyReadwriteArray2<'py, f32>,
        mut rewards: PyReadwriteArray1<'py, f32>,
        mut terminated: PyReadwriteArray1<'py, bool>,
        mut truncated: PyReadwriteArray1<'py, bool>,
    ) -> PyResult<Option<Bound<'py, PyDict>>> {
        let mut held = match &self.signals {
            Some(signals) => signals.hold(py)?,
            None => Vec::new(),
        };
        let mut into = slices(&mut held)?;
        let filler = self.signals.as_ref().map(Signals::filler);
        let (actions, observations) = (actions.as_slice()?, observations.as_slice_mut()?);
        let (rewards, terminated) = (rewards.as_slice_mut()?, terminated.as_slice_mut()?);
        let truncated = truncated.as_slice_mut()?;
        let mut env = self.lock(py);
        let env = &mut *env;
        let ended: Result<_, String> = py.detach(|| {
            let lanes = env.lanes();
            let commands: Vec<[f32; 3]> = (0..lanes).map(|lane| env.command(lane)).collect();
            let output = env.step_seen(actions, |env| {
                if let Some(filler) = &filler {
                    filler.fill(&mut into, env, Some(&commands));
                }
            });
            let output = output.map_err(|error| error.to_string())?;
            rewards.copy_from_slice(&output.rewards);
            terminated.copy_from_slice(&output.terminated);
            truncated.copy_from_slice(&output.truncated);
            let ended = (!output.episodes.is_empty()).then(|| output.clone());
            observations.copy_from_slice(env.observations());
            Ok(ended)
        });
        let ended = ended.map_err(PyValueError::new_err)?;
        ended.map(|output| episodes(py, output)).transpose()
    }
}

fn build(config: &Config, model: &Arc<RobotModel>, seed: u64) -> PyResult<VecEnv> {
    let engine = caudata_sim::build(
        Arc::clone(model),
        config.actors.lanes as usize,
        &config.engine,
        &config.terrain,
        seed,
        config.actors.threads as usize,
    );
    let engine = engine.map_err(refused)?;
    VecEnv::new(Arc::clone(model), config.task.clone(), engine, seed, 0).map_err(refused)
}

/// Where a lane's robot is.
fn moment(env: &VecEnv, lane: usize) -> Moment {
    let state = env.state();
    let joints = state.joint_pos_rad.len() / env.lanes();
    let of = |values: &[f32], width: usize| -> Vec<f64> {
        values[lane * width..][..width].iter().map(|&x| f64::from(x)).collect()
    };
    let (pos_m, quat) = (of(&state.base_pos_m, 3), of(&state.base_quat_wxyz, 4));
    Moment {
        time_s: 0.0,
        base: Pose {
            pos_m: std::array::from_fn(|i| pos_m[i]),
            quat_wxyz: std::array::from_fn(|i| quat[i]),
        },
        joint_pos_rad: of(&state.joint_pos_rad, joints),
        contacts: Vec::new(),
    }
}

fn slices<'a>(held: &'a mut [numpy::PyReadwriteArrayDyn<'_, f32>]) -> PyResult<Vec<&'a mut [f32]>> {
    let slice = |array: &'a mut numpy::PyReadwriteArrayDyn<'_, f32>| array.as_slice_mut();
    Ok(held.iter_mut().map(slice).collect::<Result<_, _>>()?)
}

/// A figure of an episode.
type Figure = fn(&EpisodeStats) -> f32;

/// The episodes that ended as arrays, one row for each.
fn episodes(py: Python<'_>, output: StepOutput) -> PyResult<Bound<'_, PyDict>> {
    let out = PyDict::new(py);
    let all = &output.episodes;
    let lanes: Vec<i64> = all.iter().map(|e| i64::from(e.lane)).collect();
    let steps: Vec<i64> = all.iter().map(|e| i64::from(e.steps)).collect();
    out.set_item("lane", PyArray1::from_vec(py, lanes))?;
    out.set_item("steps", PyArray1::from_vec(py, steps))?;
    let figures: [(&str, Figure); 7] = [
        ("return", |e| e.return_sum),
        ("mean_speed_mps", |e| e.mean_speed_mps),
        ("mean_velocity_error_mps", |e| e.mean_velocity_error_mps),
        ("mean_power_w", |e| e.mean_power_w),
        ("trunk_contact_share", |e| e.trunk_contact_share),
        ("duty_factor", |e| e.duty_factor),
        ("mean_slip_mps", |e| e.mean_slip_mps),
    ];
    for (name, of) in figures {
        let values: Vec<f32> = all.iter().map(of).collect();
        out.set_item(name, PyArray1::from_vec(py, values))?;
    }
    let terms: Vec<Vec<f32>> = all.iter().map(|e| e.terms.clone()).collect();
    out.set_item("terms", PyArray2::from_vec2(py, &terms).map_err(refused)?)?;
    let last = output.final_observations.into_iter().map(|(_, row)| row);
    let last: Vec<Vec<f32>> = last.collect();
    let last = PyArray2::from_vec2(py, &last).map_err(refused)?;
    out.set_item("final_observation", last)?;
    Ok(out)
}
