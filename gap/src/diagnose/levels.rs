//! Misfits that mean something everywhere, in units of the floor (1 is what the tolerances allow).

/// Misfit from which on there is something to explain. Tolerances are wide: careful labs stay at 0.1 to 0.3 (nulls
/// of the benchmark).
pub const CAREFUL_LAB: f64 = 0.4;
/// What the right model leaves, floors: the middle of what careful labs have (nulls of the benchmark).
pub const RIGHT_LEAVES: f64 = 0.24;
/// A robot with so many joints is judged joint by joint, and first looked at on a scout.
pub const MANY_JOINTS: usize = 5;
/// Misfit below which nothing is left to explain. 1 is what the tolerances allow; careful labs stay below 0.3
/// (nulls of the benchmark).
pub const NOTHING_LEFT: f64 = 0.8;
/// What a model must leave at most of what another leaves for one to speak of it as better.
pub const BUILT: f64 = 0.95;
