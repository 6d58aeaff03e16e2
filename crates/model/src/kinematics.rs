//! Forward kinematics: where everything is, given the base pose and the joint positions.

use crate::error::ModelError;
use crate::model::RobotModel;
use crate::pose::{self, Pose};
use crate::types::{BaseKind, JointMotion};

/// A joint's axis line in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointFrame {
    /// Anchor, world, m.
    pub anchor_m: [f64; 3],
    /// Unit axis, world.
    pub axis: [f64; 3],
}

/// Link poses and joint axes in the world for one configuration.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Kinematics {
    /// `world_from_link`, one per link.
    pub links: Vec<Pose>,
    /// One per joint, model order.
    pub joints: Vec<JointFrame>,
}

impl RobotModel {
    /// World poses of all links and joint axes.
    ///
    /// `world_from_base`: pose of the root link's frame (a free base); for a fixed base, a shift of the whole
    /// robot (identity as in the MJCF). `joint_pos_rad`: `[J]`, model order (m for slides).
    ///
    /// # Errors
    /// [`ModelError::Length`] where `joint_pos_rad` has the wrong length.
    pub fn kinematics(
        &self,
        world_from_base: &Pose,
        joint_pos_rad: &[f64],
    ) -> Result<Kinematics, ModelError> {
        let mut out = Kinematics::default();
        self.kinematics_into(world_from_base, joint_pos_rad, &mut out)?;
        Ok(out)
    }

    /// As [`RobotModel::kinematics`], reusing `out`.
    ///
    /// # Errors
    /// [`ModelError::Length`] where `joint_pos_rad` has the wrong length.
    pub fn kinematics_into(
        &self,
        world_from_base: &Pose,
        joint_pos_rad: &[f64],
        out: &mut Kinematics,
    ) -> Result<(), ModelError> {
        if joint_pos_rad.len() != self.joints.len() {
            return Err(ModelError::Length {
                what: "joint positions",
                got: joint_pos_rad.len(),
                need: self.joints.len(),
            });
        }
        out.links.clear();
        out.joints.clear();
        for link in &self.links {
            let mut pose = match link.parent {
                Some(p) => out.links[p].compose(&link.parent_from_link),
                None => self.root_pose(world_from_base, link.parent_from_link),
            };
            for &j in &link.joints {
                let joint = &self.joints[j];
                let frame = JointFrame {
                    anchor_m: pose.point(joint.anchor_m),
                    axis: pose.rotate(joint.axis),
                };
                out.joints.push(frame);
                match joint.motion {
                    JointMotion::Slide => {
                        pose.pos_m =
                            pose::add(pose.pos_m, frame.axis.map(|a| a * joint_pos_rad[j]));
                    }
                    JointMotion::Hinge => {
                        let turn = pose::quat_from_axis_angle(joint.axis, joint_pos_rad[j]);
                        pose.quat_wxyz = pose::quat_mul(pose.quat_wxyz, turn);
                        // the turn is about the anchor, not about the link's origin
                        pose.pos_m = pose::sub(frame.anchor_m, pose.rotate(joint.anchor_m));
                    }
                }
            }
            out.links.push(pose);
        }
        Ok(())
    }

    fn root_pose(&self, world_from_base: &Pose, placed: Pose) -> Pose {
        match self.base {
            BaseKind::Free => *world_from_base,
            BaseKind::Fixed => world_from_base.compose(&placed),
        }
    }

    /// Height of the lowest point of a link that can touch, m; `None` where nothing of it can.
    pub fn lowest_m(&self, places: &Kinematics, link: usize) -> Option<f64> {
        let shapes = self.links[link].geoms.iter().filter(|g| g.collides()).map(|geom| {
            let at = places.links[link].compose(&geom.link_from_geom);
            at.pos_m[2] - geom.shape.half_extent_m(at.inverse().rotate([0.0, 0.0, 1.0]))
        });
        shapes.min_by(f64::total_cmp)
    }

    /// Positions of all joints `[J]` (model order) from those of the actuated ones (policy order); the others
    /// are 0.
    ///
    /// # Errors
    /// [`ModelError::Length`] where `actuated_pos_rad` has the wrong length.
    pub fn full_pos_rad(&self, actuated_pos_rad: &[f64]) -> Result<Vec<f64>, ModelError> {
        if actuated_pos_rad.len() != self.actuated.len() {
            return Err(ModelError::Length {
                what: "actuated joint positions",
                got: actuated_pos_rad.len(),
                need: self.actuated.len(),
            });
        }
        let mut full = vec![0.0; self.joints.len()];
        for (&j, &q) in self.actuated.iter().zip(actuated_pos_rad) {
            full[j] = q;
        }
        Ok(full)
    }

    /// Centre of mass of the whole robot in the world, m.
    pub fn centre_of_mass_m(&self, kinematics: &Kinematics) -> [f64; 3] {
        let mut sum = [0.0; 3];
        for (link, pose) in self.links.iter().zip(&kinematics.links) {
            let c = pose.point(link.com_m);
            sum = pose::add(sum, c.map(|x| x * link.mass_kg));
        }
        let total = self.total_mass_kg();
        sum.map(|x| x / total)
    }
}
