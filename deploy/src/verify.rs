//! Whether a policy may run on this robot: hash, strict reading, contract, a probe of inference.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_policy::{Inference, MlpSpec, PolicyError, PolicyFile, evaluate_mlp};
use caudata_proto::registry::{
    Freshness, LabelName, Manifest, NONCE_BYTES, SignedFreshness, StreamName,
};
use caudata_signing::{Stale, Trust, Untrusted};
use caudata_task::command::CommandConfig;
use caudata_task::{ObservationLayout, PolicyContract, TaskConfig, TaskError};
use sha2::{Digest, Sha256};

use crate::state::{Blame, PolicyRef, Sha256Digest};
use crate::steps::Step;

/// Observations that the probe evaluates.
pub const PROBE_COUNT: usize = 32;
/// Makes neighbouring probes start at unrelated fractions.
const PROBE_STRIDE: usize = 137;
/// How far ONNX Runtime and the plain evaluation may be apart, per unit of action (and of 1).
pub const PROBE_TOLERANCE: f32 = 1e-4;

/// A policy that passed every check, ready to run.
#[derive(Debug)]
pub struct Verified {
    /// Where it is from.
    pub policy: PolicyRef,
    /// What it says.
    pub file: PolicyFile,
    /// Loaded.
    pub inference: Inference,
    /// Whether it went through its trial on this robot before.
    pub proved: bool,
}

/// Why a policy must not run here.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// The bytes are others than announced.
    #[error("its bytes have SHA-256 {found}, announced was {expected}")]
    WrongHash {
        /// Hash of the bytes.
        found: Sha256Digest,
        /// Hash that was announced.
        expected: Sha256Digest,
    },
    /// The file, or what it says, does not fit.
    #[error("{0}")]
    Policy(#[from] PolicyError),
    /// What it was trained for is not what is here.
    #[error("{0}")]
    Contract(PolicyError),
    /// It asks for something that the task here does not allow.
    #[error("its contract is not one for this program: {0}")]
    Task(#[from] TaskError),
    /// The announcement does not fit this robot.
    #[error("it is for robot `{found}`, this is `{expected}`")]
    OtherRobot {
        /// Robot announced.
        found: String,
        /// Robot here.
        expected: String,
    },
    /// The announcement names another model of this robot.
    #[error("it was trained on model {found} of the robot, this one is {expected}")]
    OtherModel {
        /// Hash announced.
        found: Sha256Digest,
        /// Hash here.
        expected: Sha256Digest,
    },
    /// The file has another version than announced.
    #[error("the file says version {found}, announced was {expected}")]
    OtherVersion {
        /// Version in the file.
        found: u64,
        /// Version announced.
        expected: u64,
    },
    /// Inference does not do what the file says.
    #[error("probe {index}: {problem}")]
    Probe {
        /// Which observation.
        index: usize,
        /// What is wrong.
        problem: String,
    },
    /// Keys that this robot trusts did not sign it.
    #[error("{0}")]
    Untrusted(#[from] Untrusted),
    /// It brought down the child process that looked at it.
    #[error("the process that tried it died: {how}")]
    KilledItsProbe {
        /// How.
        how: String,
    },
    /// The child process that looked at it found something wrong.
    #[error("{0}")]
    ByItsProbe(String),
    /// The loop's own process does not take it, although it was tried before.
    #[error("the control loop refuses it: {0}")]
    ByTheLoop(String),
    /// Inference takes too long on this computer.
    #[error("half of its runs take more than {median_us} µs on this computer")]
    TooSlow {
        /// The median.
        median_us: u128,
    },
    /// It was begun with too often.
    #[error("it was begun with {attempts} times and never went through its trial")]
    TooManyAttempts {
        /// How often.
        attempts: u32,
    },
    /// An operator took it out of use.
    #[error("it is quarantined on the policy server: {0}")]
    Withdrawn(String),
    /// It was refused before.
    #[error("refused before: {0}")]
    Before(String),
    /// The server's newest is older than what the robot has.
    #[error("the server offers an older version than {have}, which this robot has")]
    Older {
        /// Version here.
        have: u64,
    },
}

impl Refusal {
    /// What is to blame, found on the robot model with hash `robot`: only what would be found everywhere else as well is
    /// the policy's own fault.
    pub fn blame(&self, robot: Sha256Digest) -> Blame {
        match self {
            Self::Contract(_)
            | Self::Task(_)
            | Self::OtherRobot { .. }
            | Self::OtherModel { .. }
            | Self::ByItsProbe(_)
            | Self::TooSlow { .. } => Blame::Robot(robot),
            Self::WrongHash { .. }
            | Self::OtherVersion { .. }
            | Self::Untrusted(_)
            | Self::Older { .. } => Blame::Transfer,
            Self::Policy(_)
            | Self::Probe { .. }
            | Self::KilledItsProbe { .. }
            | Self::ByTheLoop(_)
            | Self::TooManyAttempts { .. }
            | Self::Withdrawn(_)
            | Self::Before(_) => Blame::Policy,
        }
    }
}

/// Why [`verify`] gave no policy.
#[derive(Debug, thiserror::Error)]
pub enum VerifyError {
    /// The policy must not run.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// Nothing is wrong with the policy: ONNX Runtime is not there.
    #[error("{0}")]
    Runtime(PolicyError),
}

/// Refuses what is not for this robot before anything is downloaded.
///
/// # Errors
/// [`Refusal::OtherRobot`], [`Refusal::OtherModel`].
pub fn check_manifest(manifest: &Manifest, model: &RobotModel) -> Result<(), Refusal> {
    if Step::RobotName.on() && manifest.robot_name != model.name() {
        return Err(Refusal::OtherRobot {
            found: manifest.robot_name.clone(),
            expected: model.name().to_owned(),
        });
    }
    if Step::RobotModel.on() && manifest.robot_hash != model.hash() {
        return Err(Refusal::OtherModel {
            found: Sha256Digest(manifest.robot_hash),
            expected: Sha256Digest(model.hash()),
        });
    }
    Ok(())
}

/// Refuses what not enough keys of `trust` signed; without trusted keys nobody needs to sign.
///
/// # Errors
/// [`Refusal::Untrusted`].
pub fn check_signatures(manifest: &Manifest, trust: Option<&Trust>) -> Result<(), Refusal> {
    match trust {
        Some(trust) if Step::Signature.on() => Ok(trust.check(manifest)?),
        _ => Ok(()),
    }
}

/// Refuses an answer about where a label leads that a key of `trust` did not sign for exactly this question.
///
/// # Errors
/// [`Stale`].
pub fn check_fresh(
    trust: &Trust,
    answer: &SignedFreshness,
    nonce: &[u8; NONCE_BYTES],
    stream: &StreamName,
    label: &LabelName,
) -> Result<(), Stale> {
    match Step::Fresh.on() {
        true => trust.check_fresh(answer, nonce, stream, label),
        false => Ok(()),
    }
}

/// Refuses an announcement of something else than what the server proved.
///
/// # Errors
/// What is wrong.
pub fn check_proved(manifest: &Manifest, proved: &Freshness) -> Result<(), &'static str> {
    let same = manifest.sha256 == proved.sha256 && manifest.version == proved.version;
    match same || !Step::Proved.on() {
        true => Ok(()),
        false => Err("the server shows another version than it proved"),
    }
}

/// Checks the bytes of `policy` completely.
///
/// # Errors
/// [`VerifyError::Refused`] with the first thing that is wrong.
pub fn verify(
    bytes: Arc<[u8]>,
    policy: &PolicyRef,
    model: &RobotModel,
) -> Result<Verified, VerifyError> {
    let found = Sha256Digest(Sha256::digest(&bytes).into());
    if Step::Hash.on() && found != policy.sha256 {
        let expected = policy.sha256;
        return Err(Refusal::WrongHash { found, expected }.into());
    }
    let file = PolicyFile::parse(bytes).map_err(Refusal::from)?;
    if Step::Version.on() && file.metadata().version != policy.file_version() {
        return Err(Refusal::OtherVersion {
            found: file.metadata().version,
            expected: policy.file_version(),
        }
        .into());
    }
    let expected = expected_contract(model, &file.metadata().contract).map_err(Refusal::from)?;
    if Step::Contract.on() {
        file.check_contract(&expected).map_err(Refusal::Contract)?;
    }
    let mut inference = Inference::new(&file, 1).map_err(|error| match error {
        PolicyError::RuntimeNotFound { .. } | PolicyError::RuntimeLoad { .. } => {
            VerifyError::Runtime(error)
        }
        other => Refusal::from(other).into(),
    })?;
    probe(&file, &mut inference)?;
    Ok(Verified {
        policy: policy.clone(),
        file,
        inference,
        proved: false,
    })
}

/// The contract that a policy must have here: the robot file's values, and this program's observation and control rate.
/// Only what a policy chooses itself (meaning of actions, stride, trained commands) is taken from it, checked.
///
/// # Errors
/// [`TaskError`] where one of its choices is out of range.
pub fn expected_contract(
    model: &RobotModel,
    policy: &PolicyContract,
) -> Result<PolicyContract, TaskError> {
    let task = TaskConfig {
        action: policy.action,
        phase: policy.phase.config(),
        observe_medium: policy.observation
            == ObservationLayout::new(policy.act_dim(), &policy.phase.feet, true),
        command: CommandConfig {
            vx_mps: policy.command.vx_mps,
            vy_mps: policy.command.vy_mps,
            yaw_rate_radps: policy.command.yaw_rate_radps,
            ..CommandConfig::default()
        },
        ..TaskConfig::default()
    };
    PolicyContract::new(model, &task)
}

/// Runs a few observations through ONNX Runtime and through the plain evaluation.
fn probe(file: &PolicyFile, inference: &mut Inference) -> Result<(), Refusal> {
    let dim = file.spec().obs_dim();
    let mut obs = vec![0.0; dim];
    let act_dim = file.spec().act_dim();
    let (mut actions, mut expected) = (vec![0.0; act_dim], vec![0.0; act_dim]);
    for index in 0..PROBE_COUNT {
        probe_observation(index, file.spec(), &mut obs);
        inference.run(&obs, 1, &mut actions)?;
        evaluate_mlp(file.spec(), &obs, 1, &mut expected)?;
        for joint in 0..act_dim {
            let (found, reference) = (actions[joint], expected[joint]);
            let finite = found.is_finite() && reference.is_finite();
            let apart = (found - reference).abs() > PROBE_TOLERANCE * (1.0 + reference.abs());
            let problem = if Step::FiniteActions.on() && !finite {
                format!("action {joint} is not finite")
            } else if Step::SameActions.on() && apart {
                format!("action {joint} is {found}, worked out plainly it is {reference}")
            } else {
                continue;
            };
            return Err(Refusal::Probe { index, problem });
        }
    }
    Ok(())
}

/// Observation `index`: around the policy's mean observation, from 0 up to ±3 of its standard deviations, which is what it was
/// trained on; far outside, rounding alone may set two correct evaluations apart. The same on every machine.
fn probe_observation(index: usize, spec: &MlpSpec, obs: &mut [f32]) {
    let size = 3.0 * index as f32 / (PROBE_COUNT - 1) as f32;
    for (i, value) in obs.iter_mut().enumerate() {
        // Fractions of multiples of the golden ratio fill the interval evenly.
        let fraction = ((index * PROBE_STRIDE + i) as f32 * 0.618_034).fract();
        *value = spec.obs_mean[i] + spec.obs_std[i] * size * (2.0 * fraction - 1.0);
    }
}

#[cfg(test)]
mod tests;
