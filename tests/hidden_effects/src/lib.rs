//! The benchmark of diagnosis: logs with an effect hidden in them by other numerics than the diagnosing simulator's, answers sealed away
//! from it, and scores.

#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]
