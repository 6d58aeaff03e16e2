//! A candidate is first loaded and run in a child process with little memory and little time: what crashes or
//! hangs there never reaches the process that moves the robot.

use std::io::{Read, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use caudata_proto::checks::Check;
use caudata_telemetry::ExitCode;
use nix::sys::resource::{Resource, setrlimit};

use crate::DeployError;
use crate::state::PolicyRef;
use crate::verify::Refusal;

/// How long a child may take, its start included.
pub const CHILD_DEADLINE: Duration = Duration::from_secs(30);
/// Processor time of a child, s.
pub const CHILD_CPU_S: u64 = 10;
/// Address space of a child, bytes. ONNX Runtime reserves a few hundred MiB of it without using them.
pub const CHILD_SPACE_BYTES: u64 = 2 << 30;
/// How often a child is looked at.
const LOOK: Duration = Duration::from_millis(10);
/// Most of what a child says that is kept, bytes.
const WORDS_MAX: u64 = 16 << 10;

/// Holds this process to the memory and the processor time of a child that tries a candidate, for good; what
/// goes beyond ends it.
///
/// # Errors
/// [`DeployError::System`].
pub fn limit_this_process() -> Result<(), DeployError> {
    let limits = [
        (Resource::RLIMIT_AS, CHILD_SPACE_BYTES, "a limit of memory"),
        (Resource::RLIMIT_CPU, CHILD_CPU_S, "a limit of processor time"),
        (Resource::RLIMIT_CORE, 0, "a limit of core files"),
    ];
    for (resource, limit, what) in limits {
        setrlimit(resource, limit, limit).map_err(DeployError::system(what))?;
    }
    Ok(())
}

/// The program that probes: this one, with the command `probe`.
#[derive(Clone, Debug)]
pub struct ProbeProgram {
    /// The program.
    pub program: PathBuf,
    /// Robot file.
    pub robot: PathBuf,
    /// See [`CHILD_DEADLINE`].
    pub deadline: Duration,
}

/// What a child came to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Probed {
    /// It ran the policy and found nothing wrong.
    Passed,
    /// It found something wrong, and says what.
    Refused(String),
    /// It ended otherwise than a program should, or not in time.
    Died(String),
    /// It could not do its work, which says nothing about the policy.
    Unable(String),
}

/// Looks at what a child came to.
pub type ChildCheck = fn(&Probed) -> Result<(), Refusal>;

/// What a child that tried a candidate must have come to.
pub const CHILD: &[Check<ChildCheck>] = &[
    // It came back.
    Check::new("child lived", |probed| match probed {
        Probed::Died(how) => Err(Refusal::KilledItsProbe { how: how.clone() }),
        _ => Ok(()),
    }),
    // And found nothing wrong.
    Check::new("child content", |probed| match probed {
        Probed::Refused(reason) => Err(Refusal::ByItsProbe(reason.clone())),
        _ => Ok(()),
    }),
];

impl Probed {
    /// Refuses what these checks find.
    ///
    /// # Errors
    /// [`Refusal::KilledItsProbe`], [`Refusal::ByItsProbe`].
    pub fn check(&self, checks: &[Check<ChildCheck>]) -> Result<(), Refusal> {
        checks.iter().try_for_each(|check| (check.refuse)(self))
    }
}

impl ProbeProgram {
    /// Probes `bytes`, which are said to be `policy`.
    pub fn run(&self, policy: &PolicyRef, bytes: &[u8]) -> Probed {
        let child = Command::new(&self.program)
            .arg("probe")
            .arg("--robot")
            .arg(&self.robot)
            .args(["--stream", &policy.stream])
            .args(["--version-number", &policy.version.to_string()])
            .args(["--file-version", &policy.file_version().to_string()])
            .args(["--sha256", &policy.sha256.to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn();
        match child {
            Ok(child) => self.watch(child, bytes),
            Err(error) => Probed::Unable(error.to_string()),
        }
    }

    fn watch(&self, mut child: Child, bytes: &[u8]) -> Probed {
        let (stdin, stderr) = (child.stdin.take(), child.stderr.take());
        // In threads of their own: a child that neither reads nor speaks must not hold this one.
        let words = std::thread::scope(|scope| {
            scope.spawn(move || {
                if let Some(mut stdin) = stdin {
                    // A child that has seen enough hangs up.
                    let _ = stdin.write_all(bytes);
                }
            });
            let words = scope.spawn(move || {
                let mut text = Vec::new();
                if let Some(stderr) = stderr {
                    let _ = stderr.take(WORDS_MAX).read_to_end(&mut text);
                }
                String::from_utf8_lossy(&text).into_owned()
            });
            let ended = wait(&mut child, self.deadline);
            (ended, words.join().unwrap_or_default())
        });
        let (ended, text) = words;
        let error = text.lines().find_map(|line| line.strip_prefix("error: "));
        let said = error.unwrap_or("it says nothing").to_owned();
        match ended {
            Err(how) => Probed::Died(how),
            Ok(0) => Probed::Passed,
            Ok(code) if code == i32::from(ExitCode::PolicyRefused.number()) => {
                Probed::Refused(said)
            }
            Ok(_) => Probed::Unable(said),
        }
    }
}

/// The exit code of a child; `Err` where it has none, or took too long and was killed.
fn wait(child: &mut Child, deadline: Duration) -> Result<i32, String> {
    let end = Instant::now() + deadline;
    loop {
        match child.try_wait() {
            Ok(Some(status)) => return status.code().ok_or_else(|| status.to_string()),
            Ok(None) if Instant::now() < end => std::thread::sleep(LOOK),
            late => {
                let _ = child.kill();
                let _ = child.wait();
                return Err(match late {
                    Err(error) => error.to_string(),
                    Ok(_) => format!("it took more than {} s", deadline.as_secs_f32()),
                });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use caudata_proto::checks::each_left_out;

    use super::*;
    use crate::state::Sha256Digest;

    /// What a shell script in place of the program comes to, fed with a megabyte.
    fn script(text: &str, deadline: Duration) -> Probed {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("probe.sh");
        // Written by a shell: a file that this process writes may still be open in the child of another test
        // that is just being started, and is then too busy to be run.
        let mut shell = Command::new("/bin/sh");
        shell.args(["-c", "printf %s \"$1\" > \"$0\" && chmod 700 \"$0\""]);
        shell.arg(&program).arg(format!("#!/bin/sh\n{text}\n"));
        assert!(shell.status().unwrap().success());
        let probe = ProbeProgram { program, robot: "r.toml".into(), deadline };
        let policy = PolicyRef {
            stream: "s".into(),
            version: 1,
            sha256: Sha256Digest([0; 32]),
            reverts_to: None,
        };
        probe.run(&policy, &vec![0; 1 << 20])
    }

    #[test]
    fn each_step_and_no_other_keeps_out_what_a_child_did_not_bear() {
        let table = each_left_out(CHILD, |name, checks| {
            let text = match name {
                "child lived" => "kill -SEGV $$",
                _ => "cat > /dev/null; echo 'error: bad' >&2; exit 77",
            };
            script(text, LONG).check(checks)
        });
        // Seen with --nocapture: `make mutants`.
        eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
    }

    const LONG: Duration = Duration::from_secs(60);

    /// Not a test: what a child does that wants more than it may have, where the variable says what. Run as
    /// one it has nothing to do.
    #[test]
    fn greedy_child() {
        let Ok(wants) = std::env::var(GREEDY) else { return };
        limit_this_process().unwrap();
        let mut kept: Vec<Vec<u8>> = Vec::new();
        loop {
            match wants.as_str() {
                "memory" => kept.push(Vec::with_capacity(64 << 20)),
                // Work that no compiler leaves out.
                _ => kept.push(vec![kept.len() as u8; 16]),
            }
            std::hint::black_box(&mut kept);
            if wants == "time" && kept.len() > 1000 {
                kept.clear();
            }
        }
    }

    const GREEDY: &str = "CAUDATA_TEST_GREEDY_CHILD";

    #[test]
    fn fault_31_a_child_that_reaches_its_limit_of_memory_or_time_is_ended_by_it() {
        let this = std::env::current_exe().unwrap();
        let greedy = |wants: &str| {
            let this = this.display();
            let text = format!(
                "export {GREEDY}={wants}; exec '{this}' --exact probe::tests::greedy_child --nocapture"
            );
            // Far beyond what it may use of a processor, so that it is not this that ends it.
            script(&text, Duration::from_secs(600))
        };
        // SIGABRT: no memory is left. SIGKILL: no processor time is.
        for (wants, signal) in [("memory", "signal: 6"), ("time", "signal: 9")] {
            let probed = greedy(wants);
            assert!(
                matches!(&probed, Probed::Died(how) if how.contains(signal)),
                "{wants}: {probed:?}"
            );
        }
    }

    #[test]
    fn fault_31_a_candidate_that_crashes_or_hangs_the_child_is_found_out() {
        assert_eq!(script("cat > /dev/null", LONG), Probed::Passed);
        let crash = script("kill -SEGV $$", LONG);
        assert!(matches!(&crash, Probed::Died(how) if how.contains("11")), "{crash:?}");
        let abort = script("kill -ABRT $$", LONG);
        assert!(matches!(&abort, Probed::Died(how) if how.contains('6')), "{abort:?}");
        let hang = script("exec sleep 1000", Duration::from_millis(300));
        assert!(matches!(&hang, Probed::Died(how) if how.contains("0.3 s")), "{hang:?}");
        let refused = script("echo 'error: policy s version 1 refused: bad' >&2; exit 77", LONG);
        assert_eq!(refused, Probed::Refused("policy s version 1 refused: bad".into()));
        assert!(matches!(script("exit 66", LONG), Probed::Unable(_)));
    }
}
