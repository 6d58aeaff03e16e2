//! The neutral log format for measured and simulated runs.
