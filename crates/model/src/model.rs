//! The checked robot: what every other crate reads.

use std::f64::consts::TAU;

use crate::error::ModelError;
use crate::extension::Extension;
use crate::params::{
    BacklashParams, ContactParams, Gains, Measured, SensorParams, ServoParams, SupplyParams,
    WaterParams,
};
use crate::pose::Pose;
use crate::types::{BaseKind, Foot, Geom, Joint, JointMotion, Link, ROLLS_FROM_RAD, Shape, Site};

/// A tilt of the IMU up to this is one of its mounting and shows in what it reads, rad.
pub const IMU_TILT_MAX_RAD: f64 = 0.35;

/// A robot, loaded from `*.robot.toml` and the MJCF beside it, and checked: a value that exists is valid.
///
/// Two orders are used everywhere: *model order* (all joints, depth first as in the MJCF) and *policy order*
/// (the actuated joints).
#[derive(Clone, Debug)]
pub struct RobotModel {
    pub(crate) name: String,
    pub(crate) hash: [u8; 32],
    pub(crate) base: BaseKind,
    pub(crate) gravity_mps2: [f64; 3],
    pub(crate) links: Vec<Link>,
    pub(crate) assumed: Vec<String>,
    pub(crate) measured: Vec<Measured>,
    pub(crate) joints: Vec<Joint>,
    pub(crate) sites: Vec<Site>,
    pub(crate) world_geoms: Vec<Geom>,
    pub(crate) excluded_pairs: Vec<(usize, usize)>,
    pub(crate) actuated: Vec<usize>,
    pub(crate) nominal_pos_rad: Vec<f64>,
    pub(crate) swimming_pos_rad: Option<Vec<f64>>,
    pub(crate) limits_rad: Vec<(f64, f64)>,
    pub(crate) gains: Vec<Gains>,
    /// Every servo preset of the robot file, by name, in name order; then what it takes from the library.
    pub(crate) servo_presets: Vec<(String, ServoParams)>,
    pub(crate) servo_of: Vec<usize>,
    pub(crate) sensors: SensorParams,
    pub(crate) supply: SupplyParams,
    pub(crate) backlash: BacklashParams,
    pub(crate) contact: ContactParams,
    pub(crate) water: Option<WaterParams>,
    pub(crate) feet: Vec<Foot>,
    pub(crate) imu_site: Option<usize>,
    pub(crate) heading_line: Option<(Site, Site)>,
    pub(crate) torso_link: usize,
    pub(crate) extension: Option<Extension>,
}

/// Declares how parts of a robot are read: by reference, then by value.
macro_rules! readers {
    ($($(#[$about:meta])* $part:ident: $kind:ty,)+ ; $($(#[$about2:meta])* $value:ident: $copied:ty,)+) => {
        impl RobotModel {
            $($(#[$about])* pub fn $part(&self) -> $kind {
                &self.$part
            })+
            $($(#[$about2])* pub fn $value(&self) -> $copied {
                self.$value
            })+
        }
    };
}

readers! {
    /// The robot's name.
    name: &str,
    /// Links, depth first; a parent always comes before its children, the root link is first.
    links: &[Link],
    /// All joints in model order (J of them; a free base is not among them).
    joints: &[Joint],
    /// Model index of each actuated joint, in policy order.
    actuated: &[usize],
    /// Nominal (standing) pose of the actuated joints, rad, policy order.
    nominal_pos_rad: &[f64],
    /// Gains of the position loop of each actuated joint, policy order.
    gains: &[Gains],
    /// Sensors outside the servos.
    sensors: &SensorParams,
    /// Supply voltages.
    supply: &SupplyParams,
    /// Play at the girdles (no joints where the robot has none).
    backlash: &BacklashParams,
    /// Ground contact.
    contact: &ContactParams,
    /// The feet, in the order of the robot file (Polymander: FL, FR, HL, HR); empty for an arm.
    feet: &[Foot],
    /// All named sites.
    sites: &[Site],
    /// Geoms fixed to the world (the MJCF's floor; engines put their own terrain there).
    world_geoms: &[Geom],
    /// Figures of the robot file that nobody looked up, by their paths (`servo.preset.NAME.qd_max_radps`).
    assumed: &[String],
    /// How well the figures of each link were measured.
    measured: &[Measured],
    /// Pairs of links that never collide.
    excluded_pairs: &[(usize, usize)],
    ;
    /// SHA-256 over both files, each preceded by its length (u64, little-endian): robot file first, then the
    /// MJCF.
    hash: [u8; 32],
    /// Free or fixed base.
    base: BaseKind,
    /// Acceleration of gravity in the world, m/s² (z up).
    gravity_mps2: [f64; 3],
    /// Index of the link at whose centre of mass pushes act.
    torso_link: usize,
}

impl RobotModel {
    /// [`RobotModel::hash`] in lower-case hexadecimal.
    pub fn hash_hex(&self) -> String {
        hex::encode(self.hash)
    }

    /// Index of the link called `name`.
    pub fn link_index(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|l| l.name == name)
    }

    /// Model index of the joint called `name`.
    pub fn joint_index(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|j| j.name == name)
    }

    /// Names of the actuated joints, in policy order.
    pub fn actuated_names(&self) -> Vec<&str> {
        self.actuated.iter().map(|&j| self.joints[j].name.as_str()).collect()
    }

    /// Swimming pose of the actuated joints, rad, policy order.
    pub fn swimming_pos_rad(&self) -> Option<&[f64]> {
        self.swimming_pos_rad.as_deref()
    }

    /// Lower and upper position limit of each actuated joint, rad, policy order.
    pub fn joint_limits_rad(&self) -> &[(f64, f64)] {
        &self.limits_rad
    }

    /// The servo of an actuated joint (index in policy order; an index beyond the last joint gives the last
    /// joint's servo).
    pub fn servo(&self, actuated_index: usize) -> &ServoParams {
        let preset = self.servo_of[actuated_index.min(self.servo_of.len() - 1)];
        &self.servo_presets[preset].1
    }

    /// What counts as a radian at an actuated joint, rad or m ([`Joint::per_radian`]; indices as in
    /// [`Self::servo`]).
    pub fn per_radian(&self, actuated_index: usize) -> f64 {
        self.joints[self.actuated[actuated_index]].per_radian()
    }

    /// Whether an actuated joint turns without end: a wheel.
    pub fn rolls(&self, actuated_index: usize) -> bool {
        let (low, high) = self.joint_limits_rad()[actuated_index];
        high - low > ROLLS_FROM_RAD
    }

    /// Whether it tips over when it stands still on one foot of a stride, or on its wheels: one or two feet, or
    /// without feet one or two driven wheels and no castor, wheel or belly that is as low, and nothing that
    /// holds its base.
    pub fn balances(&self) -> bool {
        let stands = match self.feet.len() {
            0 => self.stands_on_wheels_alone().unwrap_or(false),
            feet => feet <= 2,
        };
        self.base == BaseKind::Free && stands
    }

    /// Whether one or two driven wheels are all that is low in the nominal pose.
    fn stands_on_wheels_alone(&self) -> Result<bool, ModelError> {
        let pos = self.full_pos_rad(&self.nominal_pos_rad)?;
        let places = self.kinematics(&Pose::IDENTITY, &pos)?;
        let rolling = (0..self.actuated.len()).filter(|&a| self.rolls(a));
        let wheels: Vec<usize> =
            rolling.map(|a| self.joints[self.actuated[a]].child_link).collect();
        let lowest_m = |l: usize| self.lowest_m(&places, l).unwrap_or(f64::INFINITY);
        // as low as a wheel: less than a tenth of its radius above the ground
        let low_m = wheels.iter().map(|&l| 0.1 * places.links[l].pos_m[2] + 0.9 * lowest_m(l));
        let low_m = low_m.fold(f64::INFINITY, f64::min);
        let bare = |l: usize| wheels.contains(&l) || lowest_m(l) > low_m;
        Ok(matches!(wheels.len(), 1 | 2) && (0..self.links.len()).all(bare))
    }

    /// Whether a shape of a link is a wheel: a cylinder about the hinge that carries the link, which turns by
    /// more than once.
    pub fn is_wheel(&self, link: usize, geom: &Geom) -> bool {
        let carries = |j: &&Joint| j.child_link == link && j.motion == JointMotion::Hinge;
        let turns = |j: &Joint| j.range_rad.is_none_or(|(low, high)| high - low > TAU);
        let round = |j: &Joint| geom.radius_about_m(j.anchor_m, j.axis).is_some();
        matches!(geom.shape, Shape::Cylinder { .. })
            && self.joints.iter().find(carries).is_some_and(|j| turns(j) && round(j))
    }

    /// The name of an actuated joint's servo type (indices as in [`Self::servo`]).
    pub fn servo_name(&self, actuated_index: usize) -> &str {
        let preset = self.servo_of[actuated_index.min(self.servo_of.len() - 1)];
        &self.servo_presets[preset].0
    }

    /// The path of an actuated joint's servo figure (`qd_max_radps`), if nobody looked that up.
    pub fn assumed_of_servo(&self, actuated_index: usize, figure: &str) -> Option<&str> {
        let own = format!(".{}.{figure}", self.servo_name(actuated_index));
        let mut all = self.assumed.iter();
        all.find(|path| path.starts_with("servo.") && path.ends_with(&own)).map(String::as_str)
    }

    /// Proportional gain of an actuated joint's position loop, N·m/rad (indices as in [`Self::servo`]).
    pub fn kp_nm_per_rad(&self, actuated_index: usize) -> f64 {
        self.gains[actuated_index.min(self.gains.len() - 1)].kp_nm_per_rad
    }

    /// Derivative gain of an actuated joint's position loop, N·m·s/rad (indices as in [`Self::servo`]).
    pub fn kd_nm_s_per_rad(&self, actuated_index: usize) -> f64 {
        self.gains[actuated_index.min(self.gains.len() - 1)].kd_nm_s_per_rad
    }

    /// The gains of all position loops, if they are the same.
    pub fn common_gains(&self) -> Option<Gains> {
        let first = *self.gains.first()?;
        self.gains.iter().all(|g| *g == first).then_some(first)
    }

    /// Supply voltage that simulations use unless told otherwise, V.
    pub fn supply_v(&self) -> f64 {
        self.supply.default_v
    }

    /// What a diagnosis found that the rest of the robot file lacks.
    pub fn extension(&self) -> Option<&Extension> {
        self.extension.as_ref()
    }

    /// Water, for robots that swim.
    pub fn water(&self) -> Option<&WaterParams> {
        self.water.as_ref()
    }

    /// Whether a foot is on `link` or on a link that it carries: what has to be held up while walking,
    /// against what may trail on the ground (a salamander's tail). Every link of a robot without feet counts
    /// as carrying.
    pub fn carries_feet(&self, link: usize) -> bool {
        self.feet.is_empty() || self.feet.iter().any(|foot| self.carries(link, foot.link))
    }

    /// The foot that a shape belongs to: place `geom` of the geoms of `link`.
    pub fn foot_of(&self, link: usize, geom: usize) -> Option<usize> {
        let mut feet = self.feet.iter();
        feet.position(|f| f.link == link && f.geoms.contains(&geom))
    }

    /// The foot of the leg that `link` belongs to: every link beyond whose joint there is exactly one foot is
    /// part of a leg, the rest is trunk.
    pub fn leg_of(&self, link: usize) -> Option<usize> {
        self.links[link].parent?;
        let mut feet = (0..self.feet.len()).filter(|&f| self.carries(link, self.feet[f].link));
        match (feet.next(), feet.next()) {
            (Some(foot), None) => Some(foot),
            _ => None,
        }
    }

    /// Whether `other` is `link` or hangs on it.
    fn carries(&self, link: usize, other: usize) -> bool {
        std::iter::successors(Some(other), |&l| self.links[l].parent).any(|l| l == link)
    }

    /// The site called `name`.
    pub fn site(&self, name: &str) -> Option<&Site> {
        self.sites.iter().find(|s| s.name == name)
    }

    /// Where the IMU sits; `None` on a robot without one.
    pub fn imu_site(&self) -> Option<&Site> {
        self.imu_site.map(|i| &self.sites[i])
    }

    /// The hind and the front site whose connecting line (hind to front) is the robot's heading. Where the
    /// heading is the x axis of one site, the second is a place ahead of it, with the same name.
    pub fn heading_sites(&self) -> Option<(&Site, &Site)> {
        self.heading_line.as_ref().map(|(hind, front)| (hind, front))
    }

    /// Sum of all link masses, kg.
    pub fn total_mass_kg(&self) -> f64 {
        self.links.iter().map(|l| l.mass_kg).sum()
    }
}
