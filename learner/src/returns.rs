//! Value targets and advantages: V-trace (Espeholt et al. 2018, "IMPALA", section 4.1) with time limits told
//! apart from failures.
//!
//! With δ_t = r_t + γ·V'_t − V_t, where V'_t is 0 after a termination, the value of the final observation
//! after a truncation and V_{t+1} otherwise, the correction of a value is D_t = ρ_t·δ_t + γ·c_t·D_{t+1} (no
//! D_{t+1} across the end of an episode), and the target is V_t + D_t. ρ_t = min(ρ̄, π/μ), c_t = λ·min(c̄,
//! π/μ).
//!
//! The advantage is that of the action that was taken, A_t = δ_t + γ·λ·D_{t+1}: what followed is corrected
//! for the policy's age, the action itself is not, since the loss weighs it by π/μ. (With D_t in its place
//! that ratio would count twice.) Where the behaviour is the current policy, π/μ = 1 and A_t = D_t is GAE(λ)
//! (Schulman et al. 2016) exactly. So it is where nobody says what the ratios are, which is how older data is
//! taken unless `learner.staleness.returns = "vtrace"`: min(1, π/μ) of sixteen joints is 0.83 in the mean
//! after four iterations, and a trace of λ·0.83 hardly looks ahead.

/// Discounts and caps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VtraceSettings {
    /// γ per step.
    pub gamma: f32,
    /// λ.
    pub lambda: f32,
    /// ρ̄, cap of the ratio in δ.
    pub rho_max: f32,
    /// c̄, cap of the ratio in the trace.
    pub c_max: f32,
}

/// One chunk of experience: T steps of N lanes, row-major `[T, N]` unless said otherwise.
#[derive(Clone, Copy, Debug)]
pub struct Trajectories<'a> {
    /// N.
    pub lanes: usize,
    /// Rewards.
    pub rewards: &'a [f32],
    /// The episode ended by failure at this step: nothing follows.
    pub terminated: &'a [bool],
    /// The episode was cut off after this step: `final_values` says what would have followed.
    pub truncated: &'a [bool],
    /// V of each observation that was acted on.
    pub values: &'a [f32],
    /// V of the observation after the last step, `[N]`.
    pub bootstrap_values: &'a [f32],
    /// V of the final observation of each truncated step, in the order of the steps, then lanes.
    pub final_values: &'a [f32],
    /// π/μ of each action; `None`: 1, exact when the behaviour is the current policy.
    pub ratios: Option<&'a [f32]>,
}

/// Writes the advantages `[T, N]` and the value targets `[T, N]`.
///
/// Arrays of the wrong length are a mistake of the caller and are caught in debug builds.
pub fn vtrace(
    settings: &VtraceSettings,
    chunk: &Trajectories,
    advantages: &mut [f32],
    targets: &mut [f32],
) {
    let lanes = chunk.lanes;
    let steps = chunk.rewards.len() / lanes.max(1);
    debug_assert!(advantages.len() == steps * lanes && targets.len() == steps * lanes);
    debug_assert_eq!(chunk.final_values.len(), chunk.truncated.iter().filter(|&&t| t).count());
    let mut finals = chunk.final_values.iter().rev();
    // D of the step after, by lane.
    let mut corrections = vec![0.0_f32; lanes];
    for t in (0..steps).rev() {
        // From the last lane to the first, so that the final values come in their reversed order.
        for n in (0..lanes).rev() {
            let i = t * lanes + n;
            // Without ratios there is nothing to cap: a cap below 1 would cut fresh data short.
            let (rho, trace) = match chunk.ratios {
                Some(ratios) => (ratios[i].min(settings.rho_max), ratios[i].min(settings.c_max)),
                None => (1.0, 1.0),
            };
            let trace = settings.lambda * trace;
            let (next_value, next_correction) = if chunk.truncated[i] {
                (finals.next().copied().unwrap_or(0.0), 0.0)
            } else if chunk.terminated[i] {
                (0.0, 0.0)
            } else if t + 1 == steps {
                (chunk.bootstrap_values[n], 0.0)
            } else {
                (chunk.values[i + lanes], corrections[n])
            };
            let delta = chunk.rewards[i] + settings.gamma * next_value - chunk.values[i];
            advantages[i] = delta + settings.gamma * settings.lambda * next_correction;
            corrections[n] = rho * delta + settings.gamma * trace * next_correction;
            targets[i] = chunk.values[i] + corrections[n];
        }
    }
}

/// Mean and standard deviation of `xs`, each of which counts `weights` times, in f64.
pub fn weighted_mean_and_std(xs: &[f32], weights: &[f32]) -> (f64, f64) {
    let pairs = || xs.iter().zip(weights).map(|(&x, &w)| (f64::from(x), f64::from(w)));
    let n = pairs().map(|(_, w)| w).sum::<f64>();
    let n = if n > 0.0 { n } else { 1.0 };
    let mean = pairs().map(|(x, w)| x * w).sum::<f64>() / n;
    let variance = pairs().map(|(x, w)| (x - mean).powi(2) * w).sum::<f64>() / n;
    (mean, variance.sqrt())
}

/// Mean and standard deviation (population) of `xs`, in f64.
pub fn mean_and_std(xs: &[f32]) -> (f64, f64) {
    let n = xs.len().max(1) as f64;
    let mean = xs.iter().map(|&x| f64::from(x)).sum::<f64>() / n;
    let variance = xs.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / n;
    (mean, variance.sqrt())
}

#[cfg(test)]
mod tests;
