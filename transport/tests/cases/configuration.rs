//! Configurations: what is refused, and the way to an actor as text.

use caudata_transport::{Limits, TransportConfig, TransportError, actor_link, learner_link};

use crate::support::rig::{Kind, limits, remote};

#[test]
fn bad_run_ids_and_limits_are_refused() {
    let config = remote(Kind::Zenoh, limits());
    for run_id in ["", "a/b", ".hidden", "späť", &"x".repeat(65)] {
        let refused = learner_link(&config, run_id).err().unwrap();
        assert!(matches!(refused, TransportError::Config(_)), "{refused}");
    }
    let config = remote(Kind::Zenoh, Limits { window_frames: 0, ..limits() });
    let refused = actor_link(&config, "run", 0).err().unwrap();
    assert!(refused.to_string().contains("window_frames"), "{refused}");
}

/// The configuration survives the way to an actor process as text, and an unknown key is an error.
#[test]
fn configurations_round_trip_as_toml() {
    for kind in [Kind::Iceoryx2, Kind::Zenoh] {
        let config = remote(kind, limits());
        let text = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<TransportConfig>(&text).unwrap(), config);
    }
    let unknown = toml::from_str::<TransportConfig>("kind = \"zenoh\"\nport = 1\n");
    assert!(unknown.is_err());
}
