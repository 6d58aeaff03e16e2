//! Rollouts and policy versions between actors and learner over one trait: in-process, iceoryx2, zenoh.
