//! A policy file that was read and checked.

use std::sync::Arc;

use caudata_task::{ContractDifference, PolicyContract};
use sha2::{Digest, Sha256};

use crate::metadata::PolicyMetadata;
use crate::mlp::MlpSpec;
use crate::onnx::graph;
use crate::{MAX_FILE_BYTES, PolicyError};

/// A policy file: its bytes, and what they say. One that exists passed every check.
#[derive(Debug, Clone)]
pub struct PolicyFile {
    bytes: Arc<[u8]>,
    sha256: [u8; 32],
    metadata: PolicyMetadata,
    spec: MlpSpec,
}

impl PolicyFile {
    /// Reads a file strictly: only graphs and fields of the kind that [`crate::build_onnx`] writes
    /// are accepted, so that nothing in the bytes goes unlooked at.
    ///
    /// # Errors
    /// The first thing that is not right.
    pub fn parse(bytes: Arc<[u8]>) -> Result<Self, PolicyError> {
        if bytes.len() > MAX_FILE_BYTES {
            return Err(PolicyError::TooLarge { bytes: bytes.len(), limit: MAX_FILE_BYTES });
        }
        let (spec, properties) = graph::read(&bytes)?;
        let metadata = PolicyMetadata::read(&properties)?;
        metadata.check_sizes(&spec)?;
        let sha256 = Sha256::digest(&bytes).into();
        Ok(Self { bytes, sha256, metadata, spec })
    }

    /// The file's bytes, as they were read.
    pub fn bytes(&self) -> &Arc<[u8]> {
        &self.bytes
    }

    /// SHA-256 of the bytes.
    pub fn sha256(&self) -> [u8; 32] {
        self.sha256
    }

    /// SHA-256 of the bytes, lower-case hexadecimal.
    pub fn sha256_hex(&self) -> String {
        hex::encode(self.sha256)
    }

    /// What the file says about itself.
    pub fn metadata(&self) -> &PolicyMetadata {
        &self.metadata
    }

    /// The network.
    pub fn spec(&self) -> &MlpSpec {
        &self.spec
    }

    /// Refuses a policy whose contract is not exactly `expected`: what training asks for, where
    /// actors and learner must agree to the letter.
    ///
    /// # Errors
    /// The most telling difference: [`PolicyError::WrongRobot`], [`PolicyError::WrongJointOrder`],
    /// [`PolicyError::WrongPart`] or [`PolicyError::WrongRobotModel`].
    pub fn check_contract(&self, expected: &PolicyContract) -> Result<(), PolicyError> {
        match self.metadata.contract.differences(expected).first() {
            None => Ok(()),
            Some(&difference) => Err(self.refusal(difference, expected)),
        }
    }

    /// Refuses a policy that would compute nonsense on `expected`, and returns in what else it
    /// differs: another version of the robot's parameters, other command ranges. What evaluation
    /// and the robot ask for, and report.
    ///
    /// # Errors
    /// As [`Self::check_contract`].
    pub fn check_runs_on(
        &self,
        expected: &PolicyContract,
    ) -> Result<Vec<ContractDifference>, PolicyError> {
        let differences = self.metadata.contract.differences(expected);
        match differences.iter().find(|d| d.is_breaking()) {
            None => Ok(differences),
            Some(&difference) => Err(self.refusal(difference, expected)),
        }
    }

    fn refusal(&self, difference: ContractDifference, expected: &PolicyContract) -> PolicyError {
        let own = &self.metadata.contract;
        match difference {
            ContractDifference::Robot => PolicyError::WrongRobot {
                found: own.robot.clone(),
                expected: expected.robot.clone(),
            },
            ContractDifference::RobotModel => PolicyError::WrongRobotModel {
                found: own.robot_hash.clone(),
                expected: expected.robot_hash.clone(),
            },
            ContractDifference::JointOrder => {
                let pairs = own.joint_names.iter().zip(&expected.joint_names);
                let index = pairs.take_while(|(a, b)| a == b).count();
                let name = |names: &[String]| names.get(index).cloned().unwrap_or_default();
                PolicyError::WrongJointOrder {
                    index,
                    found: name(&own.joint_names),
                    expected: name(&expected.joint_names),
                }
            }
            part => PolicyError::WrongPart { part: part.name() },
        }
    }
}
