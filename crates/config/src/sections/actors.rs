//! `[actors]`: who collects, how much, and how far ahead of the learner.

use caudata_declare::settings;
use serde::{Deserialize, Serialize};

settings! {
    /// `[actors]`. One iteration of the learner uses `count × chunks_per_version × chunk_steps × lanes`
    /// steps.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct ActorsConfig {
        /// Actors: threads of the learner with the in-process transport, processes otherwise. 1 to 1,024.
        /// On one machine: one per core. More only adds switching.
        pub count: u32 = 2,
        /// Environments per actor. 1 to 65,536. Too few: small batches, noisy gradients; too many: each is
        /// stepped rarely and the batch holds little of an episode.
        pub lanes: u32 = 64,
        /// Steps per chunk. 1 to 1,024; 24 to 64 is usual. Too short: advantages lean on the critic; too
        /// long: the policy is old by the end.
        pub chunk_steps: u32 = 24,
        /// Chunks that an actor sends for each policy version. 1 to 64.
        pub chunks_per_version: u32 = 1,
        /// Quotas that an actor may collect ahead with an old policy while it waits for the next version. 0
        /// (`sync`): actors and learner take turns and runs repeat bit for bit. 1 and more (`async`): they
        /// overlap, data is so many versions old. 0 to 8.
        pub max_lead: u32 = 1,
        /// The lag is always exactly `max_lead` (in the first iterations less), and the work is split by
        /// lane: for the same `count × lanes` any number of actors gives the same weights, bit for bit, over
        /// any transport, as long as none dies. Costs waiting: with 1 nobody is ahead of the slowest by more
        /// than one quota. Actors are numbered from 0 to `count` − 1; names are refused.
        pub lockstep: bool = false,
        /// Threads that step one actor's environments. 1 to 256. Results do not depend on it.
        pub threads: u32 = 1,
        /// Seconds an actor waits for a new policy before it gives up (exit code 75). Above 0, to 86,400.
        /// Must be longer than the learner's longest pause (update, checkpoint, restart). Not for actors inside
        /// the learner's process: they wait as long as it lives.
        pub policy_timeout_s: f64 = 300.0,
        /// Seconds an actor spends at its end on handing over what it has sent. Above 0, to 600.
        pub flush_timeout_s: f64 = 10.0,
        /// Restarts of one actor per minute before the run gives up. 0 to 60.
        pub restarts_per_minute: u32 = 5,
    }
}

impl ActorsConfig {
    /// Environment steps that one iteration of the learner uses.
    pub fn steps_per_iteration(&self) -> u64 {
        u64::from(self.count)
            * u64::from(self.chunks_per_version)
            * u64::from(self.chunk_steps)
            * u64::from(self.lanes)
    }
}
