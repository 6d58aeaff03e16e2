//! A case as a baseline sees it: the logs, their repeats' noise, residuals of a robot in the engine.

use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_runlog::{RunLog, Signal};
use caudata_sim::SimError;

use super::setup::Setup;
use crate::replay::{self, Prediction};
use crate::truth::sim::Commands;

/// One logged run.
#[derive(Clone, Debug)]
pub struct Logged {
    trial: String,
    commands: Commands,
    supply_v: f64,
    kp: Option<f64>,
    /// `[channels][rows]`: positions, speeds, currents.
    values: Vec<Vec<Option<f64>>>,
    /// Repeats' standard deviation per channel.
    sigma: Vec<f64>,
}

/// Fit and held-out runs of a case.
#[derive(Clone, Debug)]
pub struct CaseData {
    /// The robot.
    pub model: Arc<RobotModel>,
    /// Fit runs.
    pub fit: Vec<Logged>,
    /// Held-out runs.
    pub holdout: Vec<Logged>,
}

/// A run measured and predicted.
#[derive(Clone, Debug)]
pub struct Shown {
    /// `[rows][A]`, rad.
    pub commands_rad: Vec<Vec<f64>>,
    /// `[channels][rows]`
    pub measured: Vec<Vec<Option<f64>>>,
    /// `[channels][rows]`
    pub shown: Vec<Vec<f64>>,
}

/// Why a case cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// A file.
    #[error("{0}")]
    Io(#[from] std::io::Error),
    /// A log.
    #[error("{0}")]
    Log(#[from] caudata_runlog::LogError),
    /// The robot.
    #[error("{0}")]
    Model(#[from] caudata_model::ModelError),
    /// The engine.
    #[error("{0}")]
    Engine(#[from] SimError),
    /// Something is not there.
    #[error("{0} holds no {1}")]
    Missing(String, &'static str),
}

impl CaseData {
    /// Reads a case folder.
    ///
    /// # Errors
    /// [`DataError`].
    pub fn read(folder: &Path) -> Result<Self, DataError> {
        let mut robot = None;
        let mut runs = Vec::new();
        let mut entries: Vec<_> = std::fs::read_dir(folder)?.collect::<Result<_, _>>()?;
        entries.sort_by_key(std::fs::DirEntry::file_name);
        for entry in entries {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.ends_with(".robot.toml") {
                robot = Some(RobotModel::load(&entry.path())?);
            } else if entry.path().is_dir() {
                runs.push((name, RunLog::read(&entry.path())?));
            }
        }
        let missing = |what| DataError::Missing(folder.display().to_string(), what);
        let model = Arc::new(robot.ok_or_else(|| missing("robot file"))?);
        let mut fit = Vec::new();
        let mut holdout = Vec::new();
        for (name, log) in &runs {
            let logged = Logged::of(name, log, &model);
            if name.starts_with("holdout") {
                holdout.push(logged);
            } else {
                fit.push(logged);
            }
        }
        if fit.is_empty() || holdout.is_empty() {
            return Err(missing("fit or holdout runs"));
        }
        noise(&mut fit);
        noise(&mut holdout);
        Ok(Self {
            model,
            fit,
            holdout,
        })
    }

    /// The first repeat of each trial of `runs`, as `setup` predicts it.
    ///
    /// # Errors
    /// [`DataError::Engine`].
    pub fn shown(&self, runs: &[Logged], setup: &Setup) -> Result<Vec<Shown>, DataError> {
        firsts(runs)
            .into_iter()
            .map(|run| {
                Ok(Shown {
                    commands_rad: run.commands.rows_rad.clone(),
                    measured: run.values.clone(),
                    shown: self.predict(run, std::slice::from_ref(setup))?.remove(0),
                })
            })
            .collect()
    }

    /// Whitened residuals of every setup on the first repeat of each trial of `runs`. `[setups][values]`
    ///
    /// # Errors
    /// [`DataError::Engine`].
    pub fn residuals(&self, runs: &[Logged], setups: &[Setup]) -> Result<Vec<Vec<f64>>, DataError> {
        let mut out = vec![Vec::new(); setups.len()];
        for run in firsts(runs) {
            for (shown, out) in self.predict(run, setups)?.iter().zip(&mut out) {
                for ((measured, shown), sd) in run.values.iter().zip(shown).zip(&run.sigma) {
                    out.extend(
                        measured
                            .iter()
                            .zip(shown)
                            .map(|(m, s)| m.map_or(0.0, |m| (m - s) / sd)),
                    );
                }
            }
        }
        Ok(out)
    }

    /// What sensors show of every setup's run. `[setups][channels][rows]`
    fn predict(&self, run: &Logged, setups: &[Setup]) -> Result<Vec<Vec<Vec<f64>>>, DataError> {
        let lanes: Vec<_> = setups
            .iter()
            .map(|s| {
                let mut lane = s.lane.clone();
                // what the log declares: the supply, and the gain in force
                lane.supply_v += (run.supply_v - self.model.supply_v()) as f32;
                for (a, kp) in lane.kp_nm_per_rad.iter_mut().enumerate() {
                    let nominal = self.model.kp_nm_per_rad(a);
                    *kp *= (run.kp.unwrap_or(nominal) / nominal) as f32;
                }
                lane
            })
            .collect();
        let shifts: Vec<Vec<f64>> = setups
            .iter()
            .map(|s| s.offset_rad.iter().map(|b| -b).collect())
            .collect();
        let times_s = &run.commands.sent_s;
        let predictions =
            replay::predict_shifted(&self.model, &lanes, &shifts, &run.commands, times_s)?;
        Ok(setups
            .iter()
            .zip(&predictions)
            .map(|(s, p)| shown(s, p, times_s))
            .collect())
    }

    /// Error on held-out runs of `setup` over that of the nominal robot: geometric mean over channels of the
    /// root mean squares' ratio.
    ///
    /// # Errors
    /// [`DataError::Engine`].
    pub fn holdout_ratio(&self, setup: &Setup) -> Result<f64, DataError> {
        let both = self.residuals(&self.holdout, &[Setup::nominal(&self.model), setup.clone()])?;
        // one held-out trial per case, so channels follow each other
        let channels = self.holdout[0].values.len();
        let rows = both[0].len() / channels;
        let mut log_sum = 0.0;
        for c in 0..channels {
            let square = |r: &[f64]| {
                r[c * rows..(c + 1) * rows]
                    .iter()
                    .map(|x| x * x)
                    .sum::<f64>()
            };
            log_sum += 0.5 * (square(&both[1]).max(1e-12) / square(&both[0]).max(1e-12)).ln();
        }
        Ok((log_sum / channels as f64).exp())
    }
}

impl Logged {
    fn of(name: &str, log: &RunLog, model: &RobotModel) -> Self {
        let names = model.actuated_names();
        let column = |signal: &Signal| log.table.column(signal).map(<[_]>::to_vec);
        let mut held: Vec<f64> = model.nominal_pos_rad().to_vec();
        let columns: Vec<_> = names
            .iter()
            .map(|n| column(&Signal::Command((*n).to_owned())))
            .collect();
        let rows_rad = (0..log.table.len())
            .map(|k| {
                for (value, column) in held.iter_mut().zip(&columns) {
                    if let Some(x) = column.as_ref().and_then(|c| c[k]) {
                        *value = x;
                    }
                }
                held.clone()
            })
            .collect();
        let kinds: [fn(String) -> Signal; 3] =
            [Signal::Position, Signal::Velocity, Signal::Current];
        let empty = || vec![None; log.table.len()];
        let values = kinds
            .iter()
            .flat_map(|k| names.iter().map(move |n| k((*n).to_owned())))
            .map(|s| column(&s).unwrap_or_else(empty))
            .collect();
        Self {
            trial: name
                .rsplit_once('_')
                .map_or(name, |(trial, _)| trial)
                .to_owned(),
            commands: Commands {
                sent_s: log.table.time_s().to_vec(),
                rows_rad,
                lost: Vec::new(),
            },
            supply_v: log.meta.supply_v.unwrap_or(model.supply_v()),
            kp: log.meta.kp,
            values,
            sigma: Vec::new(),
        }
    }
}

/// Standard deviations from repeats, per trial and channel.
fn noise(runs: &mut [Logged]) {
    let all = runs.to_vec();
    for run in runs {
        run.sigma = (0..run.values.len())
            .map(|c| {
                let (mut sum, mut count) = (0.0, 0.0);
                let repeats: Vec<&Logged> = all.iter().filter(|r| r.trial == run.trial).collect();
                for pair in repeats.windows(2) {
                    for (x, y) in pair[0].values[c].iter().zip(&pair[1].values[c]) {
                        if let (Some(x), Some(y)) = (x, y) {
                            sum += 0.5 * (x - y) * (x - y);
                            count += 1.0;
                        }
                    }
                }
                f64::sqrt(sum / f64::max(count, 1.0)).max(1e-4)
            })
            .collect();
    }
}

/// The first repeat of each trial.
fn firsts(runs: &[Logged]) -> Vec<&Logged> {
    let mut out: Vec<&Logged> = Vec::new();
    for run in runs {
        if !out.iter().any(|r| r.trial == run.trial) {
            out.push(run);
        }
    }
    out
}

/// What the sensors show of a prediction. `[channels][rows]`
fn shown(setup: &Setup, p: &Prediction, times_s: &[f64]) -> Vec<Vec<f64>> {
    let servos = p.pos_rad.len();
    let mut out = Vec::with_capacity(3 * servos);
    for a in 0..servos {
        out.push(
            p.pos_rad[a]
                .iter()
                .map(|q| (1.0 + setup.gain[a]) * q + setup.offset_rad[a])
                .collect(),
        );
    }
    for a in 0..servos {
        let mut y = p.vel_radps[a][0];
        let mut last = times_s[0];
        let lagged = p.vel_radps[a].iter().zip(times_s).map(|(v, &t)| {
            let lag = setup.velocity_lag_s[a];
            let share = if lag > 0.0 {
                1.0 - (-(t - last) / lag).exp()
            } else {
                1.0
            };
            last = t;
            y += share * (v - y);
            y
        });
        out.push(lagged.collect());
    }
    for a in 0..servos {
        out.push(
            p.current_a[a]
                .iter()
                .map(|i| i + setup.current_bias_a[a])
                .collect(),
        );
    }
    out
}
