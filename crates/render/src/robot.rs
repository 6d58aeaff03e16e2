//! The robot of a model as coloured shapes.

use caudata_model::{Link, Pose, RobotModel, Shape, has_shell};

use crate::error::RenderError;
use crate::scene::Item;

/// Trunk and tail, alternating so that joints can be seen; legs; feet; feet on the ground. Linear RGB.
const TRUNK: [[f64; 3]; 2] = [[0.72, 0.50, 0.06], [0.80, 0.60, 0.12]];
const LEG: [f64; 3] = [0.10, 0.20, 0.34];
const FOOT: [f64; 3] = [0.03, 0.03, 0.035];
const FOOT_DOWN: [f64; 3] = [0.65, 0.06, 0.03];

/// The shapes of `model` with its base at `world_from_base` and its joints at `joint_pos_rad` (`[J]`, model
/// order). A link shows its shells ([`has_shell`]) and feet; one without shells shows all
/// it has. `contacts` (one per foot, or empty) colours feet that stand on something red.
///
/// # Errors
/// [`RenderError::Model`] where the number of joints is wrong.
pub fn robot_items(
    model: &RobotModel,
    world_from_base: &Pose,
    joint_pos_rad: &[f64],
    contacts: &[bool],
) -> Result<Vec<Item>, RenderError> {
    let places = model.kinematics(world_from_base, joint_pos_rad)?;
    let mut items = Vec::new();
    for (l, (link, pose)) in model.links().iter().zip(&places.links).enumerate() {
        let has_shell = has_shell(&link.geoms);
        for (g, geom) in link.geoms.iter().enumerate() {
            let foot = model.foot_of(l, g);
            if has_shell && geom.collides() && foot.is_none() || geom.shape == Shape::Plane {
                continue;
            }
            let colour = match foot {
                Some(f) if contacts.get(f) == Some(&true) => FOOT_DOWN,
                Some(_) => FOOT,
                None => link_colour(model, l, link),
            };
            items.push(Item {
                shape: geom.shape,
                world_from_shape: pose.compose(&geom.link_from_geom),
                colour,
            });
        }
    }
    Ok(items)
}

/// Links from which a foot hangs, without passing a fork, are legs.
fn link_colour(model: &RobotModel, index: usize, link: &Link) -> [f64; 3] {
    let children = |l: usize| {
        model.links().iter().enumerate().filter(move |(_, c)| c.parent == Some(l)).map(|(i, _)| i)
    };
    let mut at = index;
    loop {
        if link.parent.is_some() && model.feet().iter().any(|f| f.link == at) {
            return LEG;
        }
        let mut below = children(at);
        match (below.next(), below.next()) {
            (Some(only), None) => at = only,
            _ => break,
        }
    }
    let mut depth = 0;
    let mut up = link.parent;
    while let Some(p) = up {
        depth += 1;
        up = model.links()[p].parent;
    }
    TRUNK[depth % 2]
}
