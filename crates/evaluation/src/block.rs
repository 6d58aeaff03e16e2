//! Episodes side by side: blocks of lanes, each with its own environments, spread over threads.
//!
//! A block's size does not depend on the number of threads, and a block depends on nothing but its number; so
//! neither do the results.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use caudata_env::VecEnv;
use caudata_policy::Inference;

use crate::gait::{Gait, Measure};
use crate::result::Episode;
use crate::righting::righted_s;
use crate::scenario::{Leg, Scenario};
use crate::transition::Shore;
use crate::wave::Wave;
use crate::{EvaluationError, Film, Frame, RobotPose, Trace, Track};

/// Lanes of a block: few enough to spread 256 episodes over four cores, many enough for inference in batches.
const LANES: usize = 64;

/// Some episodes of a scenario.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Block {
    /// Place among the blocks.
    pub number: usize,
    /// Its first episode.
    pub first: usize,
    /// Its episodes, one per lane.
    pub lanes: usize,
}

fn blocks(episodes: usize) -> Vec<Block> {
    (0..episodes.div_ceil(LANES))
        .map(|number| Block {
            number,
            first: number * LANES,
            lanes: LANES.min(episodes - number * LANES),
        })
        .collect()
}

/// Runs every block, at most `threads` at a time, and gives their results in order. After an error no further
/// block is begun; of several errors that of the first block is given.
pub(crate) fn run_blocks<T: Send>(
    episodes: usize,
    threads: usize,
    run: &(dyn Fn(Block) -> Result<T, EvaluationError> + Sync),
) -> Result<Vec<T>, EvaluationError> {
    let blocks = blocks(episodes);
    let (next, failed) = (AtomicUsize::new(0), AtomicBool::new(false));
    let done = Mutex::new(BTreeMap::new());
    let work = || {
        while !failed.load(Ordering::Relaxed) {
            let Some(&block) = blocks.get(next.fetch_add(1, Ordering::Relaxed)) else { return };
            let result = run(block);
            failed.fetch_or(result.is_err(), Ordering::Relaxed);
            let mut done = done.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            done.insert(block.number, result);
        }
    };
    std::thread::scope(|scope| {
        for _ in 1..threads.clamp(1, blocks.len().max(1)) {
            scope.spawn(work);
        }
        work();
    });
    let done = done.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    done.into_values().collect()
}

/// What a block gives.
pub(crate) struct Round {
    pub traces: Vec<Trace>,
    /// What each episode began with.
    pub commands: Vec<[f32; 3]>,
    /// Whether that changed.
    steered: bool,
    pub episodes: Vec<Episode>,
    pub tracks: Vec<Track>,
    pub film: Option<Film>,
}

impl Round {
    /// One episode per lane. `filmed`: the episode of the scenario that is to be shown.
    pub fn run(
        env: &mut VecEnv,
        inference: &mut Inference,
        scenario: &Scenario,
        block: Block,
        filmed: Option<usize>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Self, EvaluationError> {
        let lanes = env.lanes();
        let period_s = env.task().control_period_s;
        let steps = env.task().episode_steps as usize;
        let camera = filmed
            .and_then(|episode| episode.checked_sub(block.first))
            .filter(|&lane| lane < lanes);
        let mut traces: Vec<Trace> = (0..lanes)
            .map(|lane| Trace {
                period_s,
                clock_hz: f64::from(env.stride_frequency_hz(lane)),
                frames: Vec::with_capacity(steps),
                fell: None,
            })
            .collect();
        let commands: Vec<[f32; 3]> = (0..lanes).map(|lane| env.command(lane)).collect();
        let mut poses = Vec::new();
        let mut running = vec![true; lanes];
        let mut actions = vec![0.0; lanes * env.act_dim()];
        let mut time_s = 0.0;
        while running.contains(&true) {
            if !go_on() {
                return Err(EvaluationError::Stopped);
            }
            steer(env, &scenario.course, &commands, time_s);
            inference
                .run(env.observations(), lanes, &mut actions)
                .map_err(EvaluationError::Inference)?;
            let output = env.step(&actions)?;
            for episode in &output.episodes {
                let lane = episode.lane as usize;
                if running[lane] {
                    running[lane] = false;
                    traces[lane].fell = episode.reason.map(|reason| reason.name());
                }
            }
            for lane in (0..lanes).filter(|&lane| running[lane]) {
                traces[lane].frames.push(Frame::read(env, lane));
                if camera == Some(lane) {
                    poses.push(RobotPose::read(env, lane));
                }
            }
            time_s += period_s;
        }
        let film = camera.map(|lane| Film { trace: traces[lane].clone(), poses });
        Ok(Self {
            traces,
            commands,
            steered: !scenario.course.is_empty(),
            episodes: Vec::new(),
            tracks: Vec::new(),
            film,
        })
    }

    /// Measures the traces and lets go of them.
    pub fn measured(mut self, measure: &Measure, shore: Option<&Shore>, tracks: bool) -> Self {
        let steered = self.steered;
        let traces = std::mem::take(&mut self.traces);
        if tracks {
            self.tracks = traces.iter().map(Track::of).collect();
        }
        self.episodes = traces
            .iter()
            .zip(&self.commands)
            .map(|(trace, &first)| {
                let settled = trace.after(measure.settle_s);
                Episode {
                    command: if steered { mean_command(settled, first) } else { first },
                    fell: trace.fell,
                    gait: Gait::of(trace, measure),
                    passage: shore.map(|shore| shore.passage(trace, measure)),
                    righted_s: righted_s(trace),
                    wave: Wave::of(settled, trace.period_s, &measure.anatomy.in_leg),
                }
            })
            .collect();
        self
    }
}

/// Gives every lane the command of the present leg.
fn steer(env: &mut VecEnv, legs: &[Leg], commands: &[[f32; 3]], time_s: f64) {
    for (lane, &first) in commands.iter().enumerate() {
        let heading_rad = env.state().heading_rad[lane];
        if let Some(command) = Leg::command(legs, first, time_s, heading_rad) {
            env.set_command(lane, command);
        }
    }
}

/// Mean of what was commanded after settling; `first` where nothing was.
fn mean_command(frames: &[Frame], first: [f32; 3]) -> [f32; 3] {
    let n = frames.len() as f32;
    match frames.is_empty() {
        true => first,
        false => std::array::from_fn(|i| frames.iter().map(|f| f.command[i]).sum::<f32>() / n),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_cover_every_episode_once() {
        let sizes = |n| blocks(n).iter().map(|b| b.lanes).collect::<Vec<_>>();
        assert_eq!(sizes(1), [1]);
        assert_eq!(sizes(64), [64]);
        assert_eq!(sizes(130), [64, 64, 2]);
        assert_eq!(blocks(130)[2].first, 128);
    }

    #[test]
    fn results_come_in_order_from_any_number_of_threads() {
        for threads in [1, 2, 7] {
            let firsts = run_blocks(300, threads, &|block| Ok(block.first)).unwrap();
            assert_eq!(firsts, [0, 64, 128, 192, 256]);
        }
        let stopped = run_blocks(300, 2, &|block| match block.number {
            1 => Err(EvaluationError::Stopped),
            _ => Ok(()),
        });
        assert!(matches!(stopped, Err(EvaluationError::Stopped)));
    }
}
