//! `[learner]`: networks, PPO, staleness, checkpoints.

use std::path::PathBuf;

use caudata_declare::settings;
pub use caudata_lanes::dense::Activation;
use serde::{Deserialize, Serialize};

settings! {
    /// `[learner]`.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct LearnerConfig {
        /// Where tensors live. `auto` takes CUDA when libtorch has it.
        pub device: Device = Device::Auto,
        /// Threads of an update on the CPU. 1 to 256. Small networks gain little above 1. Results do
        /// not depend on it.
        pub threads: u32 = 1,
        /// Every how many iterations a policy goes to the policy server (the last one always does). 1 to
        /// 1,000,000. Actors get every version regardless.
        pub publish_every: u64 = 25,
        /// Every how many iterations the full state goes to disk (also at the end and when stopped). 1 to
        /// 1,000,000.
        pub checkpoint_every: u64 = 25,
        /// Checkpoints that are kept, newest first. 1 to 10,000.
        pub keep_checkpoints: u32 = 3,
        /// Seconds to wait for a full batch before going on with what has come. Above 0, to 86,400. Too
        /// short: a slow actor's work is lost; too long: a dead one holds everybody up.
        pub batch_timeout_s: f64 = 30.0,
        /// Share of a full batch without which the learner does not learn. Above 0, to 1. Below it after
        /// `starve_timeout_s` the run ends with exit code 75.
        pub min_batch_share: f64 = 0.5,
        /// Seconds without `min_batch_share` after which the run ends. At least `batch_timeout_s`, to 86,400.
        pub starve_timeout_s: f64 = 300.0,
        /// Networks, exploration noise, normaliser.
        pub network: NetworkConfig,
        /// The update.
        pub ppo: PpoConfig,
        /// Data from older policies.
        pub staleness: StalenessConfig,
        /// Beginning with a policy that was trained before.
        pub warm_start: WarmStartConfig,
        /// Learning from one beside the reward.
        pub teacher: TeacherConfig,
    }
}

settings! {
    /// `[learner.teacher]`: a policy whose actions are learnt wherever the one that is trained gets to (DAgger,
    /// Ross et al. 2011), beside the reward.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct TeacherConfig {
        /// Policy file (ONNX) of the teacher; empty: there is none. A relative path is looked for as that of
        /// `learner.warm_start.policy`. Same joints, control period and action. It sees the beginning of what
        /// this task shows, or this task's terms without `task.observation.past` and then, as terms of its own,
        /// signals of `task.critic.sees` in that order: what it knows and its student does not.
        pub policy: PathBuf,
        /// Weight in the loss of half the squared distance of the actions. 0 to 1,000.
        pub weight: f64 = 1.0,
        /// Environment steps of the whole run over which the weight falls evenly to 0. Default 0: it stays.
        pub gone_after_env_steps: u64,
    }
}

impl TeacherConfig {
    /// The weight after `env_steps` of the whole run.
    pub fn weight_after(&self, env_steps: u64) -> f64 {
        match self.gone_after_env_steps {
            0 => self.weight,
            all => self.weight * (1.0 - env_steps as f64 / all as f64).max(0.0),
        }
    }
}

settings! {
    /// `[learner.warm_start]`.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct WarmStartConfig {
        /// Policy file (ONNX) to begin with; empty begins with random weights. A relative path is looked for
        /// in the current directory, then in the folders above the executable. Same joints, layers and
        /// activation; observations that this task appends to that policy's begin with weight zero. Its
        /// exploration noise is taken over, its critic is not in the file.
        pub policy: PathBuf,
        /// Iterations in which only the value function learns. 0 to 100,000. Default 20. Too few: advantages
        /// from a critic that knows nothing yet spoil the policy; more only cost time. Without a policy file
        /// it has no effect.
        pub value_only_iterations: u64 = 20,
        /// Smallest standard deviation of the action noise to begin with, 0 to 5. Default 0: that of the
        /// file, which is small where a policy was trained to its end. Too small: nothing new is found out;
        /// too large: what it knew is forgotten.
        pub least_std: f32 = 0.0,
    }
}

/// Where tensors live.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Device {
    /// CUDA when there, else the CPU.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// The first CUDA device, or an error.
    Cuda,
}

/// What is done about data that older policies collected.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Correction {
    /// Decoupled loss with truncated importance weights.
    #[default]
    Decoupled,
    /// Nothing: the clipped loss of plain PPO against the policy that acted.
    None,
}

settings! {
    /// `[learner.network]`.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct NetworkConfig {
        /// Hidden layers of the policy. 1 to 8 layers of 1 to 4,096 units.
        pub policy_hidden: Vec<u32> = vec![128, 128],
        /// Hidden layers of the value function.
        pub value_hidden: Vec<u32> = vec![128, 128],
        /// Non-linearity of the hidden layers.
        pub activation: Activation = Activation::Elu,
        /// Standard deviation of the action noise at the start, in units of the action. 0.01 to 5. A slow
        /// action filter needs a large one.
        pub init_std: f64 = 0.7,
        /// Smallest standard deviation that the policy may learn. Above 0, below `std_max`. Too small:
        /// exploration dies and log-probabilities explode.
        pub std_min: f64 = 0.05,
        /// Largest standard deviation that the policy may learn. To 10.
        pub std_max: f64 = 1.5,
        /// Whether observations are shifted and scaled by their running mean and standard deviation.
        pub normalise_observations: bool = true,
        /// Normalised observations are clipped to ± this. 1 to 100. Too small cuts signal, too large lets
        /// rare spikes through.
        pub observation_clip: f64 = 10.0,
        /// Whether the networks treat left and right alike by construction: the mirror image of an
        /// observation gives the mirror image of the action, and the same value. Counterparts are found from
        /// the robot's geometry; a robot that is not its own mirror image is refused. Default false (paper).
        /// Costs next to nothing, and every sample teaches both sides; what must be done on one side alone
        /// cannot be learnt.
        pub symmetric: bool = false,
    }
}

settings! {
    /// `[learner.ppo]`. The objective is decoupled PPO (Hilton et al. 2022): clipping against the policy
    /// before the update, importance weights against the one that acted.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct PpoConfig {
        /// Passes over a batch. 1 to 100. More: more learnt per sample, and more drift from the data.
        pub epochs: u32 = 4,
        /// Parts that a batch is split into per pass. 1 to 1,024, at most the samples of a batch.
        pub minibatches: u32 = 4,
        /// Discount per 20 ms step. 0 to below 1. 0.97 looks 0.7 s ahead, 0.99 2 s.
        pub gamma: f64 = 0.97,
        /// λ of GAE and V-trace. 0 to 1. Small: leans on the critic; large: noisy.
        pub lambda: f64 = 0.95,
        /// Clip range ε of the probability ratio. Above 0, below 1.
        pub clip: f64 = 0.2,
        /// Weight of the value loss. 0 to 100.
        pub value_loss_weight: f64 = 1.0,
        /// Weight of the entropy bonus. 0 to 1. Too small: early collapse; too large: noise for its own sake.
        pub entropy_weight: f64 = 0.003,
        /// Largest norm of the gradient. Above 0, to 1,000.
        pub max_grad_norm: f64 = 1.0,
        /// Learning rate of Adam at the start. Above 0, to 1.
        pub learning_rate: f64 = 1e-3,
        /// KL divergence per update that the learning rate is adapted to, nats (rsl_rl's rule: above twice it
        /// the rate falls by 1.5, below half of it it rises by 1.5). 0 keeps the rate. 0 to 1.
        pub target_kl: f64 = 0.01,
        /// What the target falls to, evenly in its logarithm, over `target_kl_final_after_env_steps` of the
        /// whole run. 0 to `target_kl`. Default 0: it stays. Large steps find a gait, and then shake the
        /// policy about it, for a batch of some thousand samples is noisy; a fifth of `target_kl` at the end
        /// lets it settle. Too small too early: it stops learning.
        pub target_kl_final: f64 = 0.0,
        /// Environment steps after which `target_kl_final` is reached. Default 0: from the start.
        pub target_kl_final_after_env_steps: u64 = 0,
        /// Bounds of the adapted learning rate.
        pub learning_rate_min: f64 = 1e-5,
        /// Bounds of the adapted learning rate.
        pub learning_rate_max: f64 = 1e-2,
        /// Learning rate of the value function, 0 to 1. Default 0: that of the policy (rsl_rl), adapted like
        /// it; any other stays as it is. Where small batches keep the policy's below 1e-4, a critic that
        /// falls behind misleads it; 1e-3 keeps it up.
        pub value_learning_rate: f64 = 0.0,
        /// Over what advantages are shifted and scaled to mean 0 and variance 1.
        pub advantage_scale: AdvantageScale = AdvantageScale::Batch,
    }
}

impl PpoConfig {
    /// The target after `env_steps` of the whole run, nats.
    pub fn target_kl_after(&self, env_steps: u64) -> f64 {
        if self.target_kl_final <= 0.0 || self.target_kl <= 0.0 {
            return self.target_kl;
        }
        let share = match self.target_kl_final_after_env_steps {
            0 => 1.0,
            all => (env_steps as f64 / all as f64).min(1.0),
        };
        self.target_kl * (self.target_kl_final / self.target_kl).powf(share)
    }
}

/// Over what advantages are normalised.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AdvantageScale {
    /// The whole batch (rsl_rl).
    #[default]
    Batch,
    /// Each minibatch (brax).
    Minibatch,
    /// Not at all.
    None,
}

/// Value targets and advantages of data from older policies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Returns {
    /// GAE, as of fresh data.
    #[default]
    Gae,
    /// V-trace.
    Vtrace,
}

settings! {
    /// `[learner.staleness]`: what happens to data from older policies.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct StalenessConfig {
        /// Policy versions after which a chunk is dropped and counted. 0 to 1,000. 0 uses only the newest
        /// policy's.
        pub max_lag: u64 = 4,
        /// `decoupled`: data of older policies counts with the weight π_prox/μ (Hilton et al. 2022). `none`:
        /// plain PPO, whose ratio is π_θ/μ and whose targets take all data for the newest policy's; for
        /// comparison.
        pub correction: Correction = Correction::Decoupled,
        /// What older data says of values, with `decoupled`. `gae`: what newer data would; its mistake is
        /// what the policies differ by in the steps that λ looks ahead. `vtrace`: each step corrected by its
        /// ratio (Espeholt et al. 2018), which is exact in the mean, and in sixteen dimensions cuts traces
        /// short: four iterations of lag make λ = 0.95 look ahead as far as 0.79 does
        /// (docs/reference/learning.md).
        pub returns: Returns = Returns::Gae,
        /// ρ̄ of V-trace (Espeholt et al. 2018): cap of the ratio in the correction of values. 0.1 to 10; 1
        /// is the paper's. Only with `returns = "vtrace"`.
        pub rho_max: f64 = 1.0,
        /// c̄ of V-trace: cap of the trace, multiplied by λ. 0.1 to 10; 1 makes it GAE at lag 0. Only with
        /// `returns = "vtrace"`.
        pub c_max: f64 = 1.0,
        /// Cap of the weight π_prox/μ in the loss. 1 to 100. Large: noisy; 1: biased towards the old policy.
        pub weight_max: f64 = 2.0,
        /// Effective sample size, as a share of the batch, below which the learning rate is halved for this
        /// batch and a warning is given. 0 to 1.
        pub min_effective_share: f64 = 0.5,
    }
}
