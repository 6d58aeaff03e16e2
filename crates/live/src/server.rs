//! The page over HTTP: `/` is the page, `/events` what happens, `/order` what is asked of the robot, `/change` what
//! is asked of a training, `/beside` that training beside other runs.

use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, HeaderName, StatusCode, Uri};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use caudata_evaluation::report;
use caudata_telemetry::Connection;
use crossbeam_channel::{Sender, TrySendError};
use tokio::sync::Semaphore;
use tokio_stream::wrappers::ReceiverStream;

use crate::hub::Hub;
use crate::order::Order;
use crate::training::Training;

/// Longest order, bytes.
const ORDER_BYTES_MAX: usize = 1024;
/// Longest change of a training, bytes.
const CHANGE_BYTES_MAX: usize = 16 << 10;
/// Header that orders carry the token in.
const TOKEN_HEADER: &str = "x-caudata-token";
/// Header that changes of a training carry their token in.
const CHANGE_HEADER: &str = "x-caudata-change";
/// The page asks nobody but its own server.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; \
    connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// One comparison of runs at a time: each reads two whole files.
static BESIDE: Semaphore = Semaphore::const_new(1);
/// What a stranger sees.
const CLOSED: &str = "This page opens only at the address that caudata printed in the terminal.\n";

const FRAME: &str = include_str!("page/live.html");
const STYLE: &str = include_str!("page/live.css");
const SCRIPT: [&str; 5] = [
    include_str!("page/beside.js"),
    include_str!("page/charts.js"),
    include_str!("page/drive.js"),
    include_str!("page/settings.js"),
    include_str!("page/live.js"),
];

/// Who may, and where what they ask for goes.
pub struct Doors {
    /// To look and to drive.
    pub token: String,
    /// To change a training.
    pub change: String,
    pub orders: Sender<Order>,
    pub training: Option<Arc<Training>>,
}

struct Shared {
    page: Bytes,
    doors: Doors,
    hub: Arc<Hub>,
}

impl Shared {
    /// Whether a request has the token, in its address or its header.
    fn admits(&self, uri: &Uri, headers: &HeaderMap) -> bool {
        let query = uri.query().unwrap_or_default();
        let given = query
            .split('&')
            .find_map(|pair| pair.strip_prefix("token="))
            .or_else(|| headers.get(TOKEN_HEADER)?.to_str().ok())
            .unwrap_or_default();
        is_token(given, &self.doors.token)
    }
}

/// How long the comparison takes does not tell how much of a token is right.
fn is_token(given: &str, token: &str) -> bool {
    let pairs = given.bytes().zip(token.bytes());
    let differing = pairs.fold(0, |differing, (a, b)| differing | (a ^ b));
    given.len() == token.len() && differing == 0
}

/// The page for a robot named `title`; only requests with the token are answered.
pub fn router(title: &str, doors: Doors, hub: Arc<Hub>) -> Router {
    let script = [report::COMMON_SCRIPT.concat(), SCRIPT.concat()].concat();
    let style = [report::STYLE, STYLE].concat();
    let page = report::fill(FRAME, &style, &script, title, "{}").into();
    let shared = Arc::new(Shared { page, doors, hub });
    Router::new()
        .route("/", get(page_of))
        .route("/events", get(events))
        .route("/order", post(order))
        .route("/beside", post(beside))
        .route("/change", post(change).layer(DefaultBodyLimit::max(CHANGE_BYTES_MAX)))
        .fallback(|| async { closed() })
        .layer(DefaultBodyLimit::max(ORDER_BYTES_MAX))
        .layer(from_fn_with_state(shared.clone(), admitted))
        .with_state(shared)
}

/// Turns strangers away before anything of theirs is read.
async fn admitted(State(shared): State<Arc<Shared>>, request: Request, next: Next) -> Response {
    if shared.admits(request.uri(), request.headers()) { next.run(request).await } else { closed() }
}

fn closed() -> Response {
    (StatusCode::FORBIDDEN, CLOSED).into_response()
}

/// Headers of every answer that says something.
fn private(kind: &'static str) -> [(HeaderName, &'static str); 5] {
    [
        (CONTENT_TYPE, kind),
        (CACHE_CONTROL, "no-store"),
        (REFERRER_POLICY, "no-referrer"),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (CONTENT_SECURITY_POLICY, POLICY),
    ]
}

async fn page_of(State(shared): State<Arc<Shared>>) -> Response {
    (private("text/html; charset=utf-8"), shared.page.clone()).into_response()
}

async fn events(
    State(shared): State<Arc<Shared>>,
    Extension(connection): Extension<Connection>,
) -> Response {
    let Some(queue) = shared.hub.join(connection.clone()) else {
        let full = "As many pages as may look at once look already; close one.\n";
        return (StatusCode::SERVICE_UNAVAILABLE, full).into_response();
    };
    connection.keep();
    let stream = Body::from_stream(ReceiverStream::new(queue));
    (private("text/event-stream"), stream).into_response()
}

async fn order(State(shared): State<Arc<Shared>>, body: Bytes) -> Response {
    let order = match Order::parse(&body) {
        Ok(order) => order,
        Err(wrong) => return (StatusCode::BAD_REQUEST, format!("{wrong}\n")).into_response(),
    };
    match shared.doors.orders.try_send(order) {
        Ok(()) => StatusCode::NO_CONTENT.into_response(),
        Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {
            (StatusCode::SERVICE_UNAVAILABLE, "too many orders wait\n").into_response()
        }
    }
}

/// A list of settings, `key=value` each.
async fn change(State(shared): State<Arc<Shared>>, headers: HeaderMap, body: Bytes) -> Response {
    let given = headers.get(CHANGE_HEADER).and_then(|v| v.to_str().ok());
    let may = is_token(given.unwrap_or_default(), &shared.doors.change);
    let Some(training) = shared.doors.training.clone().filter(|_| may) else { return closed() };
    let set = match serde_json::from_slice::<Vec<String>>(&body) {
        Ok(set) => set,
        Err(wrong) => return (StatusCode::BAD_REQUEST, format!("{wrong}\n")).into_response(),
    };
    // It writes a file: not on the thread that streams.
    match tokio::task::spawn_blocking(move || (training.take)(&set)).await {
        Ok(Ok(())) => StatusCode::NO_CONTENT.into_response(),
        Ok(Err(wrong)) => (StatusCode::BAD_REQUEST, format!("{wrong}\n")).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// The name of a run, or null for those that there are.
async fn beside(State(shared): State<Arc<Shared>>, body: Bytes) -> Response {
    let Some(training) = shared.doors.training.clone() else { return closed() };
    let run = match serde_json::from_slice::<Option<String>>(&body) {
        Ok(run) => run,
        Err(wrong) => return (StatusCode::BAD_REQUEST, format!("{wrong}\n")).into_response(),
    };
    let Ok(_alone) = BESIDE.try_acquire() else {
        let busy = "another comparison is being made; ask again\n";
        return (StatusCode::SERVICE_UNAVAILABLE, busy).into_response();
    };
    // It reads files: not on the thread that streams.
    match tokio::task::spawn_blocking(move || (training.beside)(run.as_deref())).await {
        Ok(Ok(found)) => (private("application/json"), found.to_string()).into_response(),
        Ok(Err(wrong)) => (StatusCode::BAD_REQUEST, format!("{wrong}\n")).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}
