//! Whether a policy may run on this robot: hash, strict reading, contract, a probe of inference.

use std::cell::OnceCell;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_policy::{Inference, MlpSpec, PolicyError, PolicyFile, evaluate_mlp};
use caudata_proto::checks::Check;
use caudata_proto::registry::Manifest;
use caudata_proto::registry::question::{Facts, OtherQuestion};
use caudata_signing::{Trust, Untrusted};
use caudata_task::command::CommandConfig;
use caudata_task::layout::Part;
use caudata_task::observation::ObservationConfig;
use caudata_task::{PolicyContract, TaskConfig, TaskError};
use sha2::{Digest, Sha256};

use crate::state::{Blame, PolicyRef, Sha256Digest};

/// Observations that the probe evaluates.
pub const PROBE_COUNT: usize = 32;
/// Makes neighbouring probes start at unrelated fractions.
const PROBE_STRIDE: usize = 137;
/// How far ONNX Runtime and the plain evaluation may be apart, per unit of action (and of 1).
pub const PROBE_TOLERANCE: f32 = 1e-4;
/// Largest action, in its own unit, on observations like those of training: trained policies stay within some
/// tens, and this is many turns of a servo. What goes beyond would pin every joint at a limit.
pub const ACTION_MAX: f32 = 1e3;

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
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum Refusal {
    /// The bytes are others than announced.
    #[error("its bytes have SHA-256 {found}, announced was {expected}")]
    WrongHash { found: Sha256Digest, expected: Sha256Digest },
    /// The file, or what it says, does not fit.
    #[error("{0}")]
    Policy(#[from] PolicyError),
    /// What it was trained for is not what is here.
    #[error("{0}")]
    Contract(PolicyError),
    /// It asks for something that the task here does not allow.
    #[error("its contract is not one for this program: {0}")]
    Task(#[from] TaskError),
    /// It observes what this robot has no sensor for.
    #[error(
        "it observes whether the robot swims, and nothing on this robot tells: name a water sensor in the wiring file \
         (`[water] file`), or run a policy for land"
    )]
    CannotTell,
    /// The announcement is for another robot, or another model of this one.
    #[error("it is for another robot: {0}")]
    OtherRobot(OtherQuestion),
    /// The file has another version than announced.
    #[error("the file says version {found}, announced was {expected}")]
    OtherVersion { found: u64, expected: u64 },
    /// Inference does not do what the file says.
    #[error("probe {index}: {problem}")]
    Probe { index: usize, problem: String },
    /// Keys that this robot trusts did not sign it.
    #[error("{0}")]
    Untrusted(#[from] Untrusted),
    /// It brought down the child process that looked at it.
    #[error("the process that tried it died: {how}")]
    KilledItsProbe { how: String },
    /// The child process that looked at it found something wrong.
    #[error("{0}")]
    ByItsProbe(String),
    /// The loop's own process does not take it, although it was tried before.
    #[error("the control loop refuses it: {0}")]
    ByTheLoop(String),
    /// Inference takes too long on this computer.
    #[error("half of its runs take more than {median_us} µs on this computer")]
    TooSlow { median_us: u128 },
    /// It was begun with too often.
    #[error("it was begun with {attempts} times and never went through its trial")]
    TooManyAttempts { attempts: u32 },
    /// An operator took it out of use.
    #[error("it is quarantined on the policy server: {0}")]
    Withdrawn(String),
    /// It was refused before.
    #[error("refused before: {0}")]
    Before(String),
    /// The server's newest is older than what the robot has.
    #[error("the server offers an older version than {have}, which this robot has")]
    Older { have: u64 },
}

impl Refusal {
    /// What is to blame, found on the robot model with hash `robot`: only what would be found everywhere else
    /// as well is the policy's own fault.
    pub fn blame(&self, robot: Sha256Digest) -> Blame {
        match self {
            Self::Contract(_)
            | Self::Task(_)
            | Self::OtherRobot(_)
            | Self::CannotTell
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

/// An announcement, and the robot that is to take it.
#[derive(Clone, Copy, Debug)]
pub struct Announcement<'a> {
    /// What the server announces.
    pub manifest: &'a Manifest,
    /// Keys that must have signed it; `None`: nobody needs to.
    pub trust: Option<&'a Trust>,
    /// The robot.
    pub model: &'a RobotModel,
}

/// Looks at an announcement.
pub type AnnouncementCheck = fn(&Announcement<'_>) -> Result<(), Refusal>;

/// What an announcement must be before anything is downloaded. That it answers the question is looked at
/// before ([`caudata_proto::registry::question::ANSWERS`]).
pub const ANNOUNCEMENT: &[Check<AnnouncementCheck>] = &[
    // Trusted keys signed it.
    Check::new("signature", |found| match found.trust {
        Some(trust) => Ok(trust.check(found.manifest)?),
        None => Ok(()),
    }),
    // It is for this robot.
    Check::new("robot", |found| {
        let here = Facts { robot: Some(found.model.name()), ..Facts::default() };
        here.answered_by(found.manifest).map_err(Refusal::OtherRobot)
    }),
    // And for this model of it.
    Check::new("robot model", |found| {
        let hash = found.model.hash();
        let here = Facts { model: Some(&hash), ..Facts::default() };
        here.answered_by(found.manifest).map_err(Refusal::OtherRobot)
    }),
];

impl Announcement<'_> {
    /// Refuses what these checks find.
    ///
    /// # Errors
    /// [`Refusal::Untrusted`], [`Refusal::OtherRobot`].
    pub fn check(&self, checks: &[Check<AnnouncementCheck>]) -> Result<(), Refusal> {
        checks.iter().try_for_each(|check| (check.refuse)(self))
    }
}

/// The bytes of a policy, and what they turn out to be as far as somebody asked.
pub struct Candidate<'a> {
    policy: &'a PolicyRef,
    model: &'a RobotModel,
    bytes: Arc<[u8]>,
    file: OnceCell<PolicyFile>,
    tried: OnceCell<(Inference, Vec<Action>)>,
}

/// One action of the probe.
struct Action {
    index: usize,
    joint: usize,
    /// As ONNX Runtime has it.
    found: f32,
    /// Worked out plainly.
    reference: f32,
}

/// Looks at a candidate.
pub type CandidateCheck = fn(&Candidate<'_>) -> Result<(), VerifyError>;

/// What the bytes of a policy must be.
pub const CANDIDATE: &[Check<CandidateCheck>] = &[
    // The bytes are the announced ones.
    Check::new("hash", |candidate| {
        let found = Sha256Digest(Sha256::digest(&candidate.bytes).into());
        let expected = candidate.policy.sha256;
        match found == expected {
            true => Ok(()),
            false => Err(Refusal::WrongHash { found, expected }.into()),
        }
    }),
    // The file bears the announced version.
    Check::new("version", |candidate| {
        let found = candidate.file()?.metadata().version;
        let expected = candidate.policy.file_version();
        match found == expected {
            true => Ok(()),
            false => Err(Refusal::OtherVersion { found, expected }.into()),
        }
    }),
    // What the policy may not choose itself is as on this robot. (What it may choose is in range: reading the
    // file checks that.)
    Check::new("contract", |candidate| {
        let file = candidate.file()?;
        let expected = expected_contract(candidate.model, &file.metadata().contract);
        let expected = expected.map_err(Refusal::from)?;
        Ok(file.check_contract(&expected).map_err(Refusal::Contract)?)
    }),
    // Its actions are numbers that a servo can come near to.
    Check::new("actions in range", |candidate| {
        candidate.refuse_action(
            |a| !(a.found.abs() <= ACTION_MAX && a.reference.abs() <= ACTION_MAX),
            |a| format!("action {} is {:e}, beyond ±{ACTION_MAX}", a.joint, a.found),
        )
    }),
    // ONNX Runtime computes what the file says.
    Check::new("same actions", |candidate| {
        candidate.refuse_action(
            |a| {
                let apart = (a.found - a.reference).abs();
                apart > PROBE_TOLERANCE * (1.0 + a.reference.abs())
            },
            |a| {
                let (joint, found, reference) = (a.joint, a.found, a.reference);
                format!("action {joint} is {found}, worked out plainly it is {reference}")
            },
        )
    }),
];

/// Checks the bytes of `policy` completely.
///
/// # Errors
/// [`VerifyError::Refused`] with the first thing that is wrong.
pub fn verify(
    bytes: Arc<[u8]>,
    policy: &PolicyRef,
    model: &RobotModel,
) -> Result<Verified, VerifyError> {
    verify_by(CANDIDATE, bytes, policy, model)
}

/// [`verify`] by these checks.
fn verify_by(
    checks: &[Check<CandidateCheck>],
    bytes: Arc<[u8]>,
    policy: &PolicyRef,
    model: &RobotModel,
) -> Result<Verified, VerifyError> {
    let candidate =
        Candidate { policy, model, bytes, file: OnceCell::new(), tried: OnceCell::new() };
    checks.iter().try_for_each(|check| (check.refuse)(&candidate))?;
    let Candidate { bytes, file, tried, .. } = candidate;
    let file = file.into_inner().map_or_else(|| read(bytes), Ok)?;
    let (inference, _) = tried.into_inner().map_or_else(|| try_out(&file), Ok)?;
    Ok(Verified { policy: policy.clone(), file, inference, proved: false })
}

impl Candidate<'_> {
    /// What the bytes say, read when it is asked for first.
    fn file(&self) -> Result<&PolicyFile, VerifyError> {
        if let Some(file) = self.file.get() {
            return Ok(file);
        }
        let file = read(self.bytes.clone())?;
        Ok(self.file.get_or_init(|| file))
    }

    /// What it does on a few observations, in ONNX Runtime and worked out plainly; tried when it is asked for
    /// first.
    fn actions(&self) -> Result<&[Action], VerifyError> {
        if self.tried.get().is_none() {
            let _ = self.tried.set(try_out(self.file()?)?);
        }
        Ok(self.tried.get().map_or(&[], |(_, actions)| actions))
    }

    /// Refuses the first action of the probe that is `wrong`, in the words of `problem`.
    fn refuse_action(
        &self,
        wrong: impl Fn(&Action) -> bool,
        problem: impl Fn(&Action) -> String,
    ) -> Result<(), VerifyError> {
        match self.actions()?.iter().find(|action| wrong(action)) {
            Some(action) => {
                Err(Refusal::Probe { index: action.index, problem: problem(action) }.into())
            }
            None => Ok(()),
        }
    }
}

/// The contract that a policy must have here: the robot file's values, and this program's observation and
/// control rate. Only what a policy chooses itself (meaning of actions, stride, trained commands) is taken
/// from it, checked.
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
        observation: ObservationConfig::from(&policy.observation),
        observe_medium: !policy.observation.range(Part::Medium).is_empty(),
        afloat_above_m: policy.afloat_above_m.unwrap_or(TaskConfig::default().afloat_above_m),
        command: CommandConfig {
            vx_mps: policy.command.vx_mps,
            vy_mps: policy.command.vy_mps,
            yaw_rate_radps: policy.command.yaw_rate_radps,
            ..CommandConfig::default()
        },
        ..TaskConfig::default()
    };
    let mut expected = PolicyContract::new(model, &task)?;
    // which feet step together is the policy's business
    expected.phase.offsets_rad.clone_from(&policy.phase.offsets_rad);
    expected.observer()?.check_sensed(&expected.observation)?;
    Ok(expected)
}

fn read(bytes: Arc<[u8]>) -> Result<PolicyFile, VerifyError> {
    Ok(PolicyFile::parse(bytes).map_err(Refusal::from)?)
}

fn try_out(file: &PolicyFile) -> Result<(Inference, Vec<Action>), VerifyError> {
    let mut inference = Inference::new(file, 1).map_err(|error| match error {
        PolicyError::RuntimeNotFound { .. } | PolicyError::RuntimeLoad { .. } => {
            VerifyError::Runtime(error)
        }
        other => Refusal::from(other).into(),
    })?;
    let actions = probe(file.spec(), &mut inference).map_err(Refusal::from)?;
    Ok((inference, actions))
}

/// Runs a few observations through ONNX Runtime and through the plain evaluation.
fn probe(spec: &MlpSpec, inference: &mut Inference) -> Result<Vec<Action>, PolicyError> {
    let mut obs = vec![0.0; spec.obs_dim()];
    let act_dim = spec.act_dim();
    let (mut actions, mut expected) = (vec![0.0; act_dim], vec![0.0; act_dim]);
    let mut tried = Vec::with_capacity(PROBE_COUNT * act_dim);
    for index in 0..PROBE_COUNT {
        probe_observation(index, spec, &mut obs);
        inference.run(&obs, 1, &mut actions)?;
        evaluate_mlp(spec, &obs, 1, &mut expected)?;
        tried.extend((0..act_dim).map(|joint| Action {
            index,
            joint,
            found: actions[joint],
            reference: expected[joint],
        }));
    }
    Ok(tried)
}

/// Observation `index`: around the policy's mean observation, from 0 up to ±3 of its standard deviations,
/// which is what it was trained on; far outside, rounding alone may set two correct evaluations apart. The
/// same on every machine.
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
