//! One lane's robot as MuJoCo has it: its state, and its loads for the coming step.

use caudata_model::{Pose, RobotModel};

use crate::EngineConfig;
use crate::drive::ImplicitTorque;
use crate::drive::lane::{JointState, Joints};
use crate::engine::WRENCH;
use crate::observe::Coordinates;

/// Numbers of a free base: position and quaternion; velocity and spin.
const FREE_BASE: (usize, usize) = (7, 6);

/// Force, and normal force, of a part's contacts.
const CONTACT: usize = 4;

/// State and loads.
#[derive(Clone)]
pub(super) struct Robot {
    free_base: bool,
    /// Place of each joint among those that move. `[J]`
    place_of: Vec<Option<usize>>,
    /// How many move.
    moving: usize,
    /// Positions, velocities, MuJoCo's warm start, contacts, as in the script's answer.
    pub answer: Vec<f64>,
    /// Joint torques, then a wrench on each link, world, at its centre of mass.
    pub loads: Vec<f64>,
    feet: usize,
}

impl Robot {
    pub fn new(model: &RobotModel, config: &EngineConfig) -> Self {
        let mut moving = 0;
        let place_of = (model.joints().iter())
            .map(|joint| {
                let place = (!config.holds(joint)).then_some(moving);
                moving += usize::from(place.is_some());
                place
            })
            .collect();
        let mut robot = Self {
            free_base: config.frees_base(model),
            place_of,
            moving,
            answer: Vec::new(),
            loads: vec![0.0; moving + WRENCH * model.links().len()],
            feet: model.feet().len(),
        };
        robot.answer = vec![0.0; robot.state_len() + CONTACT * (robot.feet + 2)];
        robot
    }

    /// How many numbers come before positions and before velocities of joints.
    fn base(&self) -> (usize, usize) {
        if self.free_base { FREE_BASE } else { (0, 0) }
    }

    /// Where velocities and the warm start begin in the answer.
    fn parts(&self) -> (usize, usize) {
        let (q, v) = self.base();
        let velocities = q + self.moving;
        (velocities, velocities + v + self.moving)
    }

    fn state_len(&self) -> usize {
        let (velocities, warm) = self.parts();
        2 * warm - velocities
    }

    /// Takes over coordinates, at rest inside.
    pub fn place(&mut self, at: &Coordinates) {
        self.answer.fill(0.0);
        let ((q, v), (velocities, _)) = (self.base(), self.parts());
        if self.free_base {
            let pose = &at.world_from_base;
            self.answer[..3].copy_from_slice(&pose.pos_m);
            self.answer[3..q].copy_from_slice(&pose.quat_wxyz);
            let spin = pose.inverse().rotate(at.base_angvel_radps);
            self.answer[velocities..][..3].copy_from_slice(&at.base_vel_mps);
            self.answer[velocities + 3..][..3].copy_from_slice(&spin);
        }
        for (j, place) in self.place_of.iter().enumerate() {
            let Some(place) = place else { continue };
            self.answer[q + place] = at.joint_pos_rad[j];
            self.answer[velocities + v + place] = at.joint_vel_radps[j];
        }
    }

    /// Fills `at`; what cannot move is left as it is.
    pub fn read(&self, at: &mut Coordinates) {
        let ((q, v), (velocities, _)) = (self.base(), self.parts());
        let three = |from: usize| [0, 1, 2].map(|i| self.answer[from + i]);
        if self.free_base {
            at.world_from_base =
                Pose { pos_m: three(0), quat_wxyz: [3, 4, 5, 6].map(|i| self.answer[i]) };
            at.base_vel_mps = three(velocities);
            at.base_angvel_radps = at.world_from_base.rotate(three(velocities + 3));
        }
        for (j, place) in self.place_of.iter().enumerate() {
            let Some(place) = place else { continue };
            at.joint_pos_rad[j] = self.answer[q + place];
            at.joint_vel_radps[j] = self.answer[velocities + v + place];
        }
    }

    /// What MuJoCo needs to go on from here.
    pub fn state(&self) -> &[f64] {
        &self.answer[..self.state_len()]
    }

    /// Takes every load off.
    pub fn clear_loads(&mut self) {
        self.loads.fill(0.0);
    }

    /// Adds a force (N) and torque (N·m), world, on a link at its centre of mass.
    pub fn push_link(&mut self, link: usize, wrench: [f64; WRENCH]) {
        let own = &mut self.loads[self.moving + WRENCH * link..][..WRENCH];
        for (sum, part) in own.iter_mut().zip(wrench) {
            *sum += part;
        }
    }

    /// Adds the contacts of the step just taken: `[F + 2, 4]`, feet, trunk, tail.
    pub fn add_contacts(&self, sums: &mut [f64]) {
        let contacts = &self.answer[self.state_len()..];
        for (sum, part) in sums.iter_mut().zip(contacts) {
            *sum += part;
        }
    }

    /// How many numbers [`Self::add_contacts`] adds to.
    pub fn contact_len(&self) -> usize {
        CONTACT * (self.feet + 2)
    }

    /// Whether everything is finite, and speeds sane.
    pub fn is_sound(&self, config: &EngineConfig) -> bool {
        let (velocities, warm) = self.parts();
        let (_, v) = self.base();
        let linear = v.min(3);
        let speeds = &self.answer[velocities..warm];
        // each comparison is false for not-a-number
        let below = |speeds: &[f64], limit: f64| speeds.iter().all(|s| s.abs() <= limit);
        self.answer.iter().all(|x| x.is_finite())
            && below(&speeds[..linear], config.max_base_speed_mps)
            && below(&speeds[linear..], config.max_joint_speed_radps)
    }
}

impl Joints for Robot {
    fn joint(&self, j: usize) -> Option<JointState> {
        let place = self.place_of[j]?;
        let ((q, v), (velocities, _)) = (self.base(), self.parts());
        Some(JointState {
            pos: self.answer[q + place] as f32,
            vel: self.answer[velocities + v + place] as f32,
        })
    }

    /// Friction, springs and stops are MuJoCo's own.
    fn load_joint(&mut self, j: usize, _torque: &ImplicitTorque<f32>, motor_nm: f32) {
        if let Some(place) = self.place_of[j] {
            self.loads[place] = f64::from(motor_nm);
        }
    }
}
