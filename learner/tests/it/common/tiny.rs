//! A run small enough for tests.

/// Overrides that make the quick preset tiny.
pub const TINY: [&str; 8] = [
    "actors.lanes=2",
    "actors.chunk_steps=4",
    "learner.network.policy_hidden=[16]",
    "learner.network.value_hidden=[16]",
    "learner.ppo.minibatches=2",
    "learner.checkpoint_every=2",
    "learner.keep_checkpoints=20",
    "telemetry.metrics=false",
];
