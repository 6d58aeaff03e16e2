//! Who may connect and do what: plain connections stay on this host, all others show certificates, and a role
//! allows what it needs.

use std::net::SocketAddr;

use zenoh::Config;

use crate::{TlsFiles, TransportError};

/// Common names of certificates (`caudata_signing::pki::Role`) that may do everything within `caudata/`.
const TRUSTED: [&str; 2] = ["learner", "router"];
/// The common name of actors.
const ACTOR: &str = "actor";

/// Refuses endpoints that would carry rollouts and policies in the open, and files that are not there.
pub(super) fn check_endpoints(
    endpoints: &[String],
    tls: Option<&TlsFiles>,
) -> Result<(), TransportError> {
    for endpoint in endpoints {
        let refuse = |reason: String| {
            TransportError::Config(format!("zenoh endpoint {endpoint:?}: {reason}"))
        };
        match endpoint.split_once('/') {
            Some(("tcp", address)) if is_loopback(address) => {}
            Some(("tcp", _)) => {
                return Err(refuse(
                    "plain connections stay on loopback; beyond this host write quic/ and give certificates".to_owned(),
                ));
            }
            Some(("quic", _)) => match tls {
                None => return Err(refuse("it needs certificates (cluster.tls_dir)".to_owned())),
                Some(files) => {
                    if let Some(what) = files.unreadable() {
                        return Err(refuse(what));
                    }
                }
            },
            // zenoh 1.10 reads and writes one TLS stream from two threads (eclipse-zenoh/zenoh#2557).
            Some(("tls", _)) => {
                return Err(refuse(
                    "TLS over TCP can corrupt memory; write quic/ (UDP, the same certificates)"
                        .to_owned(),
                ));
            }
            _ => {
                return Err(refuse(
                    "it must be tcp/HOST:PORT on loopback, or quic/HOST:PORT".to_owned(),
                ));
            }
        }
    }
    Ok(())
}

/// Whether `host:port` stays on this host. A name other than `localhost` may lead anywhere.
fn is_loopback(address: &str) -> bool {
    match address.parse::<SocketAddr>() {
        Ok(address) => address.ip().is_loopback(),
        Err(_) => matches!(address.rsplit_once(':'), Some(("localhost", _))),
    }
}

/// Certificates on both sides, and what each role may do. A link without a certificate is a plain one on
/// loopback ([`check_endpoints`]), and trusted like this user.
pub(super) fn insert(config: &mut Config, tls: &TlsFiles) -> Result<(), zenoh::Error> {
    let path = |path: &std::path::Path| format!("{:?}", path.display().to_string());
    let settings = [
        ("root_ca_certificate", path(&tls.ca)),
        ("listen_certificate", path(&tls.certificate)),
        ("listen_private_key", path(&tls.key)),
        ("connect_certificate", path(&tls.certificate)),
        ("connect_private_key", path(&tls.key)),
        ("enable_mtls", "true".to_owned()),
        ("verify_name_on_connect", "true".to_owned()),
        ("close_link_on_expiration", "true".to_owned()),
    ];
    for (key, value) in settings {
        config.insert_json5(&format!("transport/link/tls/{key}"), &value)?;
    }
    config.insert_json5("access_control", &access_control())
}

/// zenoh's access control, as JSON. `ingress` is what the other side says to us. The same rules are in the
/// router's file, `docker/kubernetes/components/router/zenohd.json5`.
fn access_control() -> String {
    let rule = |id: &str, flow: &str, messages: &str, key: &str| {
        format!(
            r#"{{ id: "{id}", permission: "allow", flows: [{flow}], messages: [{messages}], key_exprs: ["{key}"] }}"#
        )
    };
    let both = r#""ingress", "egress""#;
    let everything = r#""put", "declare_subscriber", "declare_queryable", "query", "reply""#;
    let rules = [
        rule("rollouts-in", r#""ingress""#, r#""put""#, "caudata/*/up/*"),
        rule("answers-out", r#""egress""#, r#""put""#, "caudata/*/down/*"),
        rule("answers-wanted", r#""ingress""#, r#""declare_subscriber""#, "caudata/*/down/*"),
        rule("policy-asked", r#""ingress""#, r#""query""#, "caudata/*/policy"),
        rule("policy-out", r#""egress""#, r#""reply""#, "caudata/*/policy"),
        rule(
            "learner-is-known",
            r#""egress""#,
            r#""declare_subscriber", "declare_queryable""#,
            "caudata/**",
        ),
        rule("all", both, everything, "caudata/**"),
    ];
    format!(
        r#"{{
            enabled: true,
            default_permission: "deny",
            rules: [{rules}],
            subjects: [
                {{ id: "trusted", cert_common_names: {TRUSTED:?} }},
                {{ id: "actor", cert_common_names: ["{ACTOR}"] }},
                {{ id: "local", link_protocols: ["tcp"] }},
            ],
            policies: [
                {{ subjects: ["trusted", "local"], rules: ["all"] }},
                {{
                    subjects: ["actor"],
                    rules: ["rollouts-in", "answers-out", "answers-wanted", "policy-asked", "policy-out", "learner-is-known"],
                }},
            ],
        }}"#,
        rules = rules.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(endpoint: &str, tls: Option<&TlsFiles>) -> Result<(), String> {
        check_endpoints(&[endpoint.to_owned()], tls).map_err(|error| error.to_string())
    }

    #[test]
    fn plain_connections_stay_on_loopback() {
        for loopback in
            ["tcp/127.0.0.1:0", "tcp/127.3.2.1:7447", "tcp/[::1]:7447", "tcp/localhost:7447"]
        {
            check(loopback, None).unwrap();
        }
        for elsewhere in [
            "tcp/0.0.0.0:7447",
            "tcp/[::]:7447",
            "tcp/192.0.2.1:7447",
            "tcp/learner:7447",
            // A name that only looks like loopback.
            "tcp/localhost.example:7447",
            "tcp/127.0.0.1.example:7447",
        ] {
            let error = check(elsewhere, None).unwrap_err();
            assert!(error.contains(elsewhere) && error.contains("quic/"), "{error}");
        }
        for other in ["udp/127.0.0.1:7447", "tls/127.0.0.1:7447", "127.0.0.1:7447", ""] {
            check(other, None).unwrap_err();
        }
    }

    #[test]
    fn encrypted_connections_need_certificates_that_are_there() {
        let error = check("quic/learner:7447", None).unwrap_err();
        assert!(error.contains("certificates"), "{error}");
        let dir = tempfile::tempdir().unwrap();
        let files = TlsFiles::in_folder(dir.path());
        let error = check("quic/learner:7447", Some(&files)).unwrap_err();
        assert!(error.contains("ca.crt"), "the first missing file is named: {error}");
        for file in [&files.ca, &files.certificate, &files.key] {
            std::fs::write(file, "").unwrap();
        }
        check("quic/learner:7447", Some(&files)).unwrap();
    }

    /// The router's file must be one that this version of zenoh reads, and must give actors what the learner
    /// gives them.
    #[test]
    fn the_router_of_the_cluster_has_a_file_that_zenoh_reads_and_our_rules() {
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../docker/kubernetes/components/router/zenohd.json5"
        );
        let router = Config::from_file(path).unwrap();
        let own = {
            let mut config = Config::default();
            config.insert_json5("access_control", &access_control()).unwrap();
            config
        };
        let rules = |config: &Config| -> Vec<String> {
            let text = config.get_json("access_control").unwrap();
            let from = text.find("rollouts-in").unwrap();
            let to = text.find("learner-is-known").unwrap();
            text[from..to].split("\"id\"").map(str::to_owned).collect()
        };
        assert_eq!(rules(&router), rules(&own));
    }
}
