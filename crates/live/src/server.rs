//! The page over HTTP: `/` is the page, `/events` what happens, `/order` what is asked for.

use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::extract::{DefaultBodyLimit, State};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, HeaderName, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use caudata_evaluation::report;
use caudata_telemetry::Connection;
use crossbeam_channel::{Sender, TrySendError};
use tokio_stream::wrappers::ReceiverStream;

use crate::hub::Hub;
use crate::order::Order;

/// Longest order, bytes.
const ORDER_BYTES_MAX: usize = 1024;
/// Header that orders carry the token in.
const TOKEN_HEADER: &str = "x-caudata-token";
/// The page asks nobody but its own server.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; \
    connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// What a stranger sees.
const CLOSED: &str = "This page opens only at the address that caudata printed in the terminal.\n";

const FRAME: &str = include_str!("page/live.html");
const STYLE: &str = include_str!("page/live.css");
const SCRIPT: [&str; 3] = [
    include_str!("page/charts.js"),
    include_str!("page/drive.js"),
    include_str!("page/live.js"),
];

struct Shared {
    page: Bytes,
    token: String,
    hub: Arc<Hub>,
    orders: Sender<Order>,
}

impl Shared {
    /// Whether a request has the token, in its address or its header. How long the comparison takes does not
    /// tell how much of a token is right.
    fn admits(&self, uri: &Uri, headers: &HeaderMap) -> bool {
        let query = uri.query().unwrap_or_default();
        let given = query
            .split('&')
            .find_map(|pair| pair.strip_prefix("token="))
            .or_else(|| headers.get(TOKEN_HEADER)?.to_str().ok())
            .unwrap_or_default();
        let differing = given
            .bytes()
            .zip(self.token.bytes())
            .fold(0, |differing, (a, b)| differing | (a ^ b));
        given.len() == self.token.len() && differing == 0
    }
}

/// The page for a robot named `title`; only requests with `token` are answered.
pub fn router(title: String, token: String, hub: Arc<Hub>, orders: Sender<Order>) -> Router {
    let script = [report::COMMON_SCRIPT.concat(), SCRIPT.concat()].concat();
    let style = [report::STYLE, STYLE].concat();
    let page = report::fill(FRAME, &style, &script, &title, "{}").into();
    let shared = Shared {
        page,
        token,
        hub,
        orders,
    };
    Router::new()
        .route("/", get(page_of))
        .route("/events", get(events))
        .route("/order", post(order))
        .fallback(|| async { (StatusCode::FORBIDDEN, CLOSED) })
        .layer(DefaultBodyLimit::max(ORDER_BYTES_MAX))
        .with_state(Arc::new(shared))
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

async fn page_of(State(shared): State<Arc<Shared>>, uri: Uri, headers: HeaderMap) -> Response {
    if !shared.admits(&uri, &headers) {
        return (StatusCode::FORBIDDEN, CLOSED).into_response();
    }
    (private("text/html; charset=utf-8"), shared.page.clone()).into_response()
}

async fn events(
    State(shared): State<Arc<Shared>>,
    Extension(connection): Extension<Connection>,
    uri: Uri,
    headers: HeaderMap,
) -> Response {
    if !shared.admits(&uri, &headers) {
        return (StatusCode::FORBIDDEN, CLOSED).into_response();
    }
    let Some(queue) = shared.hub.join(connection.clone()) else {
        let full = "As many pages as may look at once look already; close one.\n";
        return (StatusCode::SERVICE_UNAVAILABLE, full).into_response();
    };
    connection.keep();
    let stream = Body::from_stream(ReceiverStream::new(queue));
    (private("text/event-stream"), stream).into_response()
}

async fn order(
    State(shared): State<Arc<Shared>>,
    uri: Uri,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    if !shared.admits(&uri, &headers) {
        return (StatusCode::FORBIDDEN, CLOSED).into_response();
    }
    let order = match Order::parse(&body) {
        Ok(order) => order,
        Err(wrong) => return (StatusCode::BAD_REQUEST, format!("{wrong}\n")).into_response(),
    };
    match shared.orders.try_send(order) {
        Ok(()) => StatusCode::NO_CONTENT.into_response(),
        Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {
            (StatusCode::SERVICE_UNAVAILABLE, "too many orders wait\n").into_response()
        }
    }
}
