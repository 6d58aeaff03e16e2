//! A lane's robot as an MJCF: names as `sim/mujoco/engine.py` wants them, no ground, no actuators.

use std::fmt::Write;

use caudata_model::{BaseKind, JointMotion, Pose, RobotModel, Softness};

use crate::drive::{JointPassive, ServoDrive};
use crate::effects::ENDLESS_RAD;
use crate::observe::LinkMass;
use crate::{EngineConfig, LaneParams};

/// What an MJCF is written from.
pub(super) struct Robot<'a> {
    pub model: &'a RobotModel,
    pub config: &'a EngineConfig,
    pub params: &'a LaneParams,
    pub masses: &'a [LinkMass],
    pub servos: &'a [ServoDrive<f64>],
    /// Where a held base is.
    pub world_from_base: &'a Pose,
}

impl Robot<'_> {
    /// The MJCF. Contacts and stops are as soft as the robot's own MJCF has them; the cone is elliptic and
    /// its friction hard, MuJoCo's most exact setting.
    pub fn mjcf(&self) -> String {
        let mut out = String::new();
        let gravity = list(&self.params.gravity_mps2.map(f64::from));
        let _ = write!(
            out,
            r#"<mujoco><compiler angle="radian" inertiafromgeom="false"/>
<option timestep="{}" integrator="implicitfast" cone="elliptic" impratio="100" gravity="{gravity}"/>
<worldbody>"#,
            self.config.dt_s
        );
        self.body(&mut out, 0);
        out.push_str("</worldbody></mujoco>\n");
        out
    }

    fn body(&self, out: &mut String, l: usize) {
        let link = &self.model.links()[l];
        let place = match (link.parent, self.model.base()) {
            (Some(_), _) => link.parent_from_link,
            (None, BaseKind::Free) => *self.world_from_base,
            (None, BaseKind::Fixed) => self.world_from_base.compose(&link.parent_from_link),
        };
        let _ = writeln!(out, r#"<body name="b{l}" {}>"#, at(&place));
        if l == 0 && self.config.frees_base(self.model) {
            out.push_str("<freejoint name=\"base\"/>\n");
        }
        let (mass, i) = (&self.masses[l], &self.masses[l].inertia_kgm2);
        let inertia = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)].map(|at| i[at]);
        let _ = writeln!(
            out,
            r#"<inertial pos="{}" mass="{}" fullinertia="{}"/>"#,
            list(&mass.com_m),
            mass.mass_kg,
            list(&inertia)
        );
        self.joints(out, l);
        self.geoms(out, l);
        let links = self.model.links().iter().enumerate();
        for (child, _) in links.filter(|(_, link)| link.parent == Some(l)) {
            self.body(out, child);
        }
        out.push_str("</body>\n");
    }

    fn joints(&self, out: &mut String, l: usize) {
        let passive = JointPassive::all(self.model, self.params);
        for &j in &self.model.links()[l].joints {
            let joint = &self.model.joints()[j];
            if self.config.holds(joint) {
                continue;
            }
            let servo = self.model.actuated().iter().position(|&a| a == j);
            let armature = servo.map_or(joint.armature_kgm2, |a| self.servos[a].armature_kgm2());
            let p = &passive[j];
            let motion = match joint.motion {
                JointMotion::Hinge => "hinge",
                JointMotion::Slide => "slide",
            };
            let endless = f64::from(ENDLESS_RAD);
            let limited = p.low_rad > -endless || p.high_rad < endless;
            let _ = writeln!(
                out,
                r#"<joint name="j{j}" type="{motion}" pos="{}" axis="{}" limited="{limited}" range="{} {}" {} armature="{armature}" damping="{}" frictionloss="{}" stiffness="{}" springref="{}"/>"#,
                list(&joint.anchor_m),
                list(&joint.axis),
                p.low_rad,
                p.high_rad,
                soft(&joint.stop, "limit"),
                p.damping_nms_per_rad,
                p.friction_nm,
                p.stiffness_nm_per_rad,
                p.spring_rest_rad,
            );
        }
    }

    /// Shapes that touch the ground, and nothing else.
    fn geoms(&self, out: &mut String, l: usize) {
        let link = &self.model.links()[l];
        for (g, geom) in link.geoms.iter().enumerate().filter(|(_, g)| g.collides()) {
            let foot = self.model.foot_of(l, g);
            let part = match foot {
                Some(foot) => format!("f{foot}"),
                None if self.model.carries_feet(l) => "t".to_owned(),
                None => "x".to_owned(),
            };
            let friction = match foot {
                Some(foot) => self.params.foot_friction * self.params.foot_friction_scale[foot],
                None => self.params.body_friction,
            };
            let Some((kind, size)) = geom.shape.mjcf() else { continue };
            let _ = writeln!(
                out,
                r#"<geom name="{part} {l} {g}" type="{kind}" size="{}" {} contype="0" conaffinity="1" priority="1" condim="3" friction="{friction}" {}/>"#,
                list(&size),
                at(&geom.link_from_geom),
                soft(&geom.soft, ""),
            );
        }
    }
}

fn at(pose: &Pose) -> String {
    format!(r#"pos="{}" quat="{}""#, list(&pose.pos_m), list(&pose.quat_wxyz))
}

/// `of`: `limit` for a joint's stop, nothing for a contact.
fn soft(softness: &Softness, of: &str) -> String {
    let (solref, solimp) = (list(&softness.solref), list(&softness.solimp));
    format!(r#"solref{of}="{solref}" solimp{of}="{solimp}""#)
}

fn list(values: &[f64]) -> String {
    let words: Vec<String> = values.iter().map(f64::to_string).collect();
    words.join(" ")
}
