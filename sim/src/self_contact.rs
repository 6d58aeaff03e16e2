//! Which parts of a robot may touch each other: legs with the trunk, and legs with other legs.
//!
//! The shapes are those that touch the ground. Legs are those of [`RobotModel::leg_of`]; trunk is the rest. A
//! leg never touches itself or the trunk link it hangs on: their shapes overlap at the hip by construction.

use caudata_model::RobotModel;

/// Foot of the leg that each link belongs to; `None`: trunk. `[L]`
pub(crate) fn legs(model: &RobotModel) -> Vec<Option<usize>> {
    (0..model.links().len()).map(|l| model.leg_of(l)).collect()
}

/// Legs that hang on each link, as foot indices. `[L]`
pub(crate) fn hanging_legs(model: &RobotModel, legs: &[Option<usize>]) -> Vec<Vec<usize>> {
    let mut all = vec![Vec::new(); legs.len()];
    for (link, leg) in legs.iter().enumerate() {
        if let (Some(leg), Some(parent)) = (leg, model.links()[link].parent)
            && legs[parent].is_none()
        {
            all[parent].push(*leg);
        }
    }
    all
}

/// Whether two links may touch: a leg, with another leg or with the trunk that it does not hang on.
pub(crate) fn may_meet(
    legs: &[Option<usize>],
    hanging: &[Vec<usize>],
    (a, b): (usize, usize),
) -> bool {
    match (legs[a], legs[b]) {
        (Some(one), Some(other)) => one != other,
        (Some(leg), None) => !hanging[b].contains(&leg),
        (None, Some(leg)) => !hanging[a].contains(&leg),
        (None, None) => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn polymander_has_four_legs_of_two_links() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
        let model = RobotModel::load(&file).unwrap();
        let legs = legs(&model);
        let of = |name: &str| legs[model.link_index(name).unwrap()];
        assert_eq!((of("FL_upper"), of("FL_lower")), (Some(0), Some(0)));
        assert_eq!((of("HR_upper"), of("HR_lower")), (Some(3), Some(3)));
        assert_eq!(legs.iter().filter(|l| l.is_none()).count(), 11);
        let hanging = hanging_legs(&model, &legs);
        let on = |name: &str| hanging[model.link_index(name).unwrap()].clone();
        assert_eq!((on("body_01"), on("body_03")), (vec![0, 1], vec![]));
    }
}
