//! One suite, every transport: what `ActorLink` and `LearnerLink` promise.
//!
//! Cases are generic functions; the macro makes a test of each for each transport. Deaths and restarts happen
//! to real processes. No case asserts a time; all wait for conditions.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout)]

mod cases;
mod support;

/// The body of helper processes; does nothing in the test process itself.
#[test]
#[ignore = "run by other tests in a process of its own"]
fn helper_process() {
    support::process::run_order();
}

/// Makes a module of tests: the named cases on one transport.
macro_rules! on {
    ($kind:ident, $module:ident, $($group:ident: $($case:ident)*;)*) => {
        mod $module {
            use crate::{cases, support::rig::Kind};
            $($(#[test] fn $case() { cases::$group::$case(Kind::$kind); })*)*
        }
    };
}

macro_rules! every_case {
    ($kind:ident, $module:ident $(, $group:ident: $($case:ident)*)?) => {
        on! { $kind, $module,
            every:
                ten_thousand_frames_arrive_once_and_in_order
                a_slow_learner_pushes_back_and_nothing_is_lost
                large_messages_pass_and_larger_ones_are_refused
                an_empty_frame_passes
                only_the_newest_policy_counts
                a_late_joiner_gets_the_newest_policy
                stop_reaches_every_actor
                the_learner_counts_its_actors;
            floods:
                fault_62_a_flood_of_one_actor_holds_up_nobody
                fault_62_latency_under_a_flood;
            $($group: $($case)*;)?
        }
    };
}

macro_rules! between_processes {
    ($kind:ident, $module:ident) => {
        every_case! { $kind, $module, processes:
            one_actor_too_many_waits_for_its_turn
            a_killed_actor_harms_nobody
            an_actor_that_stands_still_holds_up_nobody
            actors_find_a_restarted_learner
            actors_find_a_learner_that_is_killed_under_load_and_back_at_once
            a_learner_that_stands_still_loses_nothing
            an_actor_may_come_before_its_learner
        }
    };
}

every_case! { Inproc, inproc }
between_processes! { Iceoryx2, iceoryx2 }
between_processes! { Zenoh, zenoh }
between_processes! { Quic, quic }

/// The long fault suite: a thousand actors killed in mid-write.
#[test]
#[ignore = "long: a thousand processes"]
fn fault_a_thousand_killed_actors_iceoryx2() {
    cases::processes::killing(support::rig::Kind::Iceoryx2, 1_000, 20_000);
}

/// The same over QUIC with certificates, a tenth of it.
#[test]
#[ignore = "long: a hundred processes"]
fn fault_a_hundred_killed_actors_quic() {
    cases::processes::killing(support::rig::Kind::Quic, 100, 5_000);
}

/// The same over the network, a tenth of it.
#[test]
#[ignore = "long: a hundred processes"]
fn fault_a_hundred_killed_actors_zenoh() {
    cases::processes::killing(support::rig::Kind::Zenoh, 100, 5_000);
}
