//! Units at joints that slide, where the catalogue and the kinds of signals have those of hinges.

use caudata_model::RobotModel;

/// The SI unit at actuated joint `index` of what has `unit` at a hinge.
pub fn at_joint(model: &RobotModel, index: usize, unit: &'static str) -> &'static str {
    match model.joints()[model.actuated()[index]].unit() {
        "m" => at_slide(unit),
        _ => unit,
    }
}

fn at_slide(unit: &'static str) -> &'static str {
    match unit {
        "rad" => "m",
        "rad/s" => "m/s",
        "rad/s²" => "m/s²",
        "rad/(N·m)" => "m/N",
        "N·m" => "N",
        "N·m/rad" => "N/m",
        "N·m·s/rad" => "N·s/m",
        "N·m/(rad·s)" => "N/(m·s)",
        "kg·m²" => "kg",
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::ALL;

    #[test]
    fn a_slide_has_no_radians() {
        let of_joints = ALL.iter().flat_map(|e| e.parameters).map(|p| p.unit);
        for unit in of_joints {
            assert!(!at_slide(unit).contains("rad"), "{unit}");
        }
    }
}
