//! Helper processes: this test binary again, told by an environment variable to be an actor or a learner.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::Duration;

use caudata_transport::{TransportConfig, actor_link, learner_link};
use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde::{Deserialize, Serialize};

use super::frames::{Label, check, flush, frame, send, wait_until};
use super::rig::for_actors;

const ORDER: &str = "CAUDATA_TRANSPORT_TEST_ORDER";

/// What a helper process does.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(tag = "role", rename_all = "lowercase")]
pub enum Order {
    /// Sends `frames` frames of `bytes` bytes, flushes and ends. 0 frames: never ends by itself.
    Actor {
        run_id: String,
        sender: u64,
        incarnation: u64,
        frames: u64,
        bytes: usize,
        config: TransportConfig,
    },
    /// Receives for ever: prints its actors' configuration, then the number of each whole frame.
    Learner { run_id: String, config: TransportConfig },
}

/// A running helper; killed with signal 9 when dropped.
pub struct Helper {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl Helper {
    pub fn start(order: &Order) -> Self {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "helper_process", "--ignored", "--nocapture"])
            .args(["--test-threads", "1"])
            .env(ORDER, toml::to_string(order).unwrap())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        Self { child, output }
    }

    pub fn actor(
        run_id: &str,
        config: &TransportConfig,
        sender: u64,
        incarnation: u64,
        frames: u64,
        bytes: usize,
    ) -> Self {
        Self::start(&Order::Actor {
            run_id: run_id.to_owned(),
            sender,
            incarnation,
            frames,
            bytes,
            config: config.clone(),
        })
    }

    /// Kills with signal 9, in the middle of whatever it does.
    pub fn kill(mut self) {
        self.kill_and_wait();
    }

    fn kill_and_wait(&mut self) {
        // Already ended is as good.
        let _ = self.child.kill();
        self.child.wait().unwrap();
    }

    /// Waits for the end that the order foresees.
    pub fn join(mut self) {
        assert!(self.child.wait().unwrap().success());
    }

    /// Makes it stand still, every thread of it, as a debugger or a full disk would.
    pub fn stop(&self) {
        self.signal(Signal::SIGSTOP);
        let tasks = format!("/proc/{}/task", self.child.id());
        wait_until("the helper to stand still", || {
            let mut tasks = std::fs::read_dir(&tasks).unwrap();
            tasks.all(|task| {
                let stat = std::fs::read_to_string(task.unwrap().path().join("stat"));
                // "pid (name) state ..."; a thread that has just ended stands still enough.
                stat.map_or(true, |stat| stat.contains(") T "))
            })
        });
    }

    /// Lets it go on.
    pub fn go_on(&self) {
        self.signal(Signal::SIGCONT);
    }

    fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.child.id().try_into().unwrap());
        kill(pid, signal).unwrap();
    }

    /// The next line that begins with `mark`, without it. The test harness prints lines of its own.
    pub fn line(&mut self, mark: &str) -> String {
        loop {
            let mut line = String::new();
            let bytes = self.output.read_line(&mut line).unwrap();
            assert!(bytes > 0, "the helper has ended");
            if let Some((_, rest)) = line.trim_end().split_once(mark) {
                return rest.to_owned();
            }
        }
    }
}

impl Drop for Helper {
    fn drop(&mut self) {
        self.kill_and_wait();
    }
}

/// Body of a helper process; returns at once when this process is not one.
pub fn run_order() {
    let Ok(order) = std::env::var(ORDER) else {
        return;
    };
    // A test that aborts leaves no helper behind.
    set_pdeathsig(Signal::SIGKILL).unwrap();
    match toml::from_str(&order).unwrap() {
        Order::Actor { run_id, sender, incarnation, frames, bytes, config } => {
            let mut actor = actor_link(&config, &run_id, sender as u32).unwrap();
            let mut number = 0;
            while frames == 0 || number < frames {
                number += 1;
                let label = Label { sender, incarnation, number };
                send(&mut *actor, &frame(label, bytes));
            }
            flush(&mut *actor);
        }
        Order::Learner { run_id, config } => {
            let mut learner = learner_link(&config, &run_id).unwrap();
            let actor_config = toml::to_string(&learner.actor_config()).unwrap();
            say("config ", &format!("{actor_config:?}"));
            loop {
                if let Some(frame) = learner.recv(Duration::from_millis(100)).unwrap() {
                    say("frame ", &check(&frame.bytes).number.to_string());
                }
            }
        }
    }
}

fn say(mark: &str, text: &str) {
    let mut out = std::io::stdout().lock();
    writeln!(out, "\n{mark}{text}").unwrap();
    out.flush().unwrap();
}

/// Starts a learner in a process of its own. Returns it with what its actors are given.
pub fn start_learner(run_id: &str, config: &TransportConfig) -> (Helper, TransportConfig) {
    let mut helper =
        Helper::start(&Order::Learner { run_id: run_id.to_owned(), config: config.clone() });
    let quoted = helper.line("config ");
    // Debug quoting of a TOML document: newlines and quotes escaped.
    let text = quoted.trim_matches('"').replace("\\n", "\n").replace("\\\"", "\"");
    (helper, for_actors(toml::from_str(&text).unwrap(), config))
}
