//! The one typed TOML configuration, its presets and overrides.
