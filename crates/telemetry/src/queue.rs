//! Log lines through a queue: whoever logs never waits for whoever reads. A control loop must not stand still
//! because a terminal does.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Lines that wait for a reader. Where there are more, the first half of them and the newest ones are kept:
/// how it began and how it ends.
pub(crate) const LINES_MAX: usize = 4096;
/// How often a flush looks whether everything is out.
const LOOK: Duration = Duration::from_millis(2);

/// The end that never waits for a reader. Cloning shares it.
#[derive(Clone, Debug)]
pub(crate) struct LineQueue {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    lines: Mutex<Lines>,
    came: Condvar,
}

/// What waits. Lines are numbered in the order in which they were pushed.
#[derive(Debug, Default)]
struct Lines {
    /// Most in each of the two.
    half: usize,
    /// The oldest ones.
    first: VecDeque<(u64, Vec<u8>)>,
    /// Those after the gap, where there is one; empty unless `first` is full, or was when they came.
    last: VecDeque<(u64, Vec<u8>)>,
    /// Lost in the gap, not yet told.
    lost: u64,
    pushed: u64,
    /// In the writer's hands.
    writing: Option<u64>,
}

impl Lines {
    fn push(&mut self, line: &[u8]) {
        let entry = (self.pushed, line.to_vec());
        self.pushed += 1;
        if self.last.is_empty() && self.lost == 0 && self.first.len() < self.half {
            self.first.push_back(entry);
            return;
        }
        if self.last.len() == self.half {
            self.last.pop_front();
            self.lost += 1;
        }
        self.last.push_back(entry);
    }

    /// The next line, and how many were lost right before it.
    fn pop(&mut self) -> Option<(u64, Vec<u8>)> {
        let (number, line, lost) = match self.first.pop_front() {
            Some((number, line)) => (number, line, 0),
            None => {
                let (number, line) = self.last.pop_front()?;
                (number, line, std::mem::take(&mut self.lost))
            }
        };
        self.writing = Some(number);
        Some((lost, line))
    }

    /// The oldest line that is not out yet.
    fn oldest(&self) -> Option<u64> {
        let of = |lines: &VecDeque<(u64, Vec<u8>)>| lines.front().map(|(number, _)| *number);
        self.writing.or_else(|| of(&self.first)).or_else(|| of(&self.last))
    }
}

impl LineQueue {
    /// A queue of `lines_max` lines (at least two) to `out`, written by a thread that lives as long as the
    /// process. `loss` makes a line of how many were lost.
    ///
    /// # Errors
    /// Where the system refuses the thread.
    pub(crate) fn start(
        out: impl Write + Send + 'static,
        lines_max: usize,
        loss: impl Fn(u64) -> String + Send + 'static,
    ) -> io::Result<Self> {
        let lines = Lines { half: (lines_max / 2).max(1), ..Lines::default() };
        let shared = Arc::new(Shared { lines: Mutex::new(lines), came: Condvar::new() });
        let writer = Arc::clone(&shared);
        std::thread::Builder::new()
            .name("log".into())
            .spawn(move || write_out(out, &writer, &loss))?;
        Ok(Self { shared })
    }

    /// Hands a line over. Never waits for the reader.
    pub(crate) fn push(&self, line: &[u8]) {
        self.shared.lock().push(line);
        self.shared.came.notify_one();
    }

    /// Waits until everything pushed before is written, or lost, at most for `limit`; whether it is.
    pub(crate) fn flush(&self, limit: Duration) -> bool {
        let (end, wanted) = (Instant::now() + limit, self.shared.lock().pushed);
        while self.shared.lock().oldest().is_some_and(|n| n < wanted) {
            if Instant::now() >= end {
                return false;
            }
            std::thread::sleep(LOOK);
        }
        true
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Lines> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner)
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

fn write_out(mut out: impl Write, shared: &Shared, loss: &dyn Fn(u64) -> String) {
    let mut lines = shared.lock();
    loop {
        let Some((lost, line)) = lines.pop() else {
            lines = shared.came.wait(lines).unwrap_or_else(PoisonError::into_inner);
            continue;
        };
        drop(lines);
        // A reader that is gone does no harm.
        if lost > 0 {
            let _ = out.write_all(loss(lost).as_bytes());
        }
        let _ = out.write_all(&line);
        lines = shared.lock();
        lines.writing = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
            self.taken.lock().unwrap().push(text.trim().to_owned());
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
        let taken = std::mem::take(&mut *reader.taken.lock().unwrap());
        // One may have been in the writer's hands beside the eight that waited. The beginning, the gap where
        // it was, and the end.
        let begin = taken.iter().position(|line| line.ends_with("lost")).unwrap();
        assert!((4..=5).contains(&begin), "{taken:?}");
        let lost = 100 - 4 - begin;
        let numbers = |range: std::ops::Range<usize>| range.map(|n| n.to_string());
        let expected: Vec<String> =
            numbers(0..begin).chain([format!("{lost} lost")]).chain(numbers(96..100)).collect();
        assert_eq!(taken, expected);
        // Afterwards nothing is missing.
        queue.push(b"later\n");
        assert!(queue.flush(PATIENCE));
        assert_eq!(*reader.taken.lock().unwrap(), ["later"]);
    }

    #[test]
    fn a_flush_waits_for_what_was_pushed_before_it_however_much_comes_after() {
        let mut lines = Lines { half: 2, ..Lines::default() };
        (0..3).for_each(|_| lines.push(b"a"));
        let wanted = lines.pushed;
        // Everything pushed since loses lines, but not the first.
        (0..9).for_each(|_| lines.push(b"b"));
        assert_eq!((lines.lost, lines.oldest()), (8, Some(0)));
        let mut out = Vec::new();
        while let Some((lost, line)) = lines.pop() {
            out.push((lost, line[0], lines.oldest().is_some_and(|n| n < wanted)));
            lines.writing = None;
        }
        let expected = [(0, b'a', true), (0, b'a', true), (8, b'b', false), (0, b'b', false)];
        assert_eq!(out, expected);
    }
}
