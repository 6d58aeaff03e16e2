//! What a policy file says about itself.

use std::collections::BTreeMap;
use std::fmt::Display;

use caudata_task::PolicyContract;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::PolicyError;
use crate::mlp::{MlpSpec, finite, length};

/// Metadata key under which everything exact is, as JSON.
pub const METADATA_KEY: &str = "caudata.policy.v1";
/// Name that mjlab gives a velocity command; the value of `command_names`.
const COMMAND_NAME: &str = "twist";

/// Everything that a policy file says beside the network; JSON under [`METADATA_KEY`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyMetadata {
    /// What the policy's numbers mean; every reader compares it with its own.
    pub contract: PolicyContract,
    /// Version of the policy: the learner's iteration.
    pub version: u64,
    /// The training run; 1 to 128 printable ASCII characters without spaces.
    pub run_id: String,
    /// Commit of the program that trained it, at most 64 characters; empty where unknown.
    pub training_commit: String,
    /// Hash of the training configuration, at most 64 characters; empty where unknown.
    pub config_hash: String,
    /// Environment steps that training had seen.
    pub env_steps: u64,
    /// Seed of the run.
    pub seed: u64,
    /// Natural logarithm of the exploration's standard deviation, per action; -20 to 5. Actors
    /// explore with it, robots ignore it.
    pub log_std: Vec<f32>,
    /// When it was written, s since 1970-01-01 UTC. Left out where equal training must give equal
    /// bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub created_unix_s: Option<u64>,
    /// Summary of an evaluation: a JSON object.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evaluation: Option<Value>,
}

impl PolicyMetadata {
    /// Checks every value on its own.
    ///
    /// # Errors
    /// [`PolicyError::Metadata`] names the first that is wrong.
    pub fn check(&self) -> Result<(), PolicyError> {
        self.contract.validate().map_err(problem)?;
        if !printable(&self.contract.robot, 1, 64) {
            return Err(problem("`robot` must be 1 to 64 printable ASCII characters"));
        }
        if !printable(&self.run_id, 1, 128) {
            return Err(problem("`run_id` must be 1 to 128 printable ASCII characters"));
        }
        if !printable(&self.training_commit, 0, 64) || !printable(&self.config_hash, 0, 64) {
            return Err(problem("commit and hash must be at most 64 printable ASCII characters"));
        }
        finite("log_std", &self.log_std)?;
        if self.log_std.iter().any(|x| !(-20.0..=5.0).contains(x)) {
            return Err(PolicyError::Range { field: "log_std", problem: "-20 to 5" });
        }
        if self.evaluation.as_ref().is_some_and(|e| !e.is_object()) {
            return Err(problem("`evaluation` must be an object"));
        }
        Ok(())
    }

    /// The network takes the contract's observations and gives its actions.
    pub(crate) fn check_sizes(&self, spec: &MlpSpec) -> Result<(), PolicyError> {
        length("observation of the network", spec.obs_dim(), self.contract.obs_dim())?;
        length("actions of the network", spec.act_dim(), self.contract.act_dim())?;
        length("log_std", self.log_std.len(), self.contract.act_dim())
    }

    /// The metadata properties of the file, in the order in which they are written.
    pub(crate) fn properties(&self) -> Result<Vec<(&'static str, String)>, PolicyError> {
        let mut properties = self.common_properties();
        properties.push((METADATA_KEY, serde_json::to_string(self).map_err(problem)?));
        Ok(properties)
    }

    /// The eight keys that tools of the mjlab and BeyondMimic family read. Those round to three
    /// decimals; here each number is the shortest that reads back exactly.
    fn common_properties(&self) -> Vec<(&'static str, String)> {
        let contract = &self.contract;
        let scale = vec![contract.action.scale; contract.act_dim()];
        vec![
            ("run_path", self.run_id.clone()),
            ("joint_names", contract.joint_names.join(",")),
            ("joint_stiffness", csv(&contract.kp_nm_per_rad)),
            ("joint_damping", csv(&contract.kd_nm_s_per_rad)),
            ("default_joint_pos", csv(&contract.nominal_pos_rad)),
            ("command_names", COMMAND_NAME.to_owned()),
            ("observation_names", csv(contract.observation.slices().iter().map(|s| &s.name))),
            ("action_scale", csv(&scale)),
        ]
    }

    /// Reads the metadata properties of a file. The keys for other tools must say the same as the
    /// JSON: a tool that reads them must not run another policy than we do.
    pub(crate) fn read(properties: &BTreeMap<String, String>) -> Result<Self, PolicyError> {
        let get = |key: &'static str| properties.get(key).ok_or(PolicyError::MissingKey { key });
        let metadata: Self = serde_json::from_str(get(METADATA_KEY)?).map_err(problem)?;
        metadata.check()?;
        for (key, value) in metadata.common_properties() {
            if *get(key)? != value {
                return Err(PolicyError::Contradiction { key });
            }
        }
        Ok(metadata)
    }
}

fn csv<T: Display>(values: impl IntoIterator<Item = T>) -> String {
    values.into_iter().map(|v| v.to_string()).collect::<Vec<_>>().join(",")
}

fn printable(text: &str, min: usize, max: usize) -> bool {
    (min..=max).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_graphic())
}

fn problem(error: impl Display) -> PolicyError {
    PolicyError::Metadata { problem: error.to_string() }
}
