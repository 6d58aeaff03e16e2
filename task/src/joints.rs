//! The actuated joints as the task sees them: nominal pose and limits in fixed arrays.

use caudata_model::RobotModel;

use crate::{ACT_DIM, FEET, TaskError};

/// Nominal position and limits of the actuated joints, rad, policy order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointTable {
    /// Nominal (standing) pose: actions are offsets from it.
    pub nominal_rad: [f32; ACT_DIM],
    /// Lower position limits.
    pub lower_rad: [f32; ACT_DIM],
    /// Upper position limits.
    pub upper_rad: [f32; ACT_DIM],
}

impl JointTable {
    /// Reads the table out of a robot model.
    ///
    /// # Errors
    /// [`TaskError::Robot`] unless the robot has 16 actuated joints and four feet.
    pub fn from_model(model: &RobotModel) -> Result<Self, TaskError> {
        let count = |what, found, expected| {
            if found == expected {
                return Ok(());
            }
            Err(TaskError::Robot {
                robot: model.name().to_owned(),
                what,
                found,
                expected,
            })
        };
        count("actuated joints", model.actuated().len(), ACT_DIM)?;
        count("feet", model.feet().len(), FEET)?;
        Ok(Self {
            nominal_rad: std::array::from_fn(|i| model.nominal_pos_rad()[i] as f32),
            lower_rad: std::array::from_fn(|i| model.joint_limits_rad()[i].0 as f32),
            upper_rad: std::array::from_fn(|i| model.joint_limits_rad()[i].1 as f32),
        })
    }
}
