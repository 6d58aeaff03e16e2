//! The clients: what each is sent, how many there are, and when one is cut off.

use std::convert::Infallible;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use caudata_telemetry::Connection;
use caudata_telemetry::progress::Iteration;
use parking_lot::{Condvar, Mutex};
use serde::Serialize;
use tokio::sync::mpsc::{Receiver, Sender, channel, error::TrySendError};

/// Clients at once.
const CLIENTS_MAX: usize = 5;
/// Events that may wait for one client, about 2.5 s of frames. One that is further behind is cut off.
const EVENTS_WAITING_MAX: usize = 128;
/// Iterations of training that are kept; of more, every second one is.
const ITERATIONS_KEPT_MAX: usize = 512;
/// Iterations come to the page no faster.
const ITERATION_EVERY: Duration = Duration::from_millis(200);

/// One event, or a part of the stream, as it goes over the wire.
pub type Event = Result<Bytes, Infallible>;

/// All clients.
#[derive(Debug, Default)]
pub struct Hub {
    inner: Mutex<Inner>,
    came: Condvar,
}

#[derive(Debug, Default)]
struct Inner {
    clients: Vec<Client>,
    /// The newest event of each kind that a new client needs, in the order in which it needs them.
    kept: Vec<(&'static str, Bytes)>,
    history: History,
}

#[derive(Debug)]
struct Client {
    queue: Sender<Event>,
    connection: Connection,
}

/// Iterations as JSON, thinned.
#[derive(Debug)]
struct History {
    points: Vec<String>,
    every: u64,
    told: Option<Instant>,
}

impl Default for History {
    fn default() -> Self {
        Self { points: Vec::new(), every: 1, told: None }
    }
}

impl History {
    fn add(&mut self, number: u64, point: &str) {
        if !number.is_multiple_of(self.every) {
            return;
        }
        self.points.push(point.to_owned());
        if self.points.len() > ITERATIONS_KEPT_MAX {
            let mut last = false;
            self.points.retain(|_| {
                last = !last;
                !last
            });
            self.every *= 2;
        }
    }
}

/// An event of the stream. JSON has no line breaks, which would end it.
fn event(name: &str, data: &str) -> Bytes {
    format!("event:{name}\ndata:{data}\n\n").into()
}

impl Hub {
    /// Takes a client in, with what it must know first; `None` when there are as many as there may be.
    pub fn join(&self, connection: Connection) -> Option<Receiver<Event>> {
        let mut inner = self.inner.lock();
        inner.clients.retain(|client| !client.queue.is_closed());
        if inner.clients.len() >= CLIENTS_MAX {
            return None;
        }
        let (queue, events) = channel(EVENTS_WAITING_MAX);
        let mut first: Vec<Bytes> = inner.kept.iter().map(|(_, event)| event.clone()).collect();
        if !inner.history.points.is_empty() {
            let points = inner.history.points.join(",");
            first.push(event("history", &format!("[{points}]")));
        }
        for event in first {
            // Far fewer than there is room for.
            let _ = queue.try_send(Ok(event));
        }
        inner.clients.push(Client { queue, connection });
        self.came.notify_all();
        Some(events)
    }

    /// Waits at most `patience` for somebody who looks.
    pub fn is_watched(&self, patience: Duration) -> bool {
        let mut inner = self.inner.lock();
        inner.clients.retain(|client| !client.queue.is_closed());
        if inner.clients.is_empty() {
            self.came.wait_for(&mut inner, patience);
        }
        !inner.clients.is_empty()
    }

    /// Sends a value to every client.
    pub fn say(&self, name: &'static str, value: &impl Serialize) {
        self.send(&mut self.inner.lock(), event(name, &json(value)));
    }

    /// As [`Self::say`]; clients that come later are told too.
    pub fn keep(&self, name: &'static str, value: &impl Serialize) {
        let event = event(name, &json(value));
        let mut inner = self.inner.lock();
        match inner.kept.iter_mut().find(|(kept, _)| *kept == name) {
            Some(kept) => kept.1 = event.clone(),
            None => inner.kept.push((name, event.clone())),
        }
        self.send(&mut inner, event);
    }

    /// One step of the robot: numbers, four decimals each.
    pub fn frame(&self, row: &[f32]) {
        use std::fmt::Write;
        let mut text = String::with_capacity(8 * row.len() + 16);
        text.push_str("data:[");
        for (i, value) in row.iter().enumerate() {
            let value = if value.is_finite() { *value } else { 0.0 };
            let comma = if i > 0 { "," } else { "" };
            let _ = write!(text, "{comma}{value:.4}");
        }
        text.push_str("]\n\n");
        self.send(&mut self.inner.lock(), text.into());
    }

    /// One iteration of training.
    pub fn training(&self, iteration: &Iteration) {
        let point = json(iteration);
        let mut inner = self.inner.lock();
        inner.history.add(iteration.iteration, &point);
        let last = iteration.iteration >= iteration.iterations;
        let due = inner.history.told.is_none_or(|told| told.elapsed() >= ITERATION_EVERY);
        if (due || last) && !inner.clients.is_empty() {
            inner.history.told = Some(Instant::now());
            self.send(&mut inner, event("training", &point));
        }
    }

    fn send(&self, inner: &mut Inner, event: Bytes) {
        inner.clients.retain(|client| match client.queue.try_send(Ok(event.clone())) {
            Ok(()) => true,
            Err(TrySendError::Closed(_)) => false,
            Err(TrySendError::Full(_)) => {
                tracing::info!("a client of the live page does not keep up, and is cut off");
                client.connection.cut();
                false
            }
        });
    }
}

/// What has no JSON form is nothing: all that is sent has one.
fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).unwrap_or_else(|_| "null".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(events: &mut Receiver<Event>) -> String {
        let Ok(event) = events.try_recv().unwrap();
        String::from_utf8(event.to_vec()).unwrap()
    }

    #[test]
    fn a_client_is_told_first_what_it_must_know() {
        let hub = Hub::default();
        hub.keep("robot", &1);
        hub.keep("ground", &2);
        hub.keep("robot", &3);
        let mut events = hub.join(Connection::default()).unwrap();
        hub.frame(&[0.25, f32::NAN]);
        assert_eq!(text(&mut events), "event:robot\ndata:3\n\n");
        assert_eq!(text(&mut events), "event:ground\ndata:2\n\n");
        assert_eq!(text(&mut events), "data:[0.2500,0.0000]\n\n");
    }

    #[test]
    fn clients_are_few_and_slow_ones_are_dropped() {
        let hub = Hub::default();
        let mut all: Vec<_> =
            (0..CLIENTS_MAX).map(|_| hub.join(Connection::default()).unwrap()).collect();
        assert!(hub.join(Connection::default()).is_none());
        // All but the first read.
        for _ in 0..=EVENTS_WAITING_MAX {
            hub.frame(&[0.0]);
            for events in &mut all[1..] {
                text(events);
            }
        }
        assert_eq!(hub.inner.lock().clients.len(), CLIENTS_MAX - 1);
        all.clear();
        assert!(!hub.is_watched(Duration::ZERO));
    }

    #[test]
    fn a_long_history_is_thinned() {
        let mut history = History::default();
        for number in 1..=10_000 {
            history.add(number, &number.to_string());
        }
        assert!((200..=ITERATIONS_KEPT_MAX).contains(&history.points.len()));
        let numbers: Vec<u64> = history.points.iter().map(|p| p.parse().unwrap()).collect();
        assert!(numbers.windows(2).all(|pair| pair[0] < pair[1]));
        assert!(*numbers.last().unwrap() > 9_900);
    }
}
