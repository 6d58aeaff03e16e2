//! The live page: one robot walks in a browser, and whoever looks drives it.
//!
//! [`LivePage`] serves one page that needs nothing from outside. A lane of the engine is stepped in real time
//! while somebody looks, and at no other time; each step goes to every client as a server-sent event, and
//! [`Order`]s come back. All clients see and drive the same robot.
//!
//! *Invariant:* nothing is answered without the token that [`LivePage::address`] holds, and no training changes
//! without another; a client that does not keep up is cut off, and keeps nobody waiting.

mod hub;
mod order;
mod performance;
mod server;
mod stage;
mod training;

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use caudata_telemetry::progress::{Changed, Iteration};
use caudata_telemetry::{HttpServer, Joined, ServeError};
use serde::Serialize;
use tokio_rustls::TlsAcceptor;

pub use order::Order;
pub use performance::{Policy, Show};
pub use stage::Stage;
pub use training::{LookBeside, TakeChange, Training};

use hub::Hub;

/// Orders that may wait for the next step; more are refused.
const ORDERS_WAITING_MAX: usize = 64;

/// What may change in a training, and what has.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Settings {
    /// Keys with their values at present.
    pub values: Vec<(String, String)>,
    /// The changes that were made, in order, the newest.
    pub made: Vec<Changed>,
}

/// Why there is no live page.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// Its address cannot be had.
    #[error(transparent)]
    Serve(#[from] ServeError),
    /// The system gives no random bytes, or no thread.
    #[error("the live page cannot start: {0}")]
    Io(#[from] std::io::Error),
}

/// Serves the page until dropped.
#[derive(Debug)]
pub struct LivePage {
    /// Ends before the server does.
    _robot: Joined,
    scheme: &'static str,
    name: Option<String>,
    server: HttpServer,
    token: String,
    /// With which a training may be changed; empty where nothing can be.
    change: String,
    hub: Arc<Hub>,
    ended: Arc<AtomicBool>,
}

impl LivePage {
    /// Serves `show` at `addr` (port 0: any free port), within TLS where `tls` is there. At any address of this
    /// computer it is told by `name`.
    ///
    /// # Errors
    /// When the address is taken, or the system refuses a thread.
    pub fn start(
        addr: SocketAddr,
        name: Option<String>,
        show: Show,
        training: Option<Training>,
        tls: Option<TlsAcceptor>,
    ) -> Result<Self, LiveError> {
        let scheme = if tls.is_some() { "https" } else { "http" };
        let token = token()?;
        let change = match training {
            Some(_) => self::token()?,
            None => String::new(),
        };
        let hub = Arc::new(Hub::default());
        let (sender, orders) = crossbeam_channel::bounded(ORDERS_WAITING_MAX);
        let doors = server::Doors {
            token: token.clone(),
            change: change.clone(),
            orders: sender,
            training: training.map(Arc::new),
        };
        let router = server::router(&show.title(), doors, Arc::clone(&hub));
        let server = HttpServer::start(addr, "the live page", router, tls)?;
        let ended = Arc::new(AtomicBool::new(false));
        let _robot = {
            let (hub, ended) = (Arc::clone(&hub), Arc::clone(&ended));
            Joined::spawn("live robot", move || performance::perform(&show, &hub, &orders, &ended))?
        };
        Ok(Self {
            _robot,
            scheme,
            name: name.filter(|_| addr.ip().is_unspecified()),
            server,
            token,
            change,
            hub,
            ended,
        })
    }

    /// Where the page is, with the token that opens it.
    pub fn address(&self) -> String {
        let addr = self.server.addr();
        let named = |name: &String| format!("{name}:{}", addr.port());
        let at = self.name.as_ref().map_or(addr.to_string(), named);
        format!("{}://{at}/?token={}", self.scheme, self.token)
    }

    /// As [`Self::address`], with the token that lets a training be changed.
    pub fn changing_address(&self) -> String {
        format!("{}&change={}", self.address(), self.change)
    }

    /// Shows what may change in a training, and what has.
    pub fn settings(&self, settings: &Settings) {
        self.hub.keep("settings", settings);
    }

    /// Shows an iteration of training.
    pub fn training(&self, iteration: &Iteration) {
        self.hub.training(iteration);
    }

    /// Shows a line for people.
    pub fn note(&self, text: &str) {
        self.hub.say("note", &text);
    }
}

impl Drop for LivePage {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
    }
}

/// 128 random bits, hex.
fn token() -> std::io::Result<String> {
    use std::io::Read;
    let mut bytes = [0; 16];
    std::fs::File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(hex::encode(bytes))
}
