//! What starts a cluster: images, manifests, Slurm scripts.

#![allow(clippy::expect_used, clippy::panic, clippy::print_stdout, clippy::unwrap_used)]

mod images;
mod manifests;
mod renew;
mod slurm;
