//! Threads that each work on shards of a batch.
//!
//! Each shard goes through forward and backward on one core without waiting for others. How a batch is cut into
//! shards does not depend on the number of threads, and results are combined in the order of the shards: *the
//! bits of an update do not depend on the number of threads.* Who waits sleeps: nothing spins.

use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender, bounded};

use crate::LearnerError;

/// Rows of one shard: its activations stay in a core's second-level cache.
pub const SHARD_ROWS: usize = 512;
/// Shards of a minibatch come in multiples of this: 1,536 rows as three shards would keep one of two threads
/// waiting for a third of the time.
const SHARD_MULTIPLE: usize = 4;
/// Jobs that may wait for a thread.
const QUEUE_LIMIT: usize = 4096;

type Job<W> = Box<dyn FnOnce(&mut W) + Send>;

/// The calling thread and `threads − 1` others, each with a `W` of its own. The others end when the pool is
/// dropped.
#[derive(Debug)]
pub struct Pool<W> {
    local: W,
    /// `None` only while the pool is dropped.
    jobs: Option<Sender<Job<W>>>,
    queue: Receiver<Job<W>>,
    remote: Vec<JoinHandle<()>>,
}

impl<W: Default + Send + 'static> Pool<W> {
    /// A pool of `threads` threads (at least one).
    ///
    /// # Errors
    /// When the operating system refuses a thread.
    pub fn new(threads: usize) -> Result<Self, LearnerError> {
        let (jobs, queue) = bounded::<Job<W>>(QUEUE_LIMIT);
        let start = |number: usize| {
            let queue = queue.clone();
            std::thread::Builder::new()
                .name(format!("learn-{number}"))
                .spawn(move || {
                    let mut worker = W::default();
                    for job in queue {
                        job(&mut worker);
                    }
                })
                .map_err(LearnerError::Thread)
        };
        let remote = (1..threads.max(1)).map(start).collect::<Result<_, _>>()?;
        Ok(Self { local: W::default(), jobs: Some(jobs), queue, remote })
    }

    /// `work` on each input, by whichever thread is free: one that another program keeps from its core holds up
    /// one input and not its share of all. Answers in the order of the inputs.
    ///
    /// # Errors
    /// [`LearnerError::Worker`] when a thread has died.
    pub fn map<I, O>(
        &mut self,
        inputs: Vec<I>,
        work: fn(&mut W, I) -> O,
    ) -> Result<Vec<O>, LearnerError>
    where
        I: Send + 'static,
        O: Send + 'static,
    {
        let count = inputs.len();
        if self.remote.is_empty() {
            let local = &mut self.local;
            return Ok(inputs.into_iter().map(|input| work(local, input)).collect());
        }
        let (answers, received) = bounded::<(usize, O)>(count);
        let jobs = self.jobs.as_ref().ok_or(LearnerError::Worker)?;
        for (index, input) in inputs.into_iter().enumerate() {
            let answers = answers.clone();
            let job: Job<W> = Box::new(move |worker| {
                let _ = answers.send((index, work(worker, input)));
            });
            // A full queue is this thread's to empty.
            if let Err(error) = jobs.try_send(job) {
                error.into_inner()(&mut self.local);
            }
        }
        drop(answers);
        while let Ok(job) = self.queue.try_recv() {
            job(&mut self.local);
        }
        collect(count, &received)
    }
}

impl<W> Drop for Pool<W> {
    fn drop(&mut self) {
        self.jobs = None;
        for thread in self.remote.drain(..) {
            // A thread that panicked has been reported by the call that it failed.
            let _ = thread.join();
        }
    }
}

fn collect<O>(count: usize, received: &Receiver<(usize, O)>) -> Result<Vec<O>, LearnerError> {
    let mut slots: Vec<Option<O>> = (0..count).map(|_| None).collect();
    // Ends when every job has answered or died: each holds a sender.
    for (index, output) in received {
        slots[index] = Some(output);
    }
    slots.into_iter().collect::<Option<Vec<O>>>().ok_or(LearnerError::Worker)
}

/// Cuts `rows` into shards of about equal size and at most `shard_rows`: (first row, rows). More than one
/// shard are a multiple of [`SHARD_MULTIPLE`], so that two or four threads have the same to do.
pub fn shards(rows: usize, shard_rows: usize) -> Vec<(usize, usize)> {
    let needed = rows.div_ceil(shard_rows.max(1));
    let count = if needed > 1 { needed.next_multiple_of(SHARD_MULTIPLE).min(rows) } else { needed };
    let cut = |part: usize| part * rows / count;
    (0..count).map(|part| (cut(part), cut(part + 1) - cut(part))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_come_in_order_from_any_number_of_threads() {
        for threads in [1, 2, 5] {
            let mut pool = Pool::<()>::new(threads).unwrap();
            let squares = pool.map((0..17).collect(), |(), n: i32| n * n).unwrap();
            assert_eq!(squares, (0..17).map(|n| n * n).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_dead_thread_is_an_error() {
        let mut pool = Pool::<()>::new(2).unwrap();
        // The calling thread takes one input and is busy with it until the other thread has had the other.
        let outcome = pool.map(vec![(), ()], |(), ()| {
            let own = std::thread::current().name() != Some("learn-1");
            assert!(own, "dies on purpose");
            std::thread::sleep(std::time::Duration::from_millis(200));
        });
        assert!(matches!(outcome, Err(LearnerError::Worker)));
    }

    #[test]
    fn shards_cover_all_rows_once() {
        // 1100/512 needs three, four are 275 each
        assert_eq!(shards(1100, 512), [(0, 275), (275, 275), (550, 275), (825, 275)]);
        assert_eq!(shards(512, 512), [(0, 512)]);
        assert_eq!(shards(3, 1), [(0, 1), (1, 1), (2, 1)]);
        assert_eq!(shards(7, usize::MAX), [(0, 7)]);
        assert_eq!(shards(0, 512), []);
    }
}
