//! Taking over from the draws: which command a lane follows, where it starts, what befalls it, as evaluation
//! and the live page need it; and a task that changes while a training goes on.

use caudata_task::TaskConfig;
use caudata_task::layout::Part;
use caudata_task::observation::write_phase;

use crate::start::StartShift;
use crate::{EnvError, VecEnv};

impl VecEnv {
    /// Makes each lane follow the one command given for it, from now on and in later episodes, instead of
    /// drawing commands. Not part of a snapshot. `[N]`
    ///
    /// # Errors
    /// When there is not one command per lane.
    pub fn hold_commands(&mut self, commands: &[[f32; 3]]) -> Result<(), EnvError> {
        if commands.len() != self.lanes.len() {
            return Err(EnvError::Shape {
                what: "commands",
                found: commands.len(),
                expected: self.lanes.len(),
            });
        }
        self.held_commands = commands.to_vec();
        for lane in 0..self.lanes.len() {
            self.lanes[lane].hold(&self.task.phase, self.held_commands.get(lane));
            self.observe_start(lane)?;
        }
        Ok(())
    }

    /// Gives one running lane another command; its next observation has it. It lasts until the lane's episode
    /// ends, or until the time at which a drawn command would be replaced (never, where commands are held).
    pub fn set_command(&mut self, lane: usize, command: [f32; 3]) {
        let dim = self.layout.dim();
        let now = &mut self.lanes[lane];
        now.command.value = command;
        now.command.course_rad = None;
        now.clock.set_command(&self.task.phase, &command);
        let observation = &mut self.observations[lane * dim..][..dim];
        // what is newest of each; expressions follow with the next step
        let newest = |part| self.layout.range(part).start;
        if !self.layout.range(Part::Command).is_empty() {
            observation[newest(Part::Command)..][..command.len()].copy_from_slice(&command);
        }
        if !self.layout.range(Part::Phase).is_empty() {
            write_phase(&now.phases_rad(), &mut observation[newest(Part::Phase)..]);
        }
    }

    /// Takes over from `task` what may change while a training goes on: weights of rewards (at once), ranges of
    /// commands (with the next command) and of randomisation (with the next episode). The contract stays. A
    /// [`Self::restore`] needs the same changes first.
    pub fn retune(&mut self, task: &TaskConfig) {
        self.task.command = task.command;
        self.task.randomisation = task.randomisation;
        self.task.reward.weights = task.reward.weights;
        for (own, now) in self.task.reward.term.iter_mut().zip(&task.reward.term) {
            own.weight = now.weight;
        }
    }

    /// Pushes one lane's robot: a horizontal force on the torso, N, world, for this time from now on.
    pub fn push(&mut self, lane: usize, force_n: [f32; 2], duration_s: f64) {
        let steps = (duration_s / self.task.control_period_s).round() as u32;
        self.lanes[lane].push.begin(force_n, steps);
    }

    /// Multiplies the torque of every actuated joint by its factor, in every lane from now on: 1 is the whole
    /// joint, 0 a limp one. Not part of a snapshot. `[A]`
    ///
    /// # Errors
    /// When there is not one factor per joint, or the engine refuses one.
    pub fn set_joint_strengths(&mut self, strengths: &[f32]) -> Result<(), EnvError> {
        if strengths.len() != self.act_dim() {
            return Err(EnvError::Shape {
                what: "joint strengths",
                found: strengths.len(),
                expected: self.act_dim(),
            });
        }
        self.joint_strengths = strengths.to_vec();
        for lane in 0..self.lanes.len() {
            self.draw_robot(lane, self.lanes[lane].episode)?;
        }
        Ok(())
    }

    /// Starts every lane's present episode again, and from now on each one, with its drawn start shifted. Not
    /// part of a snapshot.
    ///
    /// # Errors
    /// When the engine refuses.
    pub fn shift_starts(&mut self, shift: StartShift) -> Result<(), EnvError> {
        self.start_shift = shift;
        for lane in 0..self.lanes.len() {
            let episode = self.lanes[lane].episode;
            self.lanes[lane] =
                self.start_episode(lane, episode, self.task.stagger_first_episode)?;
            self.observe_start(lane)?;
        }
        Ok(())
    }
}
