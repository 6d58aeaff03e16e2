//! Ends processes that do not end by themselves, so that a test which waits for one fails instead of hanging.

use std::os::fd::{AsRawFd, RawFd};
use std::path::PathBuf;
use std::process::{Child, Output};
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// How long a process may take: only one that hangs takes so long.
pub const PATIENCE: Duration = Duration::from_secs(300);

/// Watches a process. Dropped once that has ended, it does nothing.
pub struct Watchdog {
    done: Option<SyncSender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Watchdog {
    /// Ends `child` and all that it started, where it is still there after [`PATIENCE`].
    pub fn over(child: &Child) -> Self {
        Self::over_for(child, PATIENCE)
    }

    /// The same after `patience`.
    pub fn over_for(child: &Child, patience: Duration) -> Self {
        let pid = child.id();
        let ends = [
            child.stdout.as_ref().map(AsRawFd::as_raw_fd),
            child.stderr.as_ref().map(AsRawFd::as_raw_fd),
        ];
        let pipes: Vec<PathBuf> = ends.into_iter().flatten().filter_map(pipe_of).collect();
        let (done, waits) = sync_channel::<()>(0);
        let thread = std::thread::spawn(move || {
            if waits.recv_timeout(patience) == Err(RecvTimeoutError::Timeout) {
                eprintln!("process {pid} does not end, or its output does not: killed");
                // Also those that are stopped, and those whose parents are gone, which still hold its output
                // open.
                for pid in family(pid).into_iter().chain(holders(&pipes)) {
                    let _ = kill(Pid::from_raw(pid as i32), Signal::SIGKILL);
                }
            }
        });
        Self { done: Some(done), thread: Some(thread) }
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        self.done = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// `pid` and all that it started, as far as their parents still are there.
fn family(pid: u32) -> Vec<u32> {
    let parents: Vec<(u32, u32)> = std::fs::read_dir("/proc")
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| {
            let pid = entry.file_name().to_str()?.parse().ok()?;
            let status = std::fs::read_to_string(entry.path().join("status")).ok()?;
            let parent = status.lines().find_map(|line| line.strip_prefix("PPid:"))?;
            Some((pid, parent.trim().parse().ok()?))
        })
        .collect();
    let mut family = vec![pid];
    let mut at = 0;
    while let Some(&parent) = family.get(at) {
        let children = parents.iter().filter(|(_, of)| *of == parent);
        family.extend(children.map(|(child, _)| *child));
        at += 1;
    }
    family
}

/// Name of the pipe behind a descriptor of this process.
fn pipe_of(descriptor: RawFd) -> Option<PathBuf> {
    let name = std::fs::read_link(format!("/proc/self/fd/{descriptor}")).ok()?;
    name.to_str()?.starts_with("pipe:").then_some(name)
}

/// Processes other than this one that have one of `pipes` open.
fn holders(pipes: &[PathBuf]) -> Vec<u32> {
    let holds = |pid: &u32| {
        let open = std::fs::read_dir(format!("/proc/{pid}/fd"));
        let mut names = open.into_iter().flatten().flatten();
        names.any(|entry| std::fs::read_link(entry.path()).is_ok_and(|name| pipes.contains(&name)))
    };
    std::fs::read_dir("/proc")
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
        .filter(|pid| *pid != std::process::id())
        .filter(holds)
        .collect()
}

/// What a program says until it ends, which it must within `patience`.
pub fn output_within(child: Child, patience: Duration) -> Output {
    let _dog = Watchdog::over_for(&child, patience);
    child.wait_with_output().unwrap()
}
