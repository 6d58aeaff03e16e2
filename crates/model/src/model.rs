//! The checked robot: what every other crate reads.

use std::path::Path;

use crate::error::ModelError;
use crate::extension::Extension;
use crate::params::{
    BacklashParams, ContactParams, SensorParams, ServoParams, SupplyParams, WaterParams,
};
use crate::types::{Foot, Geom, Joint, Link, Site};

/// Whether the root link is free or fixed to the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BaseKind {
    /// Six degrees of freedom; the pose of the root link is part of the state.
    Free,
    /// The root link is fixed to (or jointed with) the world.
    Fixed,
}

/// A robot, loaded from `*.robot.toml` and the MJCF beside it, and checked: a value that exists is valid.
///
/// Two orders are used everywhere: *model order* (all joints, depth first as in the MJCF) and *policy order* (the actuated joints).
#[derive(Clone, Debug)]
pub struct RobotModel {
    pub(crate) name: String,
    pub(crate) hash: [u8; 32],
    pub(crate) base: BaseKind,
    pub(crate) gravity_mps2: [f64; 3],
    pub(crate) links: Vec<Link>,
    pub(crate) joints: Vec<Joint>,
    pub(crate) sites: Vec<Site>,
    pub(crate) world_geoms: Vec<Geom>,
    pub(crate) excluded_pairs: Vec<(usize, usize)>,
    pub(crate) actuated: Vec<usize>,
    pub(crate) nominal_pos_rad: Vec<f64>,
    pub(crate) swimming_pos_rad: Option<Vec<f64>>,
    pub(crate) limits_rad: Vec<(f64, f64)>,
    pub(crate) kp_nm_per_rad: f64,
    pub(crate) kd_nm_s_per_rad: f64,
    pub(crate) servo_presets: Vec<(String, ServoParams)>,
    pub(crate) servo_of: Vec<usize>,
    pub(crate) sensors: SensorParams,
    pub(crate) supply: SupplyParams,
    pub(crate) backlash: BacklashParams,
    pub(crate) contact: ContactParams,
    pub(crate) water: Option<WaterParams>,
    pub(crate) feet: Vec<Foot>,
    pub(crate) imu_site: Option<usize>,
    pub(crate) heading_sites: Option<(usize, usize)>,
    pub(crate) torso_link: usize,
    pub(crate) extension: Option<Extension>,
}

impl RobotModel {
    /// Reads a robot file and the MJCF that it names (a file in the same folder), and checks both completely.
    ///
    /// # Errors
    /// [`ModelError`] with file, place and reason.
    pub fn load(robot_toml: &Path) -> Result<Self, ModelError> {
        crate::load::from_path(robot_toml)
    }

    /// As [`RobotModel::load`], from bytes; `label` names the robot file in error messages.
    ///
    /// # Errors
    /// [`ModelError`] with place and reason.
    pub fn from_bytes(label: &str, robot_toml: &[u8], mjcf: &[u8]) -> Result<Self, ModelError> {
        crate::load::from_bytes(label, robot_toml, mjcf)
    }

    /// SHA-256 over both files, each preceded by its length (u64, little-endian): robot file first, then the MJCF.
    pub fn hash(&self) -> [u8; 32] {
        self.hash
    }

    /// [`RobotModel::hash`] in lower-case hexadecimal.
    pub fn hash_hex(&self) -> String {
        self.hash.iter().map(|b| format!("{b:02x}")).collect()
    }

    /// The robot's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Free or fixed base.
    pub fn base(&self) -> BaseKind {
        self.base
    }

    /// Acceleration of gravity in the world, m/s² (z up).
    pub fn gravity_mps2(&self) -> [f64; 3] {
        self.gravity_mps2
    }

    /// Links, depth first; a parent always comes before its children, the root link is first.
    pub fn links(&self) -> &[Link] {
        &self.links
    }

    /// Index of the link called `name`.
    pub fn link_index(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|l| l.name == name)
    }

    /// All joints in model order (J of them; a free base is not among them).
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Model index of the joint called `name`.
    pub fn joint_index(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|j| j.name == name)
    }

    /// Model index of each actuated joint, in policy order.
    pub fn actuated(&self) -> &[usize] {
        &self.actuated
    }

    /// Names of the actuated joints, in policy order.
    pub fn actuated_names(&self) -> Vec<&str> {
        self.actuated
            .iter()
            .map(|&j| self.joints[j].name.as_str())
            .collect()
    }

    /// Nominal (standing) pose of the actuated joints, rad, policy order.
    pub fn nominal_pos_rad(&self) -> &[f64] {
        &self.nominal_pos_rad
    }

    /// Swimming pose of the actuated joints, rad, policy order.
    pub fn swimming_pos_rad(&self) -> Option<&[f64]> {
        self.swimming_pos_rad.as_deref()
    }

    /// Lower and upper position limit of each actuated joint, rad, policy order.
    pub fn joint_limits_rad(&self) -> &[(f64, f64)] {
        &self.limits_rad
    }

    /// Proportional gain of the position loop at each actuated joint, N·m/rad.
    pub fn kp_nm_per_rad(&self) -> f64 {
        self.kp_nm_per_rad
    }

    /// Derivative gain of the position loop at each actuated joint, N·m·s/rad.
    pub fn kd_nm_s_per_rad(&self) -> f64 {
        self.kd_nm_s_per_rad
    }

    /// The servo of an actuated joint (index in policy order; an index beyond the last joint gives the last joint's servo).
    pub fn servo(&self, actuated_index: usize) -> &ServoParams {
        let preset = self.servo_of[actuated_index.min(self.servo_of.len() - 1)];
        &self.servo_presets[preset].1
    }

    /// Every servo preset of the robot file, by name, in name order.
    pub fn servo_presets(&self) -> &[(String, ServoParams)] {
        &self.servo_presets
    }

    /// Sensors outside the servos.
    pub fn sensors(&self) -> &SensorParams {
        &self.sensors
    }

    /// Supply voltages.
    pub fn supply(&self) -> &SupplyParams {
        &self.supply
    }

    /// Supply voltage that simulations use unless told otherwise, V.
    pub fn supply_v(&self) -> f64 {
        self.supply.default_v
    }

    /// Play at the girdles (no joints where the robot has none).
    pub fn backlash(&self) -> &BacklashParams {
        &self.backlash
    }

    /// What a diagnosis found that the rest of the robot file lacks.
    pub fn extension(&self) -> Option<&Extension> {
        self.extension.as_ref()
    }

    /// Ground contact.
    pub fn contact(&self) -> &ContactParams {
        &self.contact
    }

    /// Water, for robots that swim.
    pub fn water(&self) -> Option<&WaterParams> {
        self.water.as_ref()
    }

    /// The feet, in the order of the robot file (Polymander: FL, FR, HL, HR); empty for an arm.
    pub fn feet(&self) -> &[Foot] {
        &self.feet
    }

    /// Whether a foot is on `link` or on a link that it carries: what has to be held up while walking, against what
    /// may trail on the ground (a salamander's tail). Every link of a robot without feet counts as carrying.
    pub fn carries_feet(&self, link: usize) -> bool {
        let below = |foot: &Foot| {
            std::iter::successors(Some(foot.link), |&l| self.links[l].parent).any(|l| l == link)
        };
        self.feet.is_empty() || self.feet.iter().any(below)
    }

    /// All named sites.
    pub fn sites(&self) -> &[Site] {
        &self.sites
    }

    /// The site called `name`.
    pub fn site(&self, name: &str) -> Option<&Site> {
        self.sites.iter().find(|s| s.name == name)
    }

    /// Where the IMU sits; `None` on a robot without one.
    pub fn imu_site(&self) -> Option<&Site> {
        self.imu_site.map(|i| &self.sites[i])
    }

    /// The hind and the front site whose connecting line (hind to front) is the robot's heading.
    pub fn heading_sites(&self) -> Option<(&Site, &Site)> {
        self.heading_sites
            .map(|(h, f)| (&self.sites[h], &self.sites[f]))
    }

    /// Index of the link at whose centre of mass pushes act.
    pub fn torso_link(&self) -> usize {
        self.torso_link
    }

    /// Geoms fixed to the world (the MJCF's floor; engines put their own terrain there).
    pub fn world_geoms(&self) -> &[Geom] {
        &self.world_geoms
    }

    /// Pairs of links that never collide.
    pub fn excluded_pairs(&self) -> &[(usize, usize)] {
        &self.excluded_pairs
    }

    /// Sum of all link masses, kg.
    pub fn total_mass_kg(&self) -> f64 {
        self.links.iter().map(|l| l.mass_kg).sum()
    }
}
