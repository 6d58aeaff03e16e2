//! `caudata gap policies`: what an extended model is worth to a policy.
//!
//! The same training, with the same seeds and the same number of samples, in the model as given, in the
//! extended one, and in the model as given with wide randomisation; all policies are run on the robot that
//! the extended model was made for, which is known where it is simulated.

mod chapter;
mod compare;
mod figures;
mod results;
mod speed;
mod ways;
mod wide;
mod work;

pub use chapter::{about, chapter, tables};
pub use compare::{PAGE, compare};
pub use figures::{Figures, Interval, Run};
pub use results::{Compared, Policy, Runs, Trained};
pub use speed::{Speed, Walks};
pub use ways::{Effort, Given, Robots, Way};

#[cfg(test)]
pub(crate) mod tests {
    use caudata_evaluation::{Estimate, ScenarioResult};

    /// Ten episodes: share of falls, and errors off the command.
    pub fn scenario(fall_share: f64, rmse_of_strides: [f64; 3]) -> ScenarioResult {
        let estimate = |mean| Estimate { mean, ..Estimate::default() };
        ScenarioResult {
            episodes: 10,
            fall_share: estimate(fall_share),
            power_w: estimate(6.5),
            rmse_of_strides,
            ..ScenarioResult::default()
        }
    }
}
