//! A thread that does not outlive what it works for.

use std::io;
use std::thread::{Builder, JoinHandle};

/// A thread; dropped, it is waited for. Fields are dropped in order: what tells the thread to end stands
/// before it.
#[derive(Debug)]
pub struct Joined(Option<JoinHandle<()>>);

impl Joined {
    /// Starts it.
    ///
    /// # Errors
    /// The system refuses the thread.
    pub fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> io::Result<Self> {
        Ok(Self(Some(Builder::new().name(name.into()).spawn(work)?)))
    }
}

impl Drop for Joined {
    fn drop(&mut self) {
        if let Some(thread) = self.0.take() {
            let _ = thread.join();
        }
    }
}
