//! The robot model: MJCF subset plus robot file, checked and hashed.
