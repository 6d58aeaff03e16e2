//! Threads that each run libtorch on one core, over shards of a batch.
//!
//! libtorch's own threads gain little on networks of this size, since each of its many small operations would
//! have to be split and joined. Here each shard goes through forward and backward on one core without waiting
//! for others. How a batch is cut into shards does not depend on the number of threads, and results are
//! combined in the order of the shards: *the bits of an update do not depend on the number of threads.*

use std::sync::Arc;
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender, bounded};
use tch::Tensor;

use crate::LearnerError;
use crate::network::ActorCritic;

/// Rows of one shard on the CPU: its activations stay in a core's second-level cache.
pub const SHARD_ROWS: usize = 512;
/// Shards of a minibatch come in multiples of this: 1,536 rows as three shards would keep one of two threads
/// waiting for a third of the time.
const SHARD_MULTIPLE: usize = 4;
/// Jobs that may wait for one thread; callers hand over fewer at a time than this per call.
const QUEUE_LIMIT: usize = 4096;

type Job = Box<dyn FnOnce(&mut Worker) + Send>;

/// What a thread has in its hands.
#[derive(Debug)]
pub struct Worker {
    /// The network; its parameters are shared by all threads and change only while no job runs.
    pub net: ActorCritic,
    /// Room for gradients, reused from minibatch to minibatch: one per shard that the thread does in one
    /// call.
    gradients: Vec<ActorCritic>,
    used: usize,
}

impl Worker {
    fn new(net: ActorCritic) -> Self {
        Self {
            net,
            gradients: Vec::new(),
            used: 0,
        }
    }

    /// Room for one more gradient in this call, and the network.
    pub fn next_gradient(&mut self) -> (&ActorCritic, &ActorCritic) {
        if self.used == self.gradients.len() {
            self.gradients.push(self.net.zeros_like());
        }
        self.used += 1;
        (&self.net, &self.gradients[self.used - 1])
    }

    fn start_call(&mut self) {
        self.used = 0;
    }
}

/// The calling thread and `threads − 1` others. The others end when the pool is dropped.
#[derive(Debug)]
pub struct Pool {
    local: Worker,
    remote: Vec<Remote>,
}

#[derive(Debug)]
struct Remote {
    jobs: Option<Sender<Job>>,
    thread: Option<JoinHandle<()>>,
}

impl Pool {
    /// A pool of `threads` threads (at least one) that work on `net`. Sets libtorch to one thread per
    /// operation for the whole process where there is more than one.
    ///
    /// # Errors
    /// When the operating system refuses a thread.
    pub fn new(net: &ActorCritic, threads: usize) -> Result<Self, LearnerError> {
        tch::set_num_threads(1);
        let remote = (1..threads.max(1))
            .map(|number| Remote::start(net.share(), number))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            local: Worker::new(net.share()),
            remote,
        })
    }

    /// Threads, the calling one included.
    pub fn threads(&self) -> usize {
        self.remote.len() + 1
    }

    /// `work` on each input, spread over the threads by a fixed rule; answers in the order of the inputs.
    ///
    /// # Errors
    /// [`LearnerError::Worker`] when a thread has died.
    pub fn map<I, O>(
        &mut self,
        inputs: Vec<I>,
        work: fn(&mut Worker, I) -> O,
    ) -> Result<Vec<O>, LearnerError>
    where
        I: Send + 'static,
        O: Send + 'static,
    {
        let count = inputs.len();
        let threads = self.threads();
        let (answers, received) = bounded::<(usize, O)>(count);
        let answers = Arc::new(answers);
        let mut own = Vec::with_capacity(count / threads + 1);
        for (index, input) in inputs.into_iter().enumerate() {
            match index % threads {
                0 => own.push((index, input)),
                number => {
                    let answers = Arc::clone(&answers);
                    // The first job of a call makes all of the thread's gradient buffers free again.
                    let first = index < threads;
                    self.remote[number - 1].send(Box::new(move |worker| {
                        if first {
                            worker.start_call();
                        }
                        let _ = answers.send((index, work(worker, input)));
                    }))?;
                }
            }
        }
        drop(answers);
        let mut slots: Vec<Option<O>> = (0..count).map(|_| None).collect();
        self.local.start_call();
        for (index, input) in own {
            slots[index] = Some(work(&mut self.local, input));
        }
        collect(slots, &received)
    }
}

fn collect<O>(
    mut slots: Vec<Option<O>>,
    received: &Receiver<(usize, O)>,
) -> Result<Vec<O>, LearnerError> {
    // Ends when every job has answered or died: each holds a sender.
    for (index, output) in received {
        slots[index] = Some(output);
    }
    slots
        .into_iter()
        .collect::<Option<Vec<O>>>()
        .ok_or(LearnerError::Worker)
}

impl Remote {
    fn start(net: ActorCritic, number: usize) -> Result<Self, LearnerError> {
        let (jobs, queue) = bounded::<Job>(QUEUE_LIMIT);
        let thread = std::thread::Builder::new()
            .name(format!("learn-{number}"))
            .spawn(move || {
                let mut worker = Worker::new(net);
                let _no_grad = tch::no_grad_guard();
                for job in queue {
                    job(&mut worker);
                }
            })
            .map_err(LearnerError::Thread)?;
        Ok(Self {
            jobs: Some(jobs),
            thread: Some(thread),
        })
    }

    fn send(&self, job: Job) -> Result<(), LearnerError> {
        let jobs = self.jobs.as_ref().ok_or(LearnerError::Worker)?;
        jobs.send(job).map_err(|_| LearnerError::Worker)
    }
}

impl Drop for Remote {
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has been reported by the call that it failed.
            let _ = thread.join();
        }
    }
}

/// Cuts `rows` into shards of about equal size and at most `shard_rows`: (first row, rows). More than one
/// shard are a multiple of [`SHARD_MULTIPLE`], so that two or four threads have the same to do.
pub fn shards(rows: usize, shard_rows: usize) -> Vec<(usize, usize)> {
    let needed = rows.div_ceil(shard_rows.max(1));
    let count = if needed > 1 {
        needed.next_multiple_of(SHARD_MULTIPLE).min(rows)
    } else {
        needed
    };
    let cut = |part: usize| part * rows / count;
    (0..count)
        .map(|part| (cut(part), cut(part + 1) - cut(part)))
        .collect()
}

/// Rows `first .. first + len` of `t`, sharing its memory.
pub fn rows(t: &Tensor, (first, len): (usize, usize)) -> Tensor {
    t.narrow(0, first as i64, len as i64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::NetworkSpec;
    use caudata_config::NetworkConfig;
    use tch::Device;

    fn net() -> ActorCritic {
        let spec = NetworkSpec::new(&NetworkConfig::default(), 2, 1).unwrap();
        ActorCritic::new(spec, 1, Device::Cpu)
    }

    #[test]
    fn answers_come_in_order_from_any_number_of_threads() {
        for threads in [1, 2, 5] {
            let mut pool = Pool::new(&net(), threads).unwrap();
            let squares = pool.map((0..17).collect(), |_, n: i32| n * n).unwrap();
            assert_eq!(squares, (0..17).map(|n| n * n).collect::<Vec<_>>());
            assert_eq!(pool.threads(), threads);
        }
    }

    #[test]
    fn gradient_rooms_of_one_call_are_distinct_and_reused_by_the_next() {
        let mut pool = Pool::new(&net(), 1).unwrap();
        let room = |worker: &mut Worker, ()| worker.next_gradient().1.flat().data_ptr() as usize;
        let first = pool.map(vec![(), ()], room).unwrap();
        let second = pool.map(vec![(), ()], room).unwrap();
        assert_ne!(first[0], first[1]);
        assert_eq!(first, second);
    }

    #[test]
    fn a_dead_thread_is_an_error() {
        let mut pool = Pool::new(&net(), 2).unwrap();
        let outcome = pool.map(vec![0, 1], |_, n: i32| assert_eq!(n, 0, "dies on purpose"));
        assert!(matches!(outcome, Err(LearnerError::Worker)));
    }

    #[test]
    fn shards_cover_all_rows_once() {
        // 1100/512 needs three, four are 275 each
        assert_eq!(
            shards(1100, 512),
            [(0, 275), (275, 275), (550, 275), (825, 275)]
        );
        assert_eq!(shards(512, 512), [(0, 512)]);
        assert_eq!(shards(3, 1), [(0, 1), (1, 1), (2, 1)]);
        assert_eq!(shards(7, usize::MAX), [(0, 7)]);
        assert_eq!(shards(0, 512), []);
    }
}
