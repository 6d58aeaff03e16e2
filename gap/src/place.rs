//! Where an effect acts: the whole robot, joints that share a value, one joint, one link, ….

use caudata_model::{JointKind, RobotModel};

/// What an effect can act on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Domain {
    /// The robot as a whole.
    Robot,
    /// Actuated joints: all alike, groups alike, or one.
    Joints,
    /// Links: one each.
    Links,
    /// All links alike (water).
    AllLinks,
    /// Play hinges: all alike, or one.
    Play,
    /// Feet: all alike, or one.
    Feet,
}

/// One place of an effect. Its items share the effect's parameters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// What the items are.
    pub domain: Domain,
    /// Joints (policy order), links, play hinges (their order) or feet.
    pub items: Vec<usize>,
    /// Their names; empty for the whole robot.
    pub names: Vec<String>,
}

impl Place {
    /// Joint `a` alone, policy order.
    pub fn of_joint(model: &RobotModel, a: usize) -> Self {
        let name = model.actuated_names()[a].to_owned();
        Self { domain: Domain::Joints, items: vec![a], names: vec![name] }
    }

    /// Does `change` to each item.
    pub fn each(&self, change: impl FnMut(usize)) {
        self.items.iter().copied().for_each(change);
    }

    /// `effect@name`, for people and for keys.
    pub fn label(&self, effect: &str) -> String {
        match self.names.as_slice() {
            [] => effect.to_owned(),
            [one] => format!("{effect}@{one}"),
            many => format!("{effect}@{}", many.join("+")),
        }
    }

    /// The place in `domain` with these names; all of it where there are none.
    pub fn named(model: &RobotModel, domain: Domain, names: &[String]) -> Option<Self> {
        let all = item_names(model, domain);
        let items = if names.is_empty() {
            (0..all.len()).collect()
        } else {
            names.iter().map(|n| all.iter().position(|a| a == n)).collect::<Option<Vec<_>>>()?
        };
        Some(Self { domain, items, names: names.to_vec() })
    }
}

fn item_names(model: &RobotModel, domain: Domain) -> Vec<String> {
    match domain {
        Domain::Robot => Vec::new(),
        Domain::Joints => model.actuated_names().into_iter().map(str::to_owned).collect(),
        Domain::Links | Domain::AllLinks => model.links().iter().map(|l| l.name.clone()).collect(),
        Domain::Play => model
            .joints()
            .iter()
            .filter(|j| j.kind == JointKind::Backlash)
            .map(|j| j.name.clone())
            .collect(),
        Domain::Feet => model.feet().iter().map(|f| f.name.clone()).collect(),
    }
}

/// All places in a domain of a robot, widest first.
pub fn places(model: &RobotModel, domain: Domain) -> Vec<Place> {
    let names = item_names(model, domain);
    let all = Place { domain, items: (0..names.len()).collect(), names: Vec::new() };
    let one = |i: usize| Place { domain, items: vec![i], names: vec![names[i].clone()] };
    match domain {
        Domain::Robot => vec![all],
        Domain::AllLinks if !names.is_empty() => vec![all],
        Domain::Links => (0..names.len()).map(one).collect(),
        Domain::Joints if names.len() == 1 => vec![one(0)],
        Domain::Joints => {
            let mut places = vec![all];
            places.extend(groups(&names).into_iter().map(|items| Place {
                domain,
                names: items.iter().map(|&i| names[i].clone()).collect(),
                items,
            }));
            places.extend((0..names.len()).map(one));
            places
        }
        Domain::Play | Domain::Feet if names.len() > 1 => {
            let mut places = vec![all];
            places.extend((0..names.len()).map(one));
            places
        }
        _ => (0..names.len()).map(one).collect(),
    }
}

/// Joints whose names differ only in numbers and in the leg they stand for, where there are at least two of
/// them and others as well.
fn groups(names: &[String]) -> Vec<Vec<usize>> {
    let stem = |name: &str| -> String {
        let leg = |part: &str| part.len() == 2 && part.chars().all(|c| c.is_ascii_uppercase());
        let number = |part: &str| part.chars().all(|c| c.is_ascii_digit());
        name.split('_').filter(|part| !leg(part) && !number(part)).collect::<Vec<_>>().join("_")
    };
    let mut groups: Vec<(String, Vec<usize>)> = Vec::new();
    for (i, name) in names.iter().enumerate() {
        let stem = stem(name);
        match groups.iter_mut().find(|(s, _)| *s == stem) {
            Some((_, items)) => items.push(i),
            None => groups.push((stem, vec![i])),
        }
    }
    groups
        .into_iter()
        .map(|(_, items)| items)
        .filter(|items| items.len() > 1 && items.len() < names.len())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_by_name() {
        let names: Vec<String> =
            ["spine_1", "spine_2", "FL_hip", "FR_hip", "FL_knee"].map(str::to_owned).to_vec();
        assert_eq!(groups(&names), [vec![0, 1], vec![2, 3]]);
        assert!(groups(&names[..2]).is_empty(), "all of them is no group");
    }
}
