//! The store as service, page and probes share it.

use std::sync::Arc;

use parking_lot::{Mutex, MutexGuard};
use tokio::sync::watch;

use crate::store::Store;

/// The store, and what is wrong with it, which can be asked while the store waits for its disk.
#[derive(Clone, Debug)]
pub struct SharedStore {
    store: Arc<Mutex<Store>>,
    trouble: watch::Sender<Option<String>>,
}

impl SharedStore {
    /// Shares `store`.
    pub fn new(store: Store) -> Self {
        let trouble = watch::Sender::new(store.trouble().map(str::to_owned));
        Self { store: Arc::new(Mutex::new(store)), trouble }
    }

    /// Waits for it.
    pub fn lock(&self) -> MutexGuard<'_, Store> {
        self.store.lock()
    }

    /// Does `work` on it, and tells whoever watches where that showed or ended trouble.
    pub fn with<T>(&self, work: impl FnOnce(&mut Store) -> T) -> T {
        let mut store = self.lock();
        let result = work(&mut store);
        let trouble = store.trouble().map(str::to_owned);
        drop(store);
        self.trouble.send_if_modified(|known| std::mem::replace(known, trouble.clone()) != trouble);
        result
    }

    /// Why it cannot be changed; `None`: it can.
    pub fn trouble(&self) -> watch::Receiver<Option<String>> {
        self.trouble.subscribe()
    }
}
