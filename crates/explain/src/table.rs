//! The table of mistakes that a key of the configuration can make: which keys, from when on, what a robot does
//! then. Whatever else differs from the reference is suspect a little.
//!
//! Values are compared with those that are known to train such a robot ([`Run::reference`]), so that the same
//! rows hold for a robot of 2 kg and one of 15. To add a mistake, add a row.

use crate::behaviour::{Behaviour, Sign};
use crate::run::{Run, assignment, numbers};
use crate::suspect::{Edit, Suspect};

/// When a value is wrong. Factors are on the reference's value; what is below `floor` counts as `floor`.
#[derive(Clone, Copy, Debug)]
enum Wrong {
    /// From so many times the reference on.
    Larger(f64, f64),
    /// From so many times less on.
    Smaller(f64, f64),
    /// Either.
    Off(f64, f64),
    /// The lower end of a range, from so many times on.
    LowerEnd(f64, f64),
    /// The upper end of a range, from so many times less on.
    UpperEnd(f64, f64),
    /// A discount whose horizon 1/(1 − γ) is so many times shorter.
    Horizon(f64),
    /// Any difference, so suspect.
    Differs(f64),
}

use Sign::{Belly, Falls, FewerLegs, IgnoresCommand, OtherWay, Slow, StandsStill, Turns, Vibrates};
use Wrong::{Differs, Horizon, Larger, LowerEnd, Off, Smaller, UpperEnd};

/// Id, keys that are put back together, when, what a robot does then, what is wrong.
type Row = (&'static str, &'static [&'static str], Wrong, &'static [Sign], &'static str);

/// Suspicion of a difference that no row knows.
const UNKNOWN: f64 = 0.3;
/// What no value is more suspect than.
const MOST: f64 = 4.0;
/// Lists that [`crate::terms`] and [`crate::observation`] look into.
const ELSEWHERE: [&str; 3] = ["task.reward.term", "task.termination.when", "task.observation.term"];

#[rustfmt::skip]
const ROWS: &[Row] = &[
    // what pays
    ("tracking_pays_nothing", &["task.reward.weights.tracking_lin_vel"], Smaller(3.0, 0.02), &[StandsStill, IgnoresCommand], "following the commanded velocity pays next to nothing"),
    ("tracking_too_wide", &["task.reward.lin_vel_sigma"], Larger(3.0, 1e-4), &[StandsStill, Slow], "the reward for velocity is so wide that standing still earns nearly all of it"),
    ("tracking_too_narrow", &["task.reward.lin_vel_sigma"], Smaller(6.0, 1e-6), &[StandsStill], "the reward for velocity is so narrow that nothing draws a robot that stands"),
    ("yaw_pays_most", &["task.reward.weights.tracking_yaw_rate"], Larger(6.0, 0.05), &[StandsStill, Turns], "following the yaw rate pays more than going anywhere"),
    ("yaw_pays_nothing", &["task.reward.weights.tracking_yaw_rate"], Smaller(5.0, 0.01), &[Turns], "following the yaw rate pays nothing, so it need not go straight"),
    ("yaw_width", &["task.reward.yaw_rate_sigma"], Off(8.0, 1e-6), &[Turns], "the reward for the yaw rate is too wide or too narrow to follow it"),
    ("phase_pays_most", &["task.reward.weights.phase"], Larger(5.0, 0.1), &[StandsStill, Slow], "lifting feet with the clock pays more than going anywhere"),
    ("phase_pays_nothing", &["task.reward.weights.phase"], Smaller(4.0, 0.02), &[Vibrates, Belly, FewerLegs, StandsStill], "lifting feet pays too little, so it shuffles or vibrates"),
    ("phase_too_narrow", &["task.reward.phase_sigma"], Smaller(6.0, 1e-7), &[StandsStill, FewerLegs], "the reward for lifting feet is too narrow to be found"),
    ("phase_too_wide", &["task.reward.phase_sigma"], Larger(8.0, 1e-5), &[Vibrates, FewerLegs], "the reward for lifting feet is earned without lifting them"),
    ("power_costs", &["task.reward.weights.power"], Larger(4.0, 1e-5), &[StandsStill, Slow], "motor power costs so much that moving does not pay"),
    ("action_rate_costs", &["task.reward.weights.action_rate"], Larger(5.0, 0.02), &[StandsStill, Slow], "changes of the action cost so much that moving does not pay"),
    ("torque_costs", &["task.reward.weights.torque"], Larger(5.0, 2e-4), &[StandsStill, Belly, Falls], "torque costs so much that neither standing nor walking pays"),
    ("acceleration_costs", &["task.reward.weights.joint_acceleration"], Larger(5.0, 1e-7), &[StandsStill, Slow], "joint accelerations cost so much that moving does not pay"),
    ("limits_cost", &["task.reward.weights.joint_limits"], Larger(8.0, 5.0), &[StandsStill], "being near a joint's limit costs so much that moving does not pay"),
    ("target_limits_cost", &["task.reward.weights.target_limits"], Larger(8.0, 0.6), &[StandsStill], "targets beyond the limits cost so much that moving does not pay"),
    ("slip_costs", &["task.reward.weights.slip"], Larger(5.0, 0.2), &[StandsStill, Slow], "feet that slip cost so much that moving does not pay"),
    ("orientation_costs", &["task.reward.weights.orientation"], Larger(12.0, 0.5), &[StandsStill, Slow], "leaning costs so much that no step pays"),
    ("trunk_costs", &["task.reward.weights.trunk_contact"], Smaller(8.0, 0.1), &[Belly], "lying on the belly costs nothing"),
    ("vertical_costs", &["task.reward.weights.vertical_velocity"], Larger(6.0, 1.0), &[StandsStill, Slow], "going up and down costs so much that no step pays"),
    ("rocking_costs", &["task.reward.weights.rocking"], Larger(5.0, 0.05), &[StandsStill, Slow], "rocking costs so much that no step pays"),
    ("stand_still_costs", &["task.reward.weights.stand_still"], Larger(8.0, 0.5), &[StandsStill], "leaving the pose costs so much that moving does not pay"),
    ("bend_costs", &["task.reward.weights.bend"], Larger(8.0, 0.5), &[StandsStill, Slow], "bending the body costs so much that moving does not pay"),
    ("costs_come_late", &["task.reward.costs_at_start", "task.reward.costs_full_after_env_steps"], Off(20.0, 0.05), &[StandsStill, Vibrates], "costs come in too early or too late"),
    ("contact_threshold", &["task.reward.contact_force_n"], Off(8.0, 0.05), &[], "what counts as a foot on the ground is not what it weighs on it"),
    // what is asked
    ("command_impossible", &["task.command.vx_mps", "evaluation.command_mps"], Larger(1.9, 0.01), &[StandsStill, Falls, Slow, IgnoresCommand], "it is asked for speeds that such a robot cannot reach"),
    ("command_tiny", &["task.command.vx_mps"], Smaller(3.0, 0.01), &[StandsStill, Slow, IgnoresCommand], "it is hardly ever asked to go forward"),
    ("command_sideways", &["task.command.vy_mps"], Larger(5.0, 0.02), &[StandsStill, OtherWay, IgnoresCommand], "it is asked to go sideways faster than such a robot can"),
    ("command_turns", &["task.command.yaw_rate_radps"], Larger(4.0, 0.2), &[StandsStill, Turns], "it is asked to turn faster than such a robot can"),
    ("command_changes", &["task.command.resample_s"], Smaller(8.0, 0.01), &[StandsStill, IgnoresCommand], "commands change faster than it can follow"),
    ("command_stand", &["task.command.zero_share"], Larger(8.0, 0.05), &[StandsStill], "it is nearly always asked to stand"),
    ("clock_stopped", &["task.phase.stand_command_norm"], Larger(8.0, 0.01), &[StandsStill, FewerLegs], "the gait clock stands still for commands that ask it to walk"),
    ("clock_rate", &["task.phase.frequency_hz"], Off(2.0, 0.1), &[StandsStill, Vibrates, Slow], "the gait clock is too fast or too slow for its legs"),
    ("clock_pattern", &["task.phase.pattern"], Differs(0.7), &[FewerLegs, Falls], "the gait clock asks for another gait"),
    ("swing_height", &["task.phase.swing_height_m"], Off(2.2, 0.003), &[StandsStill, Falls, FewerLegs], "the feet are asked to a height that they cannot reach, or none"),
    // when an episode ends
    ("tilt_limit", &["task.termination.max_tilt_rad"], Smaller(2.5, 0.01), &[Falls, StandsStill], "episodes end at a lean that every step has"),
    ("height_lowest", &["task.termination.com_height_m"], LowerEnd(1.35, 0.02), &[Falls], "episodes end at a height that it stands at"),
    ("height_highest", &["task.termination.com_height_m"], UpperEnd(2.0, 0.02), &[Falls], "episodes end at a height that it stands at"),
    ("episode_short", &["task.episode_steps"], Smaller(8.0, 1.0), &[StandsStill], "episodes are over before a stride is"),
    // what an action does
    ("action_scale", &["task.action.scale"], Off(3.0, 0.01), &[StandsStill, Vibrates, Falls], "an action moves the joints too little, or too much"),
    ("action_clip", &["task.action.clip"], Smaller(6.0, 1e-3), &[StandsStill, Slow], "actions are cut off before they move anything"),
    ("action_filter", &["task.action.filter_alpha"], Smaller(4.0, 1e-4), &[StandsStill, Slow, Falls], "the action filter is so slow that no step comes through"),
    ("action_unfiltered", &["task.action.filter_alpha"], Larger(4.0, 1e-3), &[Vibrates, StandsStill], "the action filter lets vibration through, which is found before steps are"),
    ("control_period", &["task.control_period_s"], Off(2.0, 1e-4), &[], "the control period is not what the filter and the clock were made for"),
    // which robot it is trained on
    ("delay", &["task.randomisation.command_delay_s"], Larger(4.0, 0.005), &[Falls, Vibrates, StandsStill], "commands reach the servos too late"),
    ("weak_gains", &["task.randomisation.kp_scale"], Off(2.0, 0.01), &[Belly, StandsStill, Falls], "the servos' gains are trained far from the robot's"),
    ("stiff_damping", &["task.randomisation.kd_scale", "task.randomisation.damping_scale"], Larger(5.0, 0.1), &[StandsStill, Slow], "the joints are trained with far more damping than the robot has"),
    ("weak_torque", &["task.randomisation.torque_scale"], Smaller(1.8, 0.01), &[Belly, StandsStill, Falls], "the servos are trained far weaker than they are"),
    ("weak_supply", &["task.randomisation.supply_scale"], Smaller(1.6, 0.01), &[Belly, StandsStill, Slow], "the supply voltage is trained far below the robot's"),
    ("mass", &["task.randomisation.total_mass_scale", "task.randomisation.link_mass_scale"], Off(1.7, 0.05), &[Belly, StandsStill, Falls], "the robot is trained far heavier or lighter than it is"),
    ("centre_of_mass", &["task.randomisation.com_offset_m"], Larger(6.0, 0.003), &[Falls, Turns], "the centre of mass is trained far from where it is"),
    ("no_grip", &["task.randomisation.foot_friction_scale"], Smaller(2.5, 0.01), &[StandsStill, Slow, Falls], "the feet are trained without grip"),
    ("joint_friction", &["task.randomisation.joint_friction_scale", "task.randomisation.armature_scale"], Larger(4.0, 0.1), &[StandsStill, Slow], "the joints are trained with far more friction or inertia than the robot has"),
    ("play", &["task.randomisation.backlash_scale"], Larger(6.0, 0.1), &[Falls, Turns], "the play of joints is trained far larger than it is"),
    ("failed_servos", &["task.randomisation.limp_share", "task.randomisation.stuck_share"], Larger(4.0, 0.05), &[StandsStill, FewerLegs, Slow], "most episodes are trained with a failed servo"),
    ("pushes", &["task.push.force_n", "task.push.interval_s", "task.push.duration_s", "task.push.full_after_env_steps"], Off(5.0, 0.1), &[Falls, StandsStill], "pushes come so hard or so often that nothing else is learnt"),
    ("start_pose", &["task.reset.joint_pos_noise_rad"], Larger(4.0, 0.1), &[Falls, Belly], "episodes start too far from the pose"),
    ("start_speed", &["task.reset.base_vel_noise_mps", "task.reset.joint_vel_noise_radps"], Larger(8.0, 0.1), &[Falls], "episodes start with a throw"),
    ("start_fallen", &["task.reset.fallen_share", "task.reset.swimming_pose_share"], Larger(4.0, 0.05), &[Falls, Belly], "most episodes start fallen"),
    ("ground", &["terrain.kind"], Differs(0.9), &[Falls, Slow, StandsStill], "the ground is harder than what such a robot first learns on"),
    // what it sees
    ("joint_vel_noise", &["task.noise.joint_vel_std_radps"], Larger(10.0, 0.1), &[StandsStill, Vibrates], "joint velocities drown in noise"),
    ("joint_pos_noise", &["task.noise.joint_pos_std_rad", "task.noise.joint_offset_std_rad"], Larger(10.0, 0.01), &[StandsStill, Falls], "joint positions drown in noise"),
    ("gyro_noise", &["task.noise.gyro_std_radps"], Larger(12.0, 0.05), &[Falls, Turns], "the angular velocity drowns in noise"),
    ("gravity_noise", &["task.noise.gravity_std"], Larger(10.0, 0.02), &[Falls, Turns], "the direction of gravity drowns in noise"),
    ("observation_clip", &["learner.network.observation_clip"], Smaller(5.0, 1e-3), &[StandsStill, IgnoresCommand], "observations are cut off before they say anything"),
    ("observations_unscaled", &["learner.network.normalise_observations"], Differs(0.9), &[StandsStill, IgnoresCommand], "observations go into the network as they are, large and small"),
    // how it learns
    ("learning_rate", &["learner.ppo.learning_rate", "learner.ppo.learning_rate_min", "learner.ppo.learning_rate_max", "learner.ppo.target_kl", "learner.ppo.target_kl_final"], Off(12.0, 1e-7), &[StandsStill, Falls], "the learning rate is far from what learns"),
    ("value_rate", &["learner.ppo.value_learning_rate", "learner.ppo.value_loss_weight"], Off(15.0, 1e-6), &[StandsStill], "the critic hardly learns, or runs away"),
    ("discount", &["learner.ppo.gamma"], Horizon(4.0), &[StandsStill, Falls], "the discount does not look a step ahead"),
    ("entropy", &["learner.ppo.entropy_weight"], Larger(5.0, 0.005), &[Vibrates, Falls, StandsStill], "noise pays more than anything that it could do"),
    ("clip", &["learner.ppo.clip"], Smaller(8.0, 1e-4), &[StandsStill], "updates are cut off before they change anything"),
    ("gradient", &["learner.ppo.max_grad_norm"], Smaller(30.0, 1e-6), &[StandsStill], "gradients are cut off before they change anything"),
    ("exploration", &["learner.network.init_std", "learner.network.std_max"], Off(3.0, 0.01), &[StandsStill, Vibrates], "the action noise explores too little, or drowns what is learnt"),
    ("least_noise", &["learner.network.std_min"], Larger(5.0, 0.02), &[Vibrates], "the action noise may never fall"),
    ("network", &["learner.network.policy_hidden", "learner.network.value_hidden"], Smaller(8.0, 1.0), &[StandsStill], "the network is too small"),
    ("batch", &["actors.lanes", "actors.chunk_steps", "actors.count"], Smaller(5.0, 1.0), &[StandsStill], "a batch holds too few samples"),
    ("epochs", &["learner.ppo.epochs", "learner.ppo.minibatches"], Off(6.0, 1.0), &[StandsStill], "a batch is gone over far too often, or hardly"),
];

/// How suspect a value is beside the reference's; 1 from the row's factor on.
fn suspicion(wrong: Wrong, value: &[f64], reference: &[f64]) -> f64 {
    let mean = |v: &[f64]| v.iter().map(|x| x.abs()).sum::<f64>() / v.len().max(1) as f64;
    let factor = |value: f64, reference: f64, from: f64, floor: f64| {
        (value.max(floor) / reference.max(floor)).ln() / from.ln()
    };
    let end = |v: &[f64], last: bool| match last {
        true => v.last().copied().unwrap_or(0.0),
        false => v.first().copied().unwrap_or(0.0),
    };
    let (is, was) = (mean(value), mean(reference));
    let found = match wrong {
        Larger(from, floor) => factor(is, was, from, floor),
        Smaller(from, floor) => -factor(is, was, from, floor),
        Off(from, floor) => factor(is, was, from, floor).abs(),
        LowerEnd(from, floor) => factor(end(value, false), end(reference, false), from, floor),
        UpperEnd(from, floor) => -factor(end(value, true), end(reference, true), from, floor),
        Horizon(from) => factor(1.0 - is, 1.0 - was, from, 1e-4),
        Differs(how) => how,
    };
    found.clamp(0.0, MOST)
}

/// What differs from the reference, by the table.
pub fn suspects(run: &Run, behaviour: &Behaviour) -> Vec<Suspect> {
    let differences = run.differences();
    let mut all: Vec<Suspect> = Vec::new();
    for (key, value, reference) in &differences {
        if ELSEWHERE.contains(&key.as_str()) {
            continue;
        }
        let rows = ROWS.iter().filter(|row| row.1.contains(&key.as_str()));
        let found = rows.map(|row| (suspicion(row.2, &numbers(value), &numbers(reference)), *row));
        let worst = found.max_by(|a, b| a.0.total_cmp(&b.0));
        let worst = worst.filter(|(suspicion, _)| *suspicion > UNKNOWN);
        let put_back = |key: &str| {
            let of = differences.iter().find(|(name, _, _)| name == key);
            of.map(|(_, _, reference)| assignment(key, reference))
        };
        let suspect = match worst {
            Some((suspicion, (id, keys, _, leads, says))) => Suspect {
                id,
                keys: keys
                    .iter()
                    .filter(|key| put_back(key).is_some())
                    .map(|key| (*key).to_owned())
                    .collect(),
                says: says.to_owned(),
                edit: Edit::Set(keys.iter().filter_map(|key| put_back(key)).collect()),
                suspicion,
            }
            .seen_in(leads, behaviour),
            None => Suspect {
                id: "other_value",
                keys: vec![key.clone()],
                says: format!("{key} is {value}, where {reference} is known to work"),
                edit: Edit::Set(vec![assignment(key, reference)]),
                suspicion: UNKNOWN,
            },
        };
        // keys that go back together are one suspect, as suspect as the worst of them
        match all.iter_mut().find(|other| other.id == suspect.id && suspect.id != "other_value") {
            Some(other) => other.suspicion = other.suspicion.max(suspect.suspicion),
            None => all.push(suspect),
        }
    }
    all
}

/// What no difference from the reference shows: a robot that vibrates on its feet, because a step earns it less
/// than it costs.
pub fn shuffles(run: &Run, behaviour: &Behaviour) -> Option<Suspect> {
    let key = "task.reward.weights.phase";
    let [weight, known] = [&run.config, &run.reference].map(|c| c.task.reward.weights.phase);
    // where the reference pays more or far less, that is suspect already
    let as_known = weight > 0.0 && (known..=2.0 * known).contains(&weight);
    let paid = as_known && !run.config.terrain.is_deep_water();
    (paid && behaviour.signs.contains(&Vibrates)).then(|| Suspect {
        id: "steps_do_not_pay",
        keys: vec![key.to_owned()],
        says: "lifting feet earns less than it costs, so it shuffles".to_owned(),
        edit: Edit::Set(vec![assignment(key, &format!("{}", 3.0 * weight))]),
        suspicion: 1.0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_config::{Config, Source};

    #[test]
    fn suspicion_is_one_at_the_factor_of_the_row() {
        let of = |wrong, value: f64, reference: f64| suspicion(wrong, &[value], &[reference]);
        assert_eq!(of(Larger(4.0, 1e-5), -0.08, -0.02), 1.0);
        assert_eq!(of(Larger(4.0, 1e-5), -0.005, -0.02), 0.0);
        assert!(of(Smaller(3.0, 0.02), 0.0, 3.0) > 3.9); // 3/0.02 = 150 times less, at most 4
        // a horizon of 2.5 steps instead of 33: 13.3 times shorter
        assert!((of(Horizon(4.0), 0.6, 0.97) - 13.33f64.ln() / 4f64.ln()).abs() < 1e-3);
        assert_eq!(of(LowerEnd(1.35, 0.02), 0.02, -0.1), 0.0);
    }

    /// Rows that name a key which does not exist would never find anything.
    #[test]
    fn every_key_of_the_table_exists() {
        let known = Config::load(&Source::default()).unwrap().entries();
        for (id, keys, ..) in ROWS {
            for key in *keys {
                assert!(known.iter().any(|(name, _)| name == key), "{id}: {key}");
            }
        }
    }
}
