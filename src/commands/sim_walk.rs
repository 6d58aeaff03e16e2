//! A walk under a policy, as moments that can be drawn.

use std::sync::Arc;

use caudata_config::Config;
use caudata_env::StartShift;
use caudata_live::{Order, Stage};
use caudata_model::{Pose, RobotModel};
use caudata_policy::PolicyFile;
use caudata_render::Moment;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

/// Vertical force from which a foot counts as standing, N: the same as in evaluations.
const TOUCH_N: f32 = 1.0;

/// What is drawn of it.
pub struct Walk {
    /// Where it starts, and which way it faces.
    pub start: StartShift,
    /// vx, vy (m/s), yaw rate (rad/s).
    pub command: [f32; 3],
    /// Time before the first picture, s.
    pub settle_s: f64,
    /// Pictures, at least one.
    pub pictures: usize,
    /// Pictures per second, at most one per control period.
    pub fps: f64,
}

impl Walk {
    /// The moments of the pictures.
    ///
    /// # Errors
    /// When the policy does not run on the robot.
    pub fn moments(
        &self,
        config: &Config,
        model: &Arc<RobotModel>,
        policy: &PolicyFile,
    ) -> Result<Vec<Moment>, Failure> {
        let mut stage = Stage::new(config, model, Some(policy)).or_exit(ExitCode::BadConfig)?;
        stage.place(self.start).or_exit(ExitCode::BadConfig)?;
        let velocity = self.command;
        stage.obey(&Order::Drive { velocity }).or_exit(ExitCode::BadConfig)?;
        let (mut moments, mut steps) = (Vec::with_capacity(self.pictures), 0_u32);
        while moments.len() < self.pictures {
            stage.step().or_exit(ExitCode::Internal)?;
            steps += 1;
            let time_s = f64::from(steps) * stage.period_s();
            if time_s < self.settle_s + moments.len() as f64 / self.fps {
                continue;
            }
            let pose = stage.pose();
            moments.push(Moment {
                time_s,
                base: Pose {
                    pos_m: pose.base_pos_m.map(f64::from),
                    quat_wxyz: pose.base_quat_wxyz.map(f64::from),
                },
                joint_pos_rad: pose.joint_pos_rad.iter().map(|&q| f64::from(q)).collect(),
                contacts: stage.frame().foot_force_n.iter().map(|&n| n > TOUCH_N).collect(),
            });
        }
        Ok(moments)
    }
}
