//! Threads that stay: starting one costs more than a control period of a few hundred lanes.

use rayon_core::{ThreadPool, ThreadPoolBuilder};

/// A fixed number of threads, the caller's own included.
pub(super) struct Pool {
    /// `None`: the caller works alone.
    others: Option<ThreadPool>,
}

impl Pool {
    /// `threads` in all (at least one: the caller's). Fewer if the system refuses to start more.
    pub fn new(threads: usize) -> Self {
        let start = |others| {
            ThreadPoolBuilder::new()
                .num_threads(others)
                .thread_name(|k| format!("sim-{}", k + 1))
                .build()
                .ok()
        };
        Self { others: (1..threads).rev().find_map(start) }
    }

    /// Threads that work.
    pub fn threads(&self) -> usize {
        1 + (self.others.as_ref()).map_or(0, ThreadPool::current_num_threads)
    }

    /// Runs `task(0)` here and `task(1)`, … on the other threads, and waits for all of them.
    pub fn run(&self, task: &(dyn Fn(usize) + Sync)) {
        let Some(others) = &self.others else { return task(0) };
        others.in_place_scope(|scope| {
            scope.spawn_broadcast(|_, at| task(at.index() + 1));
            task(0);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::panic::{AssertUnwindSafe, catch_unwind};
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[test]
    fn every_thread_does_its_task_every_time() {
        let pool = Pool::new(3);
        let done = [const { AtomicUsize::new(0) }; 3];
        for _ in 0..100 {
            pool.run(&|k| {
                done[k].fetch_add(1, Ordering::Relaxed);
            });
        }
        assert!(done.iter().all(|d| d.load(Ordering::Relaxed) == 100));
    }

    #[test]
    fn a_panic_arrives_after_all_are_done() {
        let pool = Pool::new(3);
        let done = AtomicUsize::new(0);
        let outcome = catch_unwind(AssertUnwindSafe(|| {
            pool.run(&|k| {
                assert!(k != 1, "one fails");
                done.fetch_add(1, Ordering::Relaxed);
            });
        }));
        assert!(outcome.is_err());
        assert_eq!(done.load(Ordering::Relaxed), 2);
        pool.run(&|_| {
            done.fetch_add(1, Ordering::Relaxed);
        });
        assert_eq!(done.load(Ordering::Relaxed), 5);
    }
}
