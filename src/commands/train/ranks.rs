//! The learner's other ranks on this host: started with it, started again when they die, and anew with every new learner.

use std::process::Command;
use std::time::{Duration, Instant};

use caudata_config::Config;
use caudata_telemetry::{ExitCode, Failure};
use nix::sys::signal::Signal;

use super::backoff::{Backoff, Verdict};
use super::children::{self, Process, Programs};
use super::folder::RunFolder;
use super::supervise::{failed_child, is_permanent};
use super::view::View;

/// Restarts of one rank per minute. A rank that dies costs the learner's iteration, so it does not help to try for long.
const RESTARTS_PER_MINUTE: u32 = 5;

/// Ranks 1, 2, … of the learner; none where there is one rank, or they run elsewhere.
pub struct Ranks<'a> {
    programs: &'a Programs,
    config: &'a Config,
    folder: &'a RunFolder,
    slots: Vec<Slot>,
}

struct Slot {
    rank: u32,
    process: Option<Process>,
    backoff: Backoff,
    /// When it shall be started again.
    due: Option<Instant>,
}

impl<'a> Ranks<'a> {
    /// Starts them.
    pub fn start(
        programs: &'a Programs,
        config: &'a Config,
        folder: &'a RunFolder,
    ) -> Result<Self, Failure> {
        let count = match config.cluster.ranks_are_here() {
            true => config.cluster.learner_ranks,
            false => 1,
        };
        let slot = |rank| Slot {
            rank,
            process: None,
            backoff: Backoff::new(RESTARTS_PER_MINUTE),
            due: None,
        };
        let mut ranks = Self {
            programs,
            config,
            folder,
            slots: (1..count).map(slot).collect(),
        };
        ranks.start_all()?;
        Ok(ranks)
    }

    fn start_all(&mut self) -> Result<(), Failure> {
        for index in 0..self.slots.len() {
            self.start_one(index)?;
        }
        Ok(())
    }

    fn start_one(&mut self, index: usize) -> Result<(), Failure> {
        let slot = &mut self.slots[index];
        slot.due = None;
        let mut command = Command::new(self.programs.find("caudata-learner")?);
        command.arg("--config").arg(self.folder.config());
        command.args(["--run-id", self.folder.run_id()]);
        command.args(["--rank", &slot.rank.to_string()]);
        super::supervise::add_telemetry(&mut command, self.config, false);
        slot.process = Some(Process::start(
            &format!("rank {} of the learner", slot.rank),
            command,
            &self
                .folder
                .logs()
                .join(format!("learner-rank-{}.log", slot.rank)),
            None,
        )?);
        Ok(())
    }

    /// For a new learner: whoever is still there may hang, which would be why there is a new one.
    pub fn start_anew(&mut self) -> Result<(), Failure> {
        self.slots.iter_mut().for_each(|slot| slot.process = None);
        self.start_all()
    }

    /// Notices what has ended at `since_start` of the supervisor and starts it again. Not while the run ends.
    pub fn watch(&mut self, view: &View, since_start: Duration) -> Result<(), Failure> {
        for index in 0..self.slots.len() {
            let slot = &mut self.slots[index];
            if slot.due.is_some_and(|due| Instant::now() >= due) {
                self.start_one(index)?;
                continue;
            }
            let Some(process) = &mut slot.process else {
                continue;
            };
            let Some(status) = process.ended() else {
                continue;
            };
            if status.success() {
                // It was asked to stop, and the learner with it.
                slot.process = None;
                continue;
            }
            let how = children::describe(status);
            let code = status.code().and_then(ExitCode::from_number);
            if let Some(code) = code.filter(|&code| is_permanent(code)) {
                return Err(failed_child(process, code, &how));
            }
            match slot.backoff.died(since_start) {
                Verdict::RestartAfter(pause) => {
                    slot.due = Some(Instant::now() + pause);
                    view.warn(&format!(
                        "rank {} of the learner {how}; it is started again in {:.2} s",
                        slot.rank,
                        pause.as_secs_f64()
                    ));
                }
                Verdict::GiveUp => return Err(failed_child(process, ExitCode::RankLost, &how)),
            }
            slot.process = None;
        }
        Ok(())
    }

    /// Asks them to stop: they work on until the learner has finished its iteration.
    pub fn ask_to_stop(&self) {
        let processes = self.slots.iter().filter_map(|slot| slot.process.as_ref());
        processes.for_each(|process| process.signal(Signal::SIGTERM));
    }

    /// Ends them within `patience`: the learner has ended.
    pub fn finish(&mut self, patience: Duration) {
        self.ask_to_stop();
        for slot in &mut self.slots {
            if let Some(mut process) = slot.process.take() {
                process.finish(patience);
            }
        }
    }
}
