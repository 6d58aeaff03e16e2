//! Threads that stay: starting one costs more than a control period of a few hundred lanes.
//!
//! Task `k` runs on thread `k`. Both sides look for each other a short while before they sleep: waking a thread takes as long as a group of lanes.
#![allow(unsafe_code)]

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::mpsc::{Receiver, RecvError, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;

type Panic = Box<dyn std::any::Any + Send>;

/// A task that outlives its worker's use of it (see [`Pool::run`]).
#[derive(Clone, Copy)]
struct Task(*const (dyn Fn(usize) + Sync));

// SAFETY: what it points to is `Sync`, and `Pool::run` keeps it alive until every worker has answered.
unsafe impl Send for Task {}

struct Worker {
    tasks: Option<SyncSender<Task>>,
    thread: Option<JoinHandle<()>>,
}

/// How often a thread looks for its message before it sleeps: some 20 µs, less than a group of lanes takes for a control period.
const LOOKS: u32 = 400;

/// The next message.
fn receive<T>(from: &Receiver<T>) -> Result<T, RecvError> {
    for _ in 0..LOOKS {
        match from.try_recv() {
            Ok(message) => return Ok(message),
            Err(TryRecvError::Disconnected) => return Err(RecvError),
            Err(TryRecvError::Empty) => std::hint::spin_loop(),
        }
    }
    from.recv()
}

/// A fixed number of threads, the caller's own included.
pub(super) struct Pool {
    workers: Vec<Worker>,
    answers: Receiver<Result<(), Panic>>,
}

impl Pool {
    /// `threads` in all (at least one: the caller's). Fewer if the system refuses to start more.
    pub fn new(threads: usize) -> Self {
        // one answer per worker and task
        let (answer, answers) = sync_channel(threads);
        let workers = (1..threads)
            .map_while(|index| start(index, answer.clone()))
            .collect();
        Self { workers, answers }
    }

    /// Threads that work.
    pub fn threads(&self) -> usize {
        self.workers.len() + 1
    }

    /// Runs `task(0)` here and `task(1)`, … on the other threads, and waits for all of them.
    pub fn run(&self, task: &(dyn Fn(usize) + Sync)) {
        // SAFETY: only the lifetime is forgotten; this function does not return before every worker that was told has answered, whatever
        // panics on the way, so the reference is never used after its end.
        let forgotten = Task(unsafe {
            std::mem::transmute::<*const (dyn Fn(usize) + Sync + '_), *const (dyn Fn(usize) + Sync)>(
                task,
            )
        });
        let mut told = 0;
        for worker in &self.workers {
            if let Some(tasks) = &worker.tasks
                && tasks.send(forgotten).is_ok()
            {
                told += 1;
            }
        }
        let mut outcome = catch_unwind(AssertUnwindSafe(|| task(0)));
        for _ in 0..told {
            // a worker answers every task that it took; it holds a sender as long as it lives
            match receive(&self.answers) {
                Ok(Ok(())) => {}
                Ok(Err(panic)) => outcome = Err(panic),
                Err(_) => break,
            }
        }
        if let Err(panic) = outcome {
            resume_unwind(panic);
        }
    }
}

fn start(index: usize, answer: SyncSender<Result<(), Panic>>) -> Option<Worker> {
    // never more than one task at a time
    let (tasks, inbox) = sync_channel::<Task>(1);
    let work = move || {
        while let Ok(task) = receive(&inbox) {
            // SAFETY: `Pool::run` keeps it alive until the answer below.
            let task = unsafe { &*task.0 };
            let outcome = catch_unwind(AssertUnwindSafe(|| task(index)));
            if answer.send(outcome).is_err() {
                return;
            }
        }
    };
    let thread = std::thread::Builder::new()
        .name(format!("sim-{index}"))
        .spawn(work)
        .ok()?;
    Some(Worker {
        tasks: Some(tasks),
        thread: Some(thread),
    })
}

impl Drop for Pool {
    fn drop(&mut self) {
        for worker in &mut self.workers {
            worker.tasks = None; // ends its loop
            if let Some(thread) = worker.thread.take() {
                let _ = thread.join();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
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
