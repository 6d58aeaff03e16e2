//! What the tests of the server share. Each of them uses a part of it.
#![allow(dead_code)]

use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_policy::{Activation, Dense, MlpSpec, PolicyFile, PolicyMetadata, build_onnx};
use caudata_policy_server::{
    ServeOptions, ServerMetrics, SharedStore, Store, StoreLimits, listen, serve_with,
};
use caudata_proto::registry::StreamName;
use caudata_registry_client::{ClientError, RegistryClient, manifest_of};
use caudata_task::{PolicyContract, TaskConfig};
use caudata_telemetry::Metrics;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tonic::Code;

/// A real server on a port of its own.
pub struct Server {
    pub address: std::net::SocketAddr,
    pub client: RegistryClient,
    pub metrics: ServerMetrics,
    pub trouble: watch::Receiver<Option<String>>,
    pub stop: watch::Sender<bool>,
    pub ended: JoinHandle<()>,
}

impl Server {
    pub async fn start(data: &Path, limits: StoreLimits) -> Self {
        Self::start_with(data, limits, ServeOptions::default()).await
    }

    pub async fn start_with(data: &Path, limits: StoreLimits, options: ServeOptions) -> Self {
        let store = Store::open(data, limits).unwrap();
        Self::over("127.0.0.1:0".parse().unwrap(), store, options).await
    }

    /// On a port that stays open when the server stops: the next one goes on there.
    pub async fn on(port: &std::net::TcpListener, data: &Path) -> Self {
        // The last call of the server before may hold the store for a moment after that has ended.
        let mut opened = Store::open(data, StoreLimits::default());
        for _ in 0..100 {
            if opened.is_ok() {
                break;
            }
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
            opened = Store::open(data, StoreLimits::default());
        }
        let store = opened.unwrap();
        let port = port.try_clone().unwrap();
        port.set_nonblocking(true).unwrap();
        let listener = tokio::net::TcpListener::from_std(port).unwrap();
        Self::serving(listener, store, ServeOptions::default())
    }

    pub async fn over(address: std::net::SocketAddr, store: Store, options: ServeOptions) -> Self {
        Self::serving(listen(address).await.unwrap(), store, options)
    }

    fn serving(listener: tokio::net::TcpListener, store: Store, options: ServeOptions) -> Self {
        let address = listener.local_addr().unwrap();
        let (stop, stopped) = watch::channel(false);
        let metrics = ServerMetrics::register(&Metrics::new());
        let counted = metrics.clone();
        let store = SharedStore::new(store);
        let trouble = store.trouble();
        let ended = tokio::spawn(async move {
            serve_with(listener, store, counted, stopped, options).await.unwrap();
        });
        Self {
            address,
            client: RegistryClient::new(&address.to_string()).unwrap(),
            metrics,
            trouble,
            stop,
            ended,
        }
    }

    pub async fn stop(self) {
        drop(self.client);
        self.stop.send(true).unwrap();
        self.ended.await.unwrap();
    }
}

pub fn stream() -> StreamName {
    StreamName::new("polymander/test").unwrap()
}

/// A real policy file whose weights depend on `version`.
pub fn policy(version: u64) -> PolicyFile {
    policy_of(version, None)
}

/// As [`policy`], with a hidden layer.
pub fn policy_of(version: u64, hidden: Option<usize>) -> PolicyFile {
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    let model = RobotModel::load(&robot).unwrap();
    let contract = PolicyContract::new(&model, &TaskConfig::default()).unwrap();
    let (obs, act) = (contract.obs_dim(), contract.act_dim());
    let dense = |out, input| Dense {
        out,
        input,
        weight: vec![version as f32; out * input],
        bias: vec![0.0; out],
    };
    let spec = MlpSpec {
        obs_mean: vec![0.0; obs],
        obs_std: vec![1.0; obs],
        obs_clip: None,
        layers: match hidden {
            None => vec![dense(act, obs)],
            Some(hidden) => vec![dense(hidden, obs), dense(act, hidden)],
        },
        activation: Activation::Elu,
    };
    let metadata = PolicyMetadata {
        contract,
        version,
        run_id: "run-1".into(),
        training_commit: String::new(),
        config_hash: String::new(),
        env_steps: 10 * version,
        seed: 1,
        log_std: vec![0.0; act],
        created_unix_s: None,
        evaluation: None,
    };
    PolicyFile::parse(Arc::from(build_onnx(&spec, &metadata).unwrap())).unwrap()
}

pub async fn publish(client: &mut RegistryClient, file: &PolicyFile) -> Result<bool, ClientError> {
    let manifest = manifest_of(stream(), file, 5).unwrap();
    let published = client.publish(manifest, file.bytes()).await?;
    Ok(published.already_present)
}

pub fn code(error: &ClientError) -> Code {
    match error {
        ClientError::Refused { code, .. } => *code,
        other => panic!("not a refusal: {other:?}"),
    }
}
