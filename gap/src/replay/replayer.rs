//! Robots, engines and threads of a replay.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use caudata_model::RobotModel;
use caudata_sim::batch::BatchEngine;
use caudata_sim::{EngineConfig, Terrain, TerrainConfig};

use super::data::Data;
use super::lanes;
use crate::effects::Effect;
use crate::error::GapError;
use crate::go_on::GoOn;
use crate::plant::{Plant, carry};
use crate::term::{Term, Variant};
use crate::trial::Trial;

/// Lanes of one engine: the widest vector register's.
pub const LANES: usize = 16;
/// Depth of the water unless a run says otherwise, m: deeper than any robot is long.
const DEPTH_M: f64 = 2.0;

/// Replays candidates.
pub struct Replayer {
    model: Arc<RobotModel>,
    /// Height of the water's surface above the ground at z = 0, m.
    water_level_m: f64,
    /// What the robot file's own extension has.
    given: Variant,
    threads: usize,
    go_on: GoOn,
    /// Time between recorded states, s: every step is recorded. A command jumps between steps and the torque
    /// jumps with it, so that a servo that reads its current just before the next command must not be told a
    /// mean that reaches beyond it.
    step_s: f64,
    /// As in [`EngineConfig::contact_hardness`].
    contact_hardness: f64,
    engines: [Mutex<Vec<BatchEngine>>; 3],
    rollouts: AtomicUsize,
    simulated_ms: AtomicUsize,
}

impl Replayer {
    /// For `model` (with its extension, if it has one), on `threads` threads.
    ///
    /// # Errors
    /// [`GapError::Extension`] where the extension does not fit the catalogue.
    pub fn new(model: Arc<RobotModel>, threads: usize) -> Result<Self, GapError> {
        let given = match model.extension() {
            Some(extension) => crate::extension::terms(extension, &model)?,
            None => Variant::new(),
        };
        Ok(Self {
            water_level_m: DEPTH_M,
            given,
            model,
            threads: threads.max(1),
            go_on: GoOn::default(),
            step_s: EngineConfig::default().dt_s,
            contact_hardness: 1.0,
            engines: [(); 3].map(|()| Mutex::new(Vec::new())),
            rollouts: AtomicUsize::new(0),
            simulated_ms: AtomicUsize::new(0),
        })
    }

    /// Puts the water's surface at `level_m` above the ground at z = 0 (`water_level_m` of a run's
    /// `log.toml`).
    pub fn with_water_level(mut self, level_m: f64) -> Self {
        self.water_level_m = level_m;
        self
    }

    /// Asks `go_on` before each engine full of stretches.
    pub fn with_go_on(mut self, go_on: GoOn) -> Self {
        self.go_on = go_on;
        self
    }

    /// From now on asks `go_on` instead.
    pub fn set_go_on(&mut self, go_on: GoOn) {
        self.go_on = go_on;
    }

    /// With `term` in every candidate, as if the robot file's own extension had it.
    pub fn with_also(mut self, term: Term) -> Self {
        self.given.push(term);
        self
    }

    /// Whether every candidate has `effect`.
    pub fn gives(&self, effect: &Effect) -> bool {
        self.given.iter().any(|t| t.effect.id == effect.id)
    }

    /// The same without `effect` in what is given.
    pub fn except(&self, effect: &Effect) -> Self {
        let mut other = self.with(self.step_s, self.contact_hardness);
        other.given.retain(|t| t.effect.id != effect.id);
        other
    }

    /// The same with half the step.
    pub fn finer(&self) -> Self {
        self.with(0.5 * self.step_s, self.contact_hardness)
    }

    /// The same on ground that pushes back so many times faster.
    pub fn on_harder_ground(&self, times: f64) -> Self {
        self.with(self.step_s, times * self.contact_hardness)
    }

    fn with(&self, step_s: f64, contact_hardness: f64) -> Self {
        Self {
            model: Arc::clone(&self.model),
            water_level_m: self.water_level_m,
            given: self.given.clone(),
            threads: self.threads,
            go_on: self.go_on.clone(),
            step_s,
            contact_hardness,
            engines: [(); 3].map(|()| Mutex::new(Vec::new())),
            rollouts: AtomicUsize::new(0),
            simulated_ms: AtomicUsize::new(0),
        }
    }

    /// The robot.
    pub fn model(&self) -> &Arc<RobotModel> {
        &self.model
    }

    /// What the robot file's own extension has, and `variant`.
    pub fn with_given(&self, variant: &[Term]) -> Variant {
        self.given.iter().chain(variant).cloned().collect()
    }

    /// Simulated stretches so far, and simulated time, s.
    pub fn spent(&self) -> (usize, f64) {
        (
            self.rollouts.load(Ordering::Relaxed),
            self.simulated_ms.load(Ordering::Relaxed) as f64 * 1e-3,
        )
    }

    /// The robot of a trial with a candidate's effects.
    pub fn plant(&self, trial: &Trial, variant: &[Term]) -> Plant {
        let mut plant = Plant::in_trial(&self.model, trial);
        plant.session = trial.session;
        for term in self.given.iter().chain(variant) {
            (term.effect.apply)(&mut plant, &term.place, &term.values);
        }
        carry(&self.model, &trial.meta.payload, &mut plant.lane);
        plant
    }

    /// What the sensors would have said: for each candidate the flat vector that [`Data`] describes; NaN
    /// where the simulation broke down or the candidate is not physical. `[V][N]`
    ///
    /// # Errors
    /// [`GapError::Sim`] where the robot cannot be simulated at all, [`GapError::Stopped`].
    pub fn predict(&self, data: &Data, variants: &[Variant]) -> Result<Vec<Vec<f32>>, GapError> {
        let mut jobs: Vec<(usize, usize)> = (0..variants.len())
            .flat_map(|v| (0..data.segments.len()).map(move |s| (v, s)))
            .collect();
        // neighbours in an engine should be equally long
        let length = |s: usize| data.segments[s].duration_s();
        jobs.sort_by(|a, b| {
            let hold = |s: usize| data.hold(s);
            hold(a.1)
                .cmp(&hold(b.1))
                .then(length(b.1).total_cmp(&length(a.1)))
                .then(a.1.cmp(&b.1))
                .then(a.0.cmp(&b.0))
        });
        let mut chunks: Vec<&[(usize, usize)]> = Vec::new();
        for of_hold in jobs.chunk_by(|a, b| data.hold(a.1) == data.hold(b.1)) {
            chunks.extend(of_hold.chunks(LANES));
        }
        let next = AtomicUsize::new(0);
        let done: Mutex<Vec<(usize, Vec<Vec<f32>>)>> = Mutex::new(Vec::new());
        let failed: Mutex<Option<GapError>> = Mutex::new(None);
        let work = || {
            loop {
                let k = next.fetch_add(1, Ordering::Relaxed);
                let Some(chunk) = chunks.get(k) else { return };
                let go_on = self.go_on.check();
                match go_on.and_then(|()| self.chunk(data, variants, chunk)) {
                    Ok(out) => lock(&done).push((k, out)),
                    Err(e) => {
                        lock(&failed).get_or_insert(e);
                        next.store(chunks.len(), Ordering::Relaxed);
                        return;
                    }
                }
            }
        };
        let threads = self.threads.min(chunks.len()).max(1);
        std::thread::scope(|scope| {
            for _ in 1..threads {
                scope.spawn(work);
            }
            work();
        });
        if let Some(e) = lock(&failed).take() {
            return Err(e);
        }
        let mut out = vec![vec![f32::NAN; data.len()]; variants.len()];
        for (k, predictions) in lock(&done).drain(..) {
            for ((v, s), prediction) in chunks[k].iter().zip(predictions) {
                let range = data.segments[*s].range.clone();
                if prediction.len() == range.len() {
                    out[*v][range].copy_from_slice(&prediction);
                }
            }
        }
        Ok(out)
    }

    /// One engine full of jobs, all of one hold.
    fn chunk(
        &self,
        data: &Data,
        variants: &[Variant],
        jobs: &[(usize, usize)],
    ) -> Result<Vec<Vec<f32>>, GapError> {
        let hold = jobs.first().map_or(0, |j| data.hold(j.1));
        let pooled = lock(&self.engines[hold]).pop();
        let mut engine = match pooled {
            Some(engine) => engine,
            None => self.build(hold)?,
        };
        let plants = jobs.iter().map(|&(v, s)| {
            let trial = &data.trials[data.segments[s].trial];
            (self.plant(trial, &variants[v]), s)
        });
        let outcome = lanes::run(&mut engine, data, self.step_s, plants.collect());
        lock(&self.engines[hold]).push(engine);
        let total: f64 = jobs.iter().map(|j| data.segments[j.1].duration_s()).sum();
        self.rollouts.fetch_add(jobs.len(), Ordering::Relaxed);
        self.simulated_ms.fetch_add((total * 1e3) as usize, Ordering::Relaxed);
        outcome
    }

    fn build(&self, hold: usize) -> Result<BatchEngine, GapError> {
        let config = EngineConfig {
            dt_s: self.step_s,
            substeps: 1,
            fixed_base: hold == 0,
            contact_hardness: self.contact_hardness,
            centred: true,
            ..EngineConfig::default()
        };
        let mut ground = TerrainConfig::default();
        if hold == 2 {
            ground.kind = caudata_sim::TerrainKind::DeepWater;
            ground.water_level_m = self.water_level_m;
        }
        let terrain = Terrain::generate(&ground, 1)?;
        Ok(BatchEngine::new(Arc::clone(&self.model), LANES, config, Arc::new(terrain), 1)?)
    }
}

/// A mutex whose holder died is still a mutex: what it guards is replaced whole.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}
