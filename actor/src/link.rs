//! From the `[transport]` section to the transport's own configuration, and to a word on a command line and
//! back.

use caudata_config::{Config, TransportKind, TransportSection};
use caudata_transport::{
    Iceoryx2Config, InprocConfig, Limits, TlsFiles, TransportConfig, ZenohConfig,
};

/// The transport's configuration as the section says.
pub fn transport_config(section: &TransportSection) -> TransportConfig {
    let limits = Limits {
        max_frame_bytes: section.max_frame_bytes as usize,
        max_policy_bytes: section.max_policy_bytes as usize,
        window_frames: section.window_frames as usize,
        max_actors: section.max_actors as usize,
        max_frames_per_s: section.max_frames_per_s,
        heartbeat_ms: section.heartbeat_ms,
        peer_timeout_ms: section.peer_timeout_ms,
    };
    match section.kind {
        TransportKind::Inproc => TransportConfig::Inproc(InprocConfig { limits }),
        TransportKind::Iceoryx2 => TransportConfig::Iceoryx2(Iceoryx2Config {
            limits,
            root: Some(section.iceoryx2_root.clone()).filter(|root| !root.as_os_str().is_empty()),
        }),
        TransportKind::Zenoh => TransportConfig::Zenoh(ZenohConfig {
            limits,
            listen: section.zenoh_listen.clone(),
            connect: section.zenoh_connect.clone(),
            tls: None,
        }),
    }
}

/// The transport's configuration as `config` says, certificates included.
pub fn transport_of(config: &Config, role: &str) -> TransportConfig {
    with_certificates(transport_config(&config.transport), config, role)
}

/// With the certificates of a role where `transport` has none and `config` says where they are.
pub fn with_certificates(
    mut transport: TransportConfig,
    config: &Config,
    role: &str,
) -> TransportConfig {
    if let TransportConfig::Zenoh(zenoh) = &mut transport
        && zenoh.tls.is_none()
    {
        let folder = config.cluster.certificates(role);
        zenoh.tls = folder.as_deref().map(TlsFiles::in_folder);
    }
    transport
}

/// One word for a command line: JSON. The learner prints it in its `started` event, actors take it as
/// `--transport`.
pub fn encode_transport(config: &TransportConfig) -> String {
    // Plain data without map keys: it always has a JSON form.
    serde_json::to_string(config).unwrap_or_default()
}

/// The opposite of [`encode_transport`].
///
/// # Errors
/// What is not right about the text.
pub fn decode_transport(text: &str) -> Result<TransportConfig, serde_json::Error> {
    serde_json::from_str(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_section_s_defaults_are_the_transport_s_and_survive_the_command_line() {
        for (kind, expected) in [
            (TransportKind::Inproc, TransportConfig::Inproc(InprocConfig::default())),
            (TransportKind::Iceoryx2, TransportConfig::Iceoryx2(Iceoryx2Config::default())),
            (TransportKind::Zenoh, TransportConfig::Zenoh(ZenohConfig::default())),
        ] {
            let config = transport_config(&TransportSection { kind, ..Default::default() });
            assert_eq!(config, expected);
            assert_eq!(decode_transport(&encode_transport(&config)).unwrap(), config);
        }
        assert!(decode_transport("{\"kind\":\"smoke-signals\"}").is_err());
    }
}
