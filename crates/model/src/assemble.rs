//! Putting the robot file and the MJCF together: who plays which role, and whether the two agree.

use std::collections::BTreeMap;

use crate::error::ModelError;
use crate::params::{AddedShare, BacklashParams, DragScale, WaterParams};
use crate::parts::Robot;
use crate::robot_file::{BaseWord, Checker, RobotFile};
use crate::servos::Presets;
use crate::types::{Ball, BaseKind, Foot, Joint, JointKind, Link, Site};

/// Place of what is called `name` among the names of the MJCF.
pub(crate) fn find<'a>(
    c: &Checker<'_>,
    at: &str,
    kind: &str,
    name: &str,
    mut names: impl Iterator<Item = &'a str>,
) -> Result<usize, ModelError> {
    let missing = || c.error(at, format!("there is no {kind} `{name}` in the MJCF"));
    names.position(|n| n == name).ok_or_else(missing)
}

fn find_joint(c: &Checker<'_>, at: &str, name: &str, mj: &Robot) -> Result<usize, ModelError> {
    find(c, at, "joint", name, mj.joints().map(|j| j.name.as_str()))
}

pub(crate) fn base_kind(
    c: &Checker<'_>,
    file: &RobotFile,
    mj: &Robot,
) -> Result<BaseKind, ModelError> {
    match (file.base, mj.free_base) {
        (BaseWord::Free, true) => Ok(BaseKind::Free),
        (BaseWord::Fixed, false) => Ok(BaseKind::Fixed),
        (BaseWord::Free, false) => {
            Err(c.error("base", "is `free`, but the MJCF's root body has no <freejoint>"))
        }
        (BaseWord::Fixed, true) => {
            Err(c.error("base", "is `fixed`, but the MJCF's root body has a <freejoint>"))
        }
    }
}

/// Model index of each actuated joint; the MJCF's actuators must stand in the same order.
pub(crate) fn actuated_joints(
    c: &Checker<'_>,
    file: &RobotFile,
    mj: &Robot,
) -> Result<Vec<usize>, ModelError> {
    let at = "joints.actuated";
    let names = &file.joints.actuated;
    if names.is_empty() {
        return c.refuse(at, "is empty; name at least one joint");
    }
    let mut out = Vec::with_capacity(names.len());
    for (i, name) in names.iter().enumerate() {
        let j = find_joint(c, at, name, mj)?;
        if out.contains(&j) {
            return c.refuse(at, format!("names `{name}` twice"));
        }
        out.push(j);
        match mj.actuators.get(i) {
            Some(a) if &a.joint == name => {}
            Some(a) => {
                let message = format!(
                    "drives `{}` where the robot file's joint order has `{name}` (place {}); use one order in both files",
                    a.joint,
                    i + 1
                );
                return Err(ModelError::Mjcf(a.element.remark_of(message)));
            }
            None => return c.refuse(at, format!("joint `{name}` has no actuator in the MJCF")),
        }
    }
    if let Some(extra) = mj.actuators.get(names.len()) {
        return c.refuse(at, format!("lacks `{}`, which the MJCF actuates", extra.joint));
    }
    Ok(out)
}

pub(crate) fn backlash(
    c: &Checker<'_>,
    file: &RobotFile,
    mj: &Robot,
) -> Result<BacklashParams, ModelError> {
    let Some(b) = &file.backlash else { return Ok(BacklashParams::default()) };
    let mut joints = Vec::new();
    for name in &b.joints {
        let j = find_joint(c, "backlash.joints", name, mj)?;
        if file.joints.actuated.contains(name) || joints.contains(&j) {
            return c.refuse("backlash.joints", format!("`{name}` already has a role"));
        }
        joints.push(j);
    }
    joints.sort_unstable();
    Ok(BacklashParams {
        enabled: b.enabled,
        joints,
        half_width_rad: b.half_width_rad,
        stiffness_nm_per_rad: b.stiffness_nm_per_rad,
        damping_nm_s_per_rad: b.damping_nm_s_per_rad,
        friction_loss_nm: b.friction_loss_nm,
    })
}

/// All joints in model order, with the numbers of the robot file where it has them.
pub(crate) fn joints(
    c: &Checker<'_>,
    file: &RobotFile,
    mj: &Robot,
    actuated: &[usize],
    backlash: &BacklashParams,
    presets: &Presets,
    servo_of: &[usize],
) -> Result<Vec<Joint>, ModelError> {
    let mut out: Vec<Joint> = Vec::new();
    for (link, body) in mj.bodies.iter().enumerate() {
        for m in &body.joints {
            let j = out.len();
            let mut joint = Joint {
                name: m.name.clone(),
                motion: m.motion,
                kind: JointKind::Passive,
                parent_link: body.parent,
                child_link: link,
                axis: m.axis,
                anchor_m: m.anchor_m,
                range_rad: m.range,
                stop: m.stop,
                stiffness_nm_per_rad: m.stiffness,
                spring_ref_rad: m.spring_ref,
                damping_nm_s_per_rad: m.damping,
                armature_kgm2: m.armature,
                friction_loss_nm: m.friction_loss,
                locked: false,
            };
            if let Some(index) = actuated.iter().position(|&a| a == j) {
                let s = &presets[servo_of[index]].1;
                joint.kind = JointKind::Actuated { index };
                joint.damping_nm_s_per_rad = s.damping_nm_s_per_rad;
                joint.armature_kgm2 = s.armature_kgm2;
                joint.friction_loss_nm = s.friction_loss_nm;
            } else if backlash.joints.contains(&j) {
                joint.kind = JointKind::Backlash;
                joint.range_rad = Some((-backlash.half_width_rad, backlash.half_width_rad));
                joint.stiffness_nm_per_rad = backlash.stiffness_nm_per_rad;
                joint.damping_nm_s_per_rad = backlash.damping_nm_s_per_rad;
                joint.friction_loss_nm = backlash.friction_loss_nm;
                joint.locked = !backlash.enabled;
            } else {
                let table = file.passive.as_ref();
                let Some((table, p)) = table.and_then(|t| Some((t, t.joint.get(&m.name)?))) else {
                    return c.refuse(
                        "passive.joint",
                        format!(
                            "lacks `{}`: the MJCF joint is neither actuated nor backlash",
                            m.name
                        ),
                    );
                };
                joint.stiffness_nm_per_rad = p.stiffness_nm_per_rad;
                joint.damping_nm_s_per_rad = p.damping_nm_s_per_rad;
                joint.friction_loss_nm = p.friction_loss_nm;
                joint.locked = table.locked;
            }
            out.push(joint);
        }
    }
    for name in file.passive.iter().flat_map(|t| t.joint.keys()) {
        if !out.iter().any(|j| &j.name == name && j.kind == JointKind::Passive) {
            return c.refuse(
                format!("passive.joint.{name}"),
                "there is no such joint in the MJCF, or it already has a role",
            );
        }
    }
    Ok(out)
}

/// A pose by joint name, complete and within the limits, in policy order.
pub(crate) fn pose(
    c: &Checker<'_>,
    at: &str,
    by_name: &BTreeMap<String, f64>,
    file: &RobotFile,
    limits_rad: &[(f64, f64)],
) -> Result<Vec<f64>, ModelError> {
    for name in by_name.keys() {
        if !file.joints.actuated.contains(name) {
            return c.refuse(at, format!("`{name}` is not an actuated joint"));
        }
    }
    let mut out = Vec::new();
    for (name, &(lo, hi)) in file.joints.actuated.iter().zip(limits_rad) {
        let q = *by_name.get(name).ok_or_else(|| c.error(at, format!("lacks `{name}`")))?;
        if !(lo..=hi).contains(&q) {
            return c.refuse(
                format!("{at}.{name}"),
                format!("{q} rad is outside the joint's limits {lo} to {hi}"),
            );
        }
        out.push(q);
    }
    Ok(out)
}

type Parts = (Vec<Link>, Vec<Site>, Vec<crate::types::Geom>, Vec<(usize, usize)>);

pub(crate) fn parts(mj: Robot) -> Parts {
    let place = |name: &String| mj.bodies.iter().position(|b| b.name == *name);
    let pair = |[a, b]: &[String; 2]| Some((place(a)?, place(b)?));
    let excluded = mj.excluded.iter().filter_map(pair).collect();
    let (mut links, mut sites, mut joints) = (Vec::new(), Vec::new(), 0);
    for (link, b) in mj.bodies.into_iter().enumerate() {
        let inertial = b.inertial.unwrap_or_default();
        let first = joints;
        joints += b.joints.len();
        links.push(Link {
            name: b.name,
            parent: b.parent,
            parent_from_link: b.parent_from_body,
            mass_kg: inertial.mass_kg,
            com_m: inertial.com_m,
            inertia_kgm2: inertial.inertia_kgm2,
            joints: (first..joints).collect(),
            geoms: b.geoms.into_iter().map(|painted| painted.geom).collect(),
        });
        sites.extend(b.sites.into_iter().map(|(name, link_from_site)| Site {
            name,
            link,
            link_from_site,
        }));
    }
    (links, sites, mj.world_geoms, excluded)
}

/// The feet; also gives every geom on a link the friction of the robot file.
pub(crate) fn feet(
    c: &Checker<'_>,
    file: &RobotFile,
    links: &mut [Link],
) -> Result<Vec<Foot>, ModelError> {
    for geom in links.iter_mut().flat_map(|l| &mut l.geoms) {
        geom.friction = file.contact.body_friction;
    }
    let mut out: Vec<Foot> = Vec::new();
    for entry in &file.feet {
        let at = format!("feet.{}", entry.name);
        let names = match (&entry.geom, &entry.geoms) {
            (Some(geom), None) => std::slice::from_ref(geom),
            (None, Some(geoms)) if !geoms.is_empty() => geoms,
            _ => return c.refuse(at, "needs `geom`, or `geoms` with a list of shapes"),
        };
        let foot = foot(c, at.clone(), names, links)?;
        let again = |f: &Foot| f.name == entry.name || f.shares_a_shape(&foot);
        if out.iter().any(again) {
            return c.refuse(at, "is listed twice");
        }
        for &geom in &foot.geoms {
            links[foot.link].geoms[geom].friction = file.contact.foot_friction;
        }
        out.push(Foot { name: entry.name.clone(), ..foot });
    }
    Ok(out)
}

/// The foot that these shapes make up, without its name.
fn foot(c: &Checker<'_>, at: String, names: &[String], links: &[Link]) -> Result<Foot, ModelError> {
    let place = |name: &String| {
        let on = |link: &Link| link.geoms.iter().position(|g| g.name.as_ref() == Some(name));
        let mut links = links.iter().enumerate();
        links.find_map(|(l, link)| Some((l, on(link)?)))
    };
    let mut out = Foot::default();
    for name in names {
        let Some((link, geom)) = place(name) else {
            return c.refuse(at, format!("there is no geom `{name}` on a link"));
        };
        if !out.geoms.is_empty() && link != out.link {
            return c.refuse(at, format!("geom `{name}` is on another link than the first"));
        }
        let g = &links[link].geoms[geom];
        let Some((balls, radius_m)) = g.shape.balls() else {
            let message = format!("geom `{name}` is no ball, box, capsule or cylinder");
            return c.refuse(at, message);
        };
        if !g.collides() {
            let message = format!("geom `{name}` touches nothing (contype, conaffinity)");
            return c.refuse(at, message);
        }
        if out.geoms.contains(&geom) {
            return c.refuse(at, "is listed twice");
        }
        out.link = link;
        out.geoms.push(geom);
        let share = 1.0 / names.len() as f64;
        for (sum, pos) in out.centre_m.iter_mut().zip(g.link_from_geom.pos_m) {
            *sum += share * pos;
        }
        out.balls.extend(
            balls.into_iter().map(|at| Ball { centre_m: g.link_from_geom.point(at), radius_m }),
        );
    }
    Ok(out)
}

/// Water parameters with one drag scale per link: each link belongs to exactly one group, where there are any.
pub(crate) fn water(
    c: &Checker<'_>,
    file: &RobotFile,
    links: &[Link],
) -> Result<Option<WaterParams>, ModelError> {
    let Some(w) = &file.water else { return Ok(None) };
    for (group, g) in &w.drag {
        for name in &g.links {
            if !links.iter().any(|l| &l.name == name) {
                return c.refuse(
                    format!("water.drag.{group}.links"),
                    format!("there is no body `{name}` in the MJCF"),
                );
            }
        }
    }
    let mut drag = Vec::with_capacity(links.len());
    let mut added = Vec::with_capacity(links.len());
    if w.drag.is_empty() {
        drag.resize(links.len(), DragScale::default());
        added.resize(links.len(), AddedShare::default());
    }
    for link in links.iter().filter(|_| !w.drag.is_empty()) {
        let mut groups = w.drag.values().filter(|g| g.links.contains(&link.name));
        let (Some(one), None) = (groups.next(), groups.next()) else {
            return c.refuse(
                "water.drag",
                format!("link `{}` must be in exactly one group", link.name),
            );
        };
        drag.push(one.scale.clone());
        added.push(one.added.clone());
    }
    Ok(Some(WaterParams {
        density_kg_per_m3: w.density_kg_per_m3,
        viscosity_pa_s: w.viscosity_pa_s,
        buoyancy_ratio: w.buoyancy_ratio,
        heave_damping_ns_per_m: w.heave_damping_ns_per_m,
        drag,
        added,
    }))
}
