//! Who gets in over TLS, and what each role may call.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use caudata_model::RobotModel;
use caudata_policy::{Activation, Dense, MlpSpec, PolicyFile, PolicyMetadata, build_onnx};
use caudata_policy_server::{
    ServeOptions, ServerMetrics, SharedStore, Store, StoreLimits, listen, serve_with,
};
use caudata_proto::registry::StreamName;
use caudata_registry_client::{ClientError, RegistryClient, manifest_of};
use caudata_signing::pki::{Authority, Callers, PkiError, Request, Role, listen_as};
use caudata_task::{PolicyContract, TaskConfig};
use caudata_telemetry::Metrics;
use tokio::sync::watch;
use tokio_rustls::TlsAcceptor;
use tonic::Code;

fn certificate(authority: &Authority, role: Role, name: &str) -> PathBuf {
    certificate_of(authority, role, name, SystemTime::now())
}

/// Valid for a day from `from` on.
fn certificate_of(authority: &Authority, role: Role, name: &str, from: SystemTime) -> PathBuf {
    let request =
        Request { role, name: name.to_owned(), hosts: vec!["localhost".to_owned()], days: 1 };
    authority.issue(&request, from, false).unwrap()
}

fn of_the_lab(folder: &Path) -> Result<TlsAcceptor, PkiError> {
    listen_as(folder, Callers::OfTheLab, "h2")
}

/// A policy of one layer.
fn policy() -> PolicyFile {
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    let model = RobotModel::load(&robot).unwrap();
    let contract = PolicyContract::new(&model, &TaskConfig::default()).unwrap();
    let (obs, act) = (contract.obs_dim(), contract.act_dim());
    let spec = MlpSpec {
        obs_mean: vec![0.0; obs],
        obs_std: vec![1.0; obs],
        obs_clip: None,
        layers: vec![Dense {
            out: act,
            input: obs,
            weight: vec![0.5; act * obs],
            bias: vec![0.0; act],
        }],
        activation: Activation::Elu,
    };
    let metadata = PolicyMetadata {
        contract,
        version: 1,
        run_id: "run-1".into(),
        training_commit: String::new(),
        config_hash: String::new(),
        env_steps: 10,
        seed: 1,
        log_std: vec![0.0; act],
        created_unix_s: None,
        evaluation: None,
    };
    PolicyFile::parse(Arc::from(build_onnx(&spec, &metadata).unwrap())).unwrap()
}

fn code<T>(answer: Result<T, ClientError>) -> Result<T, Code> {
    answer.map_err(|error| match error {
        ClientError::Refused { code, .. } => code,
        other => panic!("not a refusal: {other:?}"),
    })
}

#[tokio::test]
async fn a_role_does_what_it_may_and_a_stranger_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let ours = Authority::create(&dir.path().join("ours"), "lab", SystemTime::now()).unwrap();
    let theirs = Authority::create(&dir.path().join("theirs"), "lab", SystemTime::now()).unwrap();
    let store = Store::open(&dir.path().join("data"), StoreLimits::default()).unwrap();
    let listener = listen("127.0.0.1:0".parse().unwrap()).await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let address = format!("https://localhost:{port}");
    let tls = of_the_lab(&certificate(&ours, Role::Server, "server")).unwrap();
    let (stop, stopped) = watch::channel(false);
    let metrics = ServerMetrics::register(&Metrics::new());
    let server = tokio::spawn(async move {
        let options = ServeOptions { tls: Some(tls), ..ServeOptions::default() };
        serve_with(listener, SharedStore::new(store), metrics, stopped, options).await.unwrap();
    });
    let client = |folder: &Path| RegistryClient::with_tls(&address, Some(folder)).unwrap();
    let stream = StreamName::new("polymander/test").unwrap();
    let file = policy();
    let manifest = manifest_of(stream.clone(), &file, 5).unwrap();

    for role in [Role::Robot, Role::Actor, Role::Router] {
        let mut client = client(&certificate(&ours, role, role.name()));
        let published = client.publish(manifest.clone(), file.bytes()).await;
        assert_eq!(code(published).err(), Some(Code::PermissionDenied), "{role}");
    }
    let mut learner = client(&certificate(&ours, Role::Learner, "learner"));
    let published = learner.publish(manifest, file.bytes()).await.unwrap();
    assert!(!published.already_present);

    // What operators released is not a learner's to change.
    let released = StreamName::new("release/flat").unwrap();
    let release = manifest_of(released, &file, 5).unwrap();
    let refused = learner.publish(release.clone(), file.bytes()).await;
    assert_eq!(code(refused).err(), Some(Code::PermissionDenied));
    let mut operator = client(&certificate(&ours, Role::Operator, "ana"));
    let unsigned = operator.publish(release.clone(), file.bytes()).await;
    assert_eq!(code(unsigned).err(), Some(Code::PermissionDenied));
    let mut release = release;
    release.signatures = vec![caudata_proto::registry::Signature {
        key_id: "release-1".into(),
        signature: vec![1; 64],
    }];
    operator.publish(release, file.bytes()).await.unwrap();

    for (role, reads) in [(Role::Robot, true), (Role::Operator, true), (Role::Actor, false)] {
        let name = format!("{role}-2");
        let mut client = client(&certificate(&ours, role, &name));
        let listed = code(client.list(Some(&stream), 10, None).await);
        match reads {
            true => assert_eq!(listed.unwrap().manifests.len(), 1, "{role}"),
            false => assert_eq!(listed.err(), Some(Code::PermissionDenied), "{role}"),
        }
    }

    // Another lab's authority has signed this one; the handshake fails.
    let mut stranger = client(&certificate(&theirs, Role::Learner, "learner"));
    let listed = stranger.list(Some(&stream), 10, None).await;
    assert!(
        matches!(listed, Err(ClientError::Unreachable { .. } | ClientError::Refused { .. })),
        "{listed:?}"
    );
    let mut plain = RegistryClient::new(&format!("localhost:{port}")).unwrap();
    assert!(plain.list(Some(&stream), 10, None).await.is_err(), "nothing is served in the open");

    drop((learner, operator, stranger, plain));
    stop.send(true).unwrap();
    server.await.unwrap();
}

/// A robot whose clock stands at another year sees certificates like these, and a server sees a robot's like
/// these.
#[tokio::test]
async fn fault_18_certificates_of_another_year_keep_a_robot_out_and_are_no_reason_to_give_up() {
    let dir = tempfile::tempdir().unwrap();
    let ours = Authority::create(&dir.path().join("ours"), "lab", SystemTime::now()).unwrap();
    let year = Duration::from_secs(366 * 86_400);
    let now = SystemTime::now();
    let stream = StreamName::new("polymander/test").unwrap();
    let times = [("past", now - year), ("future", now + year), ("now", now)];
    for (server_time, from) in times {
        let store = Store::open(&dir.path().join(server_time), StoreLimits::default()).unwrap();
        let listener = listen("127.0.0.1:0".parse().unwrap()).await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let name = format!("server-{server_time}");
        let tls = of_the_lab(&certificate_of(&ours, Role::Server, &name, from)).unwrap();
        let (stop, stopped) = watch::channel(false);
        let metrics = ServerMetrics::register(&Metrics::new());
        let server = tokio::spawn(async move {
            let options = ServeOptions { tls: Some(tls), ..ServeOptions::default() };
            serve_with(listener, SharedStore::new(store), metrics, stopped, options).await.unwrap();
        });
        for (robot_time, from) in times {
            let name = format!("robot-{server_time}-{robot_time}");
            let folder = certificate_of(&ours, Role::Robot, &name, from);
            let address = format!("https://localhost:{port}");
            let mut robot = RegistryClient::with_tls(&address, Some(&folder)).unwrap();
            let listed = robot.list(Some(&stream), 10, None).await;
            if [server_time, robot_time] == ["now", "now"] {
                assert_eq!(listed.unwrap().manifests.len(), 0);
                continue;
            }
            // Like a server that is away: a robot runs what is on its disk, and asks again later.
            let error = listed.unwrap_err();
            assert!(error.is_transient(), "{server_time} {robot_time}: {error:?}");
        }
        stop.send(true).unwrap();
        server.await.unwrap();
    }
}

#[test]
fn certificates_that_are_not_there_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let error = of_the_lab(dir.path()).err().unwrap();
    assert!(matches!(&error, PkiError::File { path, .. } if path.ends_with("ca.crt")), "{error}");
    let error = RegistryClient::with_tls("https://localhost:1", Some(dir.path())).unwrap_err();
    assert!(error.to_string().contains("ca.crt"), "{error}");
    let error = RegistryClient::with_tls("https://localhost:1", None).unwrap_err();
    assert!(matches!(error, ClientError::Certificates { .. }), "{error}");
}

#[test]
fn a_certificate_that_nobody_would_take_is_refused_with_the_reason() {
    let dir = tempfile::tempdir().unwrap();
    let ours = Authority::create(&dir.path().join("ours"), "lab", SystemTime::now()).unwrap();
    let server = certificate(&ours, Role::Server, "server");
    let refused = |folder: &Path, why: &str| {
        let error = of_the_lab(folder).err().unwrap().to_string();
        assert!(error.contains("tls.crt") && error.contains(why), "{error}");
    };
    refused(&certificate(&ours, Role::Robot, "robot"), "--role server");
    let other = certificate(&ours, Role::Server, "other");
    std::fs::copy(other.join("tls.key"), server.join("tls.key")).unwrap();
    refused(&server, "tls.key");
    std::fs::write(other.join("tls.crt"), "").unwrap();
    refused(&other, "holds no certificate");
}

#[tokio::test]
async fn tls_1_2_is_not_spoken() {
    use tokio_rustls::TlsConnector;
    use tokio_rustls::rustls::pki_types::pem::PemObject;
    use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
    use tokio_rustls::rustls::{ClientConfig, RootCertStore, SupportedProtocolVersion, version};

    let dir = tempfile::tempdir().unwrap();
    let ours = Authority::create(&dir.path().join("ours"), "lab", SystemTime::now()).unwrap();
    let folder = certificate(&ours, Role::Robot, "robot");
    let acceptor = of_the_lab(&certificate(&ours, Role::Server, "server")).unwrap();
    let shake = async |version: &'static SupportedProtocolVersion| {
        let mut roots = RootCertStore::empty();
        let authority = CertificateDer::from_pem_file(folder.join("ca.crt")).unwrap();
        roots.add(authority).unwrap();
        let own = CertificateDer::from_pem_file(folder.join("tls.crt")).unwrap();
        let key = PrivateKeyDer::from_pem_file(folder.join("tls.key")).unwrap();
        let provider = tokio_rustls::rustls::crypto::ring::default_provider();
        let config = ClientConfig::builder_with_provider(provider.into())
            .with_protocol_versions(&[version])
            .unwrap()
            .with_root_certificates(roots)
            .with_client_auth_cert(vec![own], key)
            .unwrap();
        let (here, there) = tokio::io::duplex(1 << 16);
        let server = tokio::spawn(acceptor.accept(there));
        let name = "localhost".try_into().unwrap();
        let client = TlsConnector::from(Arc::new(config)).connect(name, here).await;
        (client.is_ok(), server.await.unwrap().is_ok())
    };
    assert_eq!(shake(&version::TLS13).await, (true, true));
    assert_eq!(shake(&version::TLS12).await, (false, false));
}
