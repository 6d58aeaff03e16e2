//! Running a policy with ONNX Runtime.

use ort::environment::Environment;
use ort::memory::Allocator;
use ort::session::builder::GraphOptimizationLevel;
use ort::session::{IoBinding, Session};
use ort::value::Tensor;

use crate::mlp::length;
use crate::onnx::{INPUT, OUTPUT};
use crate::{PolicyError, PolicyFile, runtime};

/// A loaded policy. Each thread that runs policies has its own.
///
/// The input and output tensors are kept from call to call and bound once, so that a call with
/// the same number of lanes as the one before copies its observations in and its actions out and
/// allocates nothing of its own.
#[derive(Debug)]
pub struct Inference {
    session: Session,
    obs_dim: usize,
    act_dim: usize,
    bound: Option<Bound>,
}

/// Tensors for one number of lanes.
#[derive(Debug)]
struct Bound {
    lanes: usize,
    binding: IoBinding,
    obs: Tensor<f32>,
    actions: Tensor<f32>,
}

impl Inference {
    /// Loads a policy from the bytes that were checked. `threads` work within one operator; with
    /// 1, the calling thread does everything itself, which is the fastest for these small networks.
    ///
    /// # Errors
    /// No ONNX Runtime ([`PolicyError::RuntimeNotFound`], [`PolicyError::RuntimeLoad`]), or it
    /// refuses the model.
    pub fn new(file: &PolicyFile, threads: usize) -> Result<Self, PolicyError> {
        let environment = runtime::environment()?;
        let session = session(&environment, file.bytes(), threads.max(1)).map_err(runtime_error)?;
        Ok(Self {
            session,
            obs_dim: file.spec().obs_dim(),
            act_dim: file.spec().act_dim(),
            bound: None,
        })
    }

    /// D, length of one observation.
    pub fn obs_dim(&self) -> usize {
        self.obs_dim
    }

    /// A, number of actions.
    pub fn act_dim(&self) -> usize {
        self.act_dim
    }

    /// Actions `[lanes, A]` of raw observations `[lanes, D]`, both row-major.
    ///
    /// # Errors
    /// [`PolicyError::Length`] where a slice does not have that size; failures of the runtime.
    pub fn run(&mut self, obs: &[f32], lanes: usize, out: &mut [f32]) -> Result<(), PolicyError> {
        length("obs", obs.len(), lanes.saturating_mul(self.obs_dim))?;
        length("actions", out.len(), lanes.saturating_mul(self.act_dim))?;
        if lanes == 0 {
            return Ok(());
        }
        if self.bound.as_ref().is_none_or(|bound| bound.lanes != lanes) {
            self.bound = Some(self.bind(lanes).map_err(runtime_error)?);
        }
        let Some(bound) = &mut self.bound else { return Ok(()) };
        bound.obs.extract_tensor_mut().1.copy_from_slice(obs);
        self.session.run_binding(&bound.binding).map_err(runtime_error)?;
        out.copy_from_slice(bound.actions.extract_tensor().1);
        Ok(())
    }

    fn bind(&self, lanes: usize) -> ort::Result<Bound> {
        let allocator = Allocator::default();
        let obs = Tensor::<f32>::new(&allocator, [lanes, self.obs_dim])?;
        let mut actions = Tensor::<f32>::new(&allocator, [lanes, self.act_dim])?;
        let mut binding = self.session.create_binding()?;
        binding.bind_input(INPUT, &obs)?;
        binding.bind_output(OUTPUT, &mut actions)?;
        Ok(Bound { lanes, binding, obs, actions })
    }
}

fn session(environment: &Environment, bytes: &[u8], threads: usize) -> ort::Result<Session> {
    Session::builder(environment)?
        .with_optimization_level(GraphOptimizationLevel::All)?
        .with_intra_threads(threads)?
        .with_inter_threads(1)?
        // Threads that spin while they wait would take the simulator's cores.
        .with_intra_op_spinning(false)?
        .with_deterministic_compute(true)?
        .commit_from_memory(bytes)
}

fn runtime_error(error: ort::Error) -> PolicyError {
    PolicyError::Runtime(error.to_string())
}
