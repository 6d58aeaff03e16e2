//! Tracing set-up, metrics endpoint, banner, exit codes and shutdown signals shared by all binaries.
