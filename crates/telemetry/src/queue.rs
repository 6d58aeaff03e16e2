//! Log lines through a queue: whoever logs never waits for whoever reads. A control loop must not stand still because a terminal does.

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

/// Lines that wait for a reader; further ones are lost, and counted.
pub(crate) const LINES_MAX: usize = 4096;
/// How often a flush looks whether everything is out.
const LOOK: Duration = Duration::from_millis(2);

/// The end that never waits. Cloning shares it.
#[derive(Clone, Debug)]
pub(crate) struct LineQueue {
    lines: SyncSender<Vec<u8>>,
    counts: Arc<Counts>,
}

#[derive(Debug, Default)]
struct Counts {
    queued: AtomicU64,
    written: AtomicU64,
    /// Lost since the last time that a line said so.
    lost: AtomicU64,
}

impl LineQueue {
    /// A queue of `lines_max` lines to `out`, written by a thread that lives as long as the process. `loss` makes a line of how many were
    /// lost.
    ///
    /// # Errors
    /// Where the system refuses the thread.
    pub(crate) fn start(
        out: impl Write + Send + 'static,
        lines_max: usize,
        loss: impl Fn(u64) -> String + Send + 'static,
    ) -> io::Result<Self> {
        let (lines, waiting) = sync_channel(lines_max);
        let counts = Arc::new(Counts::default());
        let shared = Arc::clone(&counts);
        std::thread::Builder::new()
            .name("log".into())
            .spawn(move || write_out(out, &waiting, &shared, &loss))?;
        Ok(Self { lines, counts })
    }

    /// Hands a line over. Never waits.
    pub(crate) fn push(&self, line: &[u8]) {
        self.counts.queued.fetch_add(1, Ordering::SeqCst);
        if self.lines.try_send(line.to_vec()).is_err() {
            self.counts.queued.fetch_sub(1, Ordering::SeqCst);
            self.counts.lost.fetch_add(1, Ordering::SeqCst);
        }
    }

    /// Waits until everything queued before is written, at most for `limit`; whether it is.
    pub(crate) fn flush(&self, limit: Duration) -> bool {
        let (end, wanted) = (
            Instant::now() + limit,
            self.counts.queued.load(Ordering::SeqCst),
        );
        while self.counts.written.load(Ordering::SeqCst) < wanted {
            if Instant::now() >= end {
                return false;
            }
            std::thread::sleep(LOOK);
        }
        true
    }
}

impl Write for LineQueue {
    /// One call is one line.
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.push(line);
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn write_out(
    mut out: impl Write,
    waiting: &Receiver<Vec<u8>>,
    counts: &Counts,
    loss: &dyn Fn(u64) -> String,
) {
    for line in waiting {
        let lost = counts.lost.swap(0, Ordering::SeqCst);
        // A reader that is gone does no harm.
        if lost > 0 {
            let _ = out.write_all(loss(lost).as_bytes());
        }
        let _ = out.write_all(&line);
        counts.written.fetch_add(1, Ordering::SeqCst);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    /// A reader that takes a line whenever the test lets it.
    #[derive(Clone, Default)]
    struct Reader {
        taken: Arc<Mutex<Vec<String>>>,
        asleep: Arc<Mutex<()>>,
    }

    impl Write for Reader {
        fn write(&mut self, line: &[u8]) -> io::Result<usize> {
            let _awake = self.asleep.lock().unwrap();
            let text = String::from_utf8(line.to_vec()).unwrap();
            self.taken.lock().unwrap().push(text);
            Ok(line.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    const PATIENCE: Duration = Duration::from_secs(60);

    #[test]
    fn nobody_waits_for_a_reader_that_sleeps_and_what_was_lost_is_told() {
        let reader = Reader::default();
        let queue = LineQueue::start(reader.clone(), 8, |n| format!("{n} lost\n")).unwrap();
        let asleep = reader.asleep.lock().unwrap();
        // Without the queue this would never end.
        for number in 0..100 {
            queue.push(format!("{number}\n").as_bytes());
        }
        assert!(!queue.flush(Duration::from_millis(20)));
        drop(asleep);
        assert!(queue.flush(PATIENCE));
        queue.push(b"last\n");
        assert!(queue.flush(PATIENCE));
        let taken = reader.taken.lock().unwrap().clone();
        let lost: u64 = taken
            .iter()
            .filter_map(|line| line.strip_suffix(" lost\n")?.parse::<u64>().ok())
            .sum();
        let whole = taken.iter().filter(|line| !line.ends_with("lost\n"));
        let whole: Vec<&str> = whole.map(|line| line.trim()).collect();
        assert_eq!(whole.len() as u64 + lost, 101, "{taken:?}");
        // One may be in the writer's hands beside the eight that wait.
        assert!((91..=92).contains(&lost), "{taken:?}");
        // The oldest come, in order.
        let first = (0..whole.len() - 1).map(|number| number.to_string());
        let expected: Vec<String> = first.chain(["last".to_owned()]).collect();
        assert_eq!(whole, expected);
    }
}
