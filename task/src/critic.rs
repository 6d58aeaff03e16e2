//! What the value function sees besides the observation: quantities that only the simulation knows.
//!
//! The value function judges states while training runs in simulation, and nobody needs it afterwards. What it
//! knows of the true state makes its judgement less noisy; the policy and its file are as without it ("asymmetric
//! actor-critic", Pinto et al. 2018).

use serde::{Deserialize, Serialize};

use crate::expression::{Known, Names, Shape, Signal};
use crate::mirror::SignedPermutation;
use crate::observation::Truth;
use crate::{Mirror, TaskError};

/// Table `[task.critic]`: what the value function sees in training and the policy does not.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CriticConfig {
    /// Signals that only the simulation knows (`caudata task terms` lists them), such as `velocity`,
    /// `foot_force`, `push`. Default none: the value function sees what the policy sees. Costs a few
    /// microseconds per hundred steps; nothing of it is in the policy file.
    pub sees: Vec<String>,
}

impl CriticConfig {
    /// Checks every name.
    ///
    /// # Errors
    /// [`TaskError::Term`] names the first that is wrong.
    pub fn validate(&self) -> Result<(), TaskError> {
        for (at, name) in self.sees.iter().enumerate() {
            let wrong = |reason: &str| TaskError::term("task.critic.sees", name, reason.to_owned());
            match Signal::named(name) {
                None => return Err(wrong("is no signal; `caudata task terms` lists them")),
                Some(Signal::Step | Signal::InTail) => {
                    return Err(wrong("is the same in every state"));
                }
                Some(signal) if signal.info().known == Known::Sensed => {
                    return Err(wrong("is what the robot senses; an observation may have it"));
                }
                Some(_) if self.sees[..at].contains(name) => return Err(wrong("is named twice")),
                Some(_) => {}
            }
        }
        Ok(())
    }
}

/// The value function's view of one robot. E values.
#[derive(Clone, Debug, PartialEq)]
pub struct Critic {
    signals: Vec<Signal>,
    joints: usize,
    feet: usize,
}

impl Critic {
    /// For a robot with these joints and feet.
    ///
    /// # Errors
    /// As [`CriticConfig::validate`].
    pub fn new(config: &CriticConfig, names: Names<'_>) -> Result<Self, TaskError> {
        config.validate()?;
        Ok(Self {
            signals: config.sees.iter().filter_map(|n| Signal::named(n)).collect(),
            joints: names.joints.len(),
            feet: names.feet.len(),
        })
    }

    /// The names of what it sees, in order.
    pub fn names(&self) -> impl Iterator<Item = &'static str> {
        self.signals.iter().map(|signal| signal.info().name)
    }

    /// E.
    pub fn dim(&self) -> usize {
        self.signals.iter().map(|signal| self.width(*signal)).sum()
    }

    fn width(&self, signal: Signal) -> usize {
        match signal.info().shape {
            Shape::Scalar => 1,
            Shape::Three => 3,
            Shape::Joints => self.joints,
            Shape::Feet => self.feet,
        }
    }

    /// Writes the view `[E]`; 0 for what is not finite.
    pub fn write(&self, truth: &dyn Truth, out: &mut [f32]) {
        let values = self.signals.iter().flat_map(|signal| truth.simulated(*signal));
        for (out, value) in out.iter_mut().zip(values) {
            *out = if value.is_finite() { *value } else { 0.0 };
        }
    }

    /// How the view changes when left and right are exchanged, `[E]`.
    pub fn mirrored(&self, mirror: &Mirror) -> SignedPermutation {
        let none = SignedPermutation::identity(0);
        let views = self.signals.iter().map(|signal| image(*signal, mirror));
        views.fold(none, |all, view| all.followed_by(&view))
    }
}

/// How one signal is mirrored.
fn image(signal: Signal, mirror: &Mirror) -> SignedPermutation {
    let turned = |sign: &[f32]| SignedPermutation {
        sign: sign.to_vec(),
        ..SignedPermutation::identity(sign.len())
    };
    let moved = |source: &[usize]| SignedPermutation {
        source: source.to_vec(),
        ..SignedPermutation::identity(source.len())
    };
    match (signal, signal.info().shape) {
        (Signal::YawRate | Signal::OffCourse, _) => turned(&[-1.0]),
        // work does not change its sign in a mirror, angles and torques may
        (Signal::Power, _) => moved(&mirror.action.source),
        (_, Shape::Joints) => mirror.action.clone(),
        (_, Shape::Feet) => moved(&mirror.feet),
        // forward, left, up
        (_, Shape::Three) => turned(&[1.0, -1.0, 1.0]),
        (_, Shape::Scalar) => SignedPermutation::identity(1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_model::RobotModel;
    use std::path::Path;

    struct Numbers(Vec<f32>);

    impl Truth for Numbers {
        fn simulated(&self, signal: Signal) -> &[f32] {
            match signal.info().shape {
                Shape::Scalar => &self.0[..1],
                Shape::Three => &self.0[..3],
                Shape::Joints => &self.0[..16],
                Shape::Feet => &self.0[..4],
            }
        }
    }

    fn critic(sees: &[&str]) -> Result<Critic, TaskError> {
        let joints: Vec<String> = (0..16).map(|i| format!("j{i}")).collect();
        let feet = ["FL", "FR", "HL", "HR"].map(str::to_owned);
        let names = Names { joints: &joints, feet: &feet };
        let sees = sees.iter().map(|&name| name.to_owned()).collect();
        Critic::new(&CriticConfig { sees }, names)
    }

    #[test]
    fn a_view_and_its_mirror_image_by_hand() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
        let model = RobotModel::load(&file).unwrap();
        let feet: Vec<String> = model.feet().iter().map(|f| f.name.clone()).collect();
        let layout = crate::ObservationLayout::new(16, &feet, false);
        let mirror = Mirror::new(&model, &layout).unwrap();
        let critic = critic(&["velocity", "yaw_rate", "foot_force", "torque", "power"]).unwrap();
        assert_eq!(critic.dim(), 3 + 1 + 4 + 16 + 16);
        let numbers = (0..16).map(|i| i as f32 + 1.0).collect();
        let mut seen = vec![f32::NAN; critic.dim()];
        critic.write(&Numbers(numbers), &mut seen);
        assert_eq!(seen[..8], [1.0, 2.0, 3.0, 1.0, 1.0, 2.0, 3.0, 4.0]);
        let of = critic.mirrored(&mirror);
        let image = of.apply(&seen);
        // To the right, turning right, left and right feet exchanged.
        assert_eq!(image[..8], [1.0, -2.0, 3.0, -1.0, 2.0, 1.0, 4.0, 3.0]);
        // The spine's first joint turns the other way with as much power; FL_hip has what FR_hip had.
        assert_eq!((image[8], image[24]), (-1.0, 1.0));
        assert_eq!((image[8 + 8], image[24 + 8]), (11.0, 11.0));
        assert_eq!(of.apply(&image), seen);
    }

    #[test]
    fn wrong_names_are_refused_and_other_views_have_other_seals() {
        for (name, says) in
            [("speed", "is no signal"), ("dt", "same in every state"), ("gyro", "senses")]
        {
            let error = critic(&["height", name]).unwrap_err().to_string();
            assert!(error.contains(says), "{error}");
        }
        let error = critic(&["push", "push"]).unwrap_err().to_string();
        assert!(error.contains("twice"), "{error}");
    }

    #[test]
    fn what_is_not_finite_is_zero() {
        let critic = critic(&["height"]).unwrap();
        let mut seen = [1.0];
        critic.write(&Numbers(vec![f32::NAN]), &mut seen);
        assert_eq!(seen, [0.0]);
    }
}
