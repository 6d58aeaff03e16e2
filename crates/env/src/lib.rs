//! Vectorised environments: the task run on a physics engine, many lanes at a time.
