//! Typed client of the policy server: publish, list, fetch with resume, watch.
