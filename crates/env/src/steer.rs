//! Taking over from the draws: which command a lane follows, and where it starts. Evaluation needs both,
//! training neither.

use caudata_task::layout::{ACTIONS, COMMAND, PHASE};
use caudata_task::reset::ResetDraw;

use crate::{EnvError, VecEnv};

/// A place and a heading that are added to every drawn start.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StartShift {
    /// World x and y, m.
    pub xy_m: [f32; 2],
    /// About the vertical, rad.
    pub yaw_rad: f32,
}

impl StartShift {
    /// The drawn start, shifted. Its velocity turns with the heading.
    pub(crate) fn apply(&self, mut start: ResetDraw) -> ResetDraw {
        let (sin, cos) = self.yaw_rad.sin_cos();
        let [vx, vy] = start.base_vel_mps;
        start.base_vel_mps = [cos * vx - sin * vy, sin * vx + cos * vy];
        start.yaw_rad += self.yaw_rad;
        for (at, by) in start.base_xy_m.iter_mut().zip(self.xy_m) {
            *at += by;
        }
        start
    }
}

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
        observation[COMMAND..ACTIONS].copy_from_slice(&command);
        for (foot, phase) in now.clock.phases_rad().into_iter().enumerate() {
            let (sin, cos) = phase.sin_cos();
            observation[PHASE + 2 * foot] = cos;
            observation[PHASE + 2 * foot + 1] = sin;
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::FRAC_PI_2;

    #[test]
    fn a_shift_moves_and_turns_a_start() {
        // a quarter turn takes a velocity of (0.1, 0) to (0, 0.1)
        let start = ResetDraw {
            base_xy_m: [0.5, -0.5],
            yaw_rad: 0.25,
            base_vel_mps: [0.1, 0.0],
            joint_pos_rad: [0.0; 16],
            joint_vel_radps: [0.0; 16],
        };
        let shift = StartShift {
            xy_m: [3.0, 1.0],
            yaw_rad: FRAC_PI_2,
        };
        let moved = shift.apply(start);
        assert_eq!(moved.base_xy_m, [3.5, 0.5]);
        assert_eq!(moved.yaw_rad, 0.25 + FRAC_PI_2);
        assert!(moved.base_vel_mps[0].abs() < 1e-7);
        assert!((moved.base_vel_mps[1] - 0.1).abs() < 1e-7);
        assert_eq!(StartShift::default().apply(start), start);
    }
}
