//! What the robot file says of a joint by the joint's own name or by that of a group it is in.

use std::collections::BTreeMap;

use crate::error::ModelError;
use crate::robot_file::{Checker, RobotFile};

/// The entry for `joint`: its own, else that of the group it is in.
pub(crate) fn find<'a, T>(
    table: &'a BTreeMap<String, T>,
    joint: &str,
    file: &RobotFile,
) -> Option<(&'a str, &'a T)> {
    let own = table.get_key_value(joint);
    let by_group = || {
        let groups = &file.joints.groups;
        let has = |name: &String| groups.get(name).is_some_and(|g| g.iter().any(|j| j == joint));
        table.iter().find(|(name, _)| has(name))
    };
    own.or_else(by_group).map(|(key, value)| (key.as_str(), value))
}

/// Refuses keys that are neither actuated joints nor groups, and a joint that two of the groups share.
pub(crate) fn known<'a>(
    c: &Checker<'_>,
    at: &str,
    keys: impl Iterator<Item = &'a String>,
    file: &RobotFile,
) -> Result<(), ModelError> {
    let mut by_group: BTreeMap<&str, &str> = BTreeMap::new();
    for key in keys {
        if file.joints.actuated.contains(key) {
            continue;
        }
        let Some(group) = file.joints.groups.get(key) else {
            return c.refuse(
                at,
                format!("`{key}` is not an actuated joint, nor a group of [joints.groups]"),
            );
        };
        for joint in group {
            if let Some(other) = by_group.insert(joint, key) {
                let both =
                    format!("`{joint}` is in the groups `{other}` and `{key}`; name it by itself");
                return c.refuse(at, both);
            }
        }
    }
    Ok(())
}

/// Refuses a group that names what is not an actuated joint, or is called like a joint.
pub(crate) fn check_groups(c: &Checker<'_>, file: &RobotFile) -> Result<(), ModelError> {
    let actuated = &file.joints.actuated;
    for (name, group) in &file.joints.groups {
        let at = format!("joints.groups.{name}");
        if actuated.contains(name) {
            return c.refuse(at, "has the name of a joint");
        }
        if let Some(other) = group.iter().find(|j| !actuated.contains(j)) {
            return c.refuse(at, format!("`{other}` is not an actuated joint"));
        }
    }
    Ok(())
}
