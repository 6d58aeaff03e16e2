//! Counter-based random streams keyed by seed, actor, environment and episode.
