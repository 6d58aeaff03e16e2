//! The on-robot client: pulls, verifies and runs the policy at 50 Hz.
