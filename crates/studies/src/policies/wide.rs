//! Plain wide randomisation: what one does who knows that the robot differs and not how.
//!
//! The ranges hold a robot with servos of half their torque, a lag of 50 ms, half or twice as much of what is
//! hardest to measure; what the model has no parameter for (play that the file does not have) they cannot
//! hold.

use caudata_config::Config;
use caudata_telemetry::{ExitCode, Failure};

/// Keys of `task.randomisation`, and their ranges at least: where the configuration's own reach further, they
/// stay.
const WIDE: [(&str, f64, f64); 15] = [
    ("foot_friction_scale", 0.4, 1.5),
    ("body_friction_scale", 0.4, 1.6),
    ("total_mass_scale", 0.8, 1.3),
    ("link_mass_scale", 0.8, 1.2),
    ("com_offset_m", -0.01, 0.01), // m
    ("joint_friction_scale", 0.0, 4.0),
    ("armature_scale", 0.5, 2.0),
    ("damping_scale", 0.3, 3.0),
    ("kp_scale", 0.5, 1.3),
    ("kd_scale", 0.5, 2.0),
    ("torque_scale", 0.5, 1.0),
    ("supply_scale", 0.75, 1.05),
    ("command_delay_s", 0.0, 0.05), // s
    ("backlash_scale", 0.0, 2.0),
    ("payload_kg", 0.0, 0.2), // kg
];

/// [`WIDE`] as keys, each as far as `config` reaches, if that is further.
pub fn keys(config: &Config) -> Result<Vec<String>, Failure> {
    let entries = config.entries();
    let mut set = vec!["task.randomisation.enabled=true".to_owned()];
    for (key, low, high) in WIDE {
        let key = format!("task.randomisation.{key}");
        let found = entries.iter().find(|(name, _)| *name == key);
        let range = found.and_then(|(_, range)| serde_json::from_str::<[f64; 2]>(range).ok());
        let [own_low, own_high] = range
            .ok_or_else(|| Failure::message(ExitCode::Internal, format!("{key} is not a range")))?;
        let (low, high) = (low.min(own_low), high.max(own_high));
        set.push(format!("{key}=[{low:?},{high:?}]"));
    }
    Ok(set)
}

#[cfg(test)]
mod tests {
    use caudata_config::ConfigArgs;

    use super::*;

    fn loaded(preset: &str, overrides: &[String]) -> Config {
        let flags = ConfigArgs {
            preset: Some(preset.into()),
            overrides: overrides.to_vec(),
            ..ConfigArgs::default()
        };
        flags.load().unwrap()
    }

    #[test]
    fn wide_ranges_are_keys_and_hold_those_of_the_presets() {
        for preset in caudata_config::PRESETS {
            let preset = preset.name;
            let narrow = loaded(preset, &[]);
            let wide = loaded(preset, &keys(&narrow).unwrap());
            let table = |config: &Config| serde_json::to_value(config.task.randomisation).unwrap();
            let (narrow, wide) = (table(&narrow), table(&wide));
            let mut ranges = 0;
            for (key, range) in narrow.as_object().unwrap() {
                let Some(range) = range.as_array() else { continue };
                ranges += 1;
                let end = |of: &serde_json::Value, i: usize| of[key][i].as_f64().unwrap();
                let held = end(&wide, 0) <= range[0].as_f64().unwrap()
                    && end(&wide, 1) >= range[1].as_f64().unwrap();
                assert!(held && wide[key] != narrow[key], "{preset} {key}");
                // A preset never reaches further than the ranges that are documented.
                let (_, low, high) = WIDE.iter().find(|(name, ..)| name == key).unwrap();
                let near = |i: usize, x: f64| (end(&wide, i) - x).abs() < 1e-6;
                assert!(near(0, *low) && near(1, *high), "{preset} {key}");
            }
            assert_eq!(ranges, WIDE.len());
        }
    }

    #[test]
    fn a_range_that_is_wider_already_stays() {
        let own = [
            "task.randomisation.kp_scale=[0.3,1.1]".to_owned(),
            "task.randomisation.enabled=false".to_owned(),
        ];
        let narrow = loaded("flat", &own);
        let mut all = own.to_vec();
        all.extend(keys(&narrow).unwrap());
        let wide = loaded("flat", &all).task.randomisation;
        assert_eq!(wide.kp_scale, [0.3, 1.3]);
        assert_eq!(wide.kd_scale, [0.5, 2.0]);
        assert!(wide.enabled);
    }
}
