//! A real Slurm on this host: submit, grow, kill, requeue, shrink, stop. Skipped where Slurm is not installed
//! or this is not root.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use caudata_launch_tests::{has_tool, program, repository, skipped};
use serde_json::Value;

/// Longest wait for anything. Only a hang reaches it.
const PATIENCE: Duration = Duration::from_secs(300);

/// A Slurm with its daemons; they end with it.
struct Slurm {
    dir: tempfile::TempDir,
    port: u16,
    hosts: u32,
}

impl Slurm {
    /// On this host, or on so many with names and networks of their own.
    fn start(hosts: u32) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut start = script("start", dir.path());
        let output = start.arg(hosts.to_string()).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{said}");
        let probe = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = probe.local_addr().unwrap().port();
        Self { dir, port, hosts }
    }

    /// A command of ours or of Slurm's, against this Slurm.
    fn run(&self, program: &str, arguments: &[&str]) -> String {
        let binaries = caudata_launch_tests::program("caudata-actor").unwrap();
        let alone = [
            ("CAUDATA_SCHEME", "tcp".to_owned()),
            ("CAUDATA_HOST", "127.0.0.1".to_owned()),
            ("CAUDATA_PORT", self.port.to_string()),
        ];
        let output = Command::new(program)
            .args(arguments)
            .env("SLURM_CONF", self.dir.path().join("slurm.conf"))
            .env("CAUDATA_BIN", binaries.parent().unwrap())
            .env("CAUDATA_RUN_ID", "slurm-test")
            .envs(alone.into_iter().filter(|_| self.hosts == 0))
            .current_dir(repository())
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{program} {arguments:?}: {text}{errors}");
        log(&format!("$ {program} {}\n{text}", arguments.join(" ")));
        text
    }

    /// Submits a training with two actors.
    fn begin(&self, run: &Path, config: &Path) {
        let [run, config] = [run, config].map(|path| path.to_str().unwrap());
        self.submit(&["start", "--run", run, "--config", config, "--actors", "2"]);
    }

    fn submit(&self, arguments: &[&str]) -> String {
        let script = repository().join("docker/slurm/submit.sh");
        self.run(script.to_str().unwrap(), arguments)
    }

    /// Tasks of actors that run.
    fn running_actors(&self) -> usize {
        let queue = self.queue();
        queue.lines().filter(|line| line.contains("caudata-actor R")).count()
    }

    fn queue(&self) -> String {
        let output = Command::new("squeue")
            .args(["--noheader", "--array", "--format=%i %j %t"])
            .env("SLURM_CONF", self.dir.path().join("slurm.conf"))
            .output()
            .unwrap();
        String::from_utf8_lossy(&output.stdout).into_owned()
    }

    /// The learner's job goes back into the queue, as at the end of its time, and starts again. `before`: how
    /// many events there were.
    fn restart_learner(&self, run: &Path, before: usize) {
        let learner = std::fs::read_to_string(run.join("slurm-jobs")).unwrap();
        let learner =
            learner.lines().find_map(|line| line.strip_prefix("learner ")).unwrap().to_owned();
        self.run("scancel", &["--batch", "--signal=TERM", &learner]);
        wait_until("the learner has saved and said goodbye", || has(run, "finished", before));
        wait_until("its job waits in the queue", || {
            self.queue().lines().any(|line| line.starts_with(&learner) && line.ends_with(" PD"))
        });
        // Slurm waits two minutes before a job that was requeued starts; a test does not. But slurmd refuses a
        // launch whose credential is not younger, in whole seconds, than the end of the job's last start
        // ("already killed, do not launch"), and the job then fails for good.
        std::thread::sleep(Duration::from_secs(3));
        let release = ["update", &format!("JobId={learner}"), "StartTime=now"];
        wait_until("the learner started again", || {
            let _ = Command::new("scontrol")
                .args(release)
                .env("SLURM_CONF", self.dir.path().join("slurm.conf"))
                .output();
            has(run, "started", before)
        });
    }
}

impl Drop for Slurm {
    fn drop(&mut self) {
        let _ = script("stop", self.dir.path()).output();
    }
}

fn script(what: &str, dir: &Path) -> Command {
    let mut command = Command::new("sh");
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("one_host_slurm.sh"));
    command.arg(what).arg(dir);
    command
}

/// Shown with `--nocapture`; `docs/guide/clusters.md` has such a log.
#[allow(clippy::print_stdout)]
fn log(text: &str) {
    println!("{}", text.trim_end());
}

fn wait_until(what: &str, mut done: impl FnMut() -> bool) {
    let began = Instant::now();
    while !done() {
        assert!(began.elapsed() < PATIENCE, "{what}: not within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(200));
    }
    log(&format!("# {what}: after {:.1} s", began.elapsed().as_secs_f64()));
}

fn events(run: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(run.join("progress.jsonl")).unwrap_or_default();
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

fn iteration(run: &Path) -> u64 {
    let last = events(run).into_iter().rev().find(|event| event["event"] == "iteration");
    last.and_then(|event| event["iteration"].as_u64()).unwrap_or(0)
}

fn has(run: &Path, kind: &str, from: usize) -> bool {
    events(run).iter().skip(from).any(|event| event["event"] == kind)
}

const CONFIG: &str = r#"
[run]
iterations = 1000000
[actors]
count = 4
lanes = 8
chunk_steps = 16
max_lead = 1
policy_timeout_s = 280.0
[learner]
checkpoint_every = 10
batch_timeout_s = 3.0
min_batch_share = 0.25
[learner.network]
policy_hidden = [16]
value_hidden = [16]
[learner.ppo]
minibatches = 2
[telemetry]
metrics = false
"#;

/// Whether there is what the tests need, and `more`; says what is not.
fn can_run_slurm(more: &[&str]) -> bool {
    let needed = [&["munged", "slurmctld", "slurmd", "sbatch"], more].concat();
    if let Some(absent) = needed.into_iter().find(|tool| !has_tool(tool)) {
        skipped(&format!("{absent} is not installed (Debian: slurm-wlm munge)"));
        return false;
    }
    let is_root = std::fs::metadata("/proc/self").is_ok_and(|own| {
        use std::os::unix::fs::MetadataExt;
        own.uid() == 0
    });
    if !is_root {
        skipped("only root can start Slurm's daemons");
        return false;
    }
    if ["caudata", "caudata-learner", "caudata-actor"].iter().any(|name| program(name).is_none()) {
        skipped("the programs are not built");
        return false;
    }
    true
}

#[test]
fn a_training_is_submitted_grown_hurt_requeued_and_stopped() {
    if !can_run_slurm(&[]) {
        return;
    }
    let slurm = Slurm::start(0);
    let run: PathBuf = slurm.dir.path().join("run");
    let config = slurm.dir.path().join("cluster.toml");
    std::fs::write(&config, CONFIG).unwrap();
    let (run_word, config_word) = (run.to_str().unwrap(), config.to_str().unwrap());

    slurm.begin(&run, &config);
    wait_until("learning with two actors", || iteration(&run) >= 20);

    slurm.submit(&[
        "grow",
        "--run",
        run_word,
        "--config",
        config_word,
        "--from",
        "2",
        "--actors",
        "2",
    ]);
    wait_until("four actors run", || slurm.running_actors() == 4);

    // An actor dies without a word; its task starts it again as another incarnation.
    let ledgers = |actor: u32| {
        let prefix = format!("actor-{actor}-");
        let entries = std::fs::read_dir(run.join("ledgers")).unwrap().flatten();
        entries.filter(|e| e.file_name().to_string_lossy().starts_with(&prefix)).count()
    };
    assert_eq!(ledgers(0), 1);
    let victim = pid_of_actor(run_word, 0);
    log(&format!("$ kill -9 {victim}    # actor 0"));
    Command::new("kill").args(["-9", &victim.to_string()]).status().unwrap();
    wait_until("actor 0 is back as its next incarnation", || ledgers(0) == 2);
    let then = iteration(&run);
    wait_until("learning goes on", || iteration(&run) > then + 20);

    // The learner's job goes back into the queue, as at the end of its time; the actors wait and find it
    // again.
    let before = events(&run).len();
    slurm.restart_learner(&run, before);
    let started = events(&run).into_iter().skip(before).find(|e| e["event"] == "started").unwrap();
    assert!(started["iteration"].as_u64().unwrap() >= 20, "from its checkpoint: {started}");
    let then = started["iteration"].as_u64().unwrap();
    wait_until("learning goes on after the learner's return", || iteration(&run) > then + 20);

    slurm.submit(&["shrink", "--run", run_word, "--from", "2"]);
    wait_until("two actors are left", || slurm.running_actors() == 2);
    let then = iteration(&run);
    wait_until("learning goes on with two", || iteration(&run) > then + 20);

    slurm.submit(&["stop", "--run", run_word]);
    wait_until("nothing is left in the queue", || slurm.queue().trim().is_empty());
    accounts_for_everything(&run);
}

fn accounts_for_everything(run: &Path) {
    let accounting: Value =
        serde_json::from_str(&std::fs::read_to_string(run.join("accounting.json")).unwrap())
            .unwrap();
    log(&format!(
        "# accounting: sent {}, accepted {}, rejected {}, dropped {}, waiting {}",
        accounting["sent"],
        accounting["accepted"],
        accounting["rejected"],
        accounting["dropped"],
        accounting["waiting"]
    ));
    assert_eq!(accounting["holds"], true, "{accounting}");
    let number = |key: &str| accounting[key].as_u64().unwrap();
    assert_eq!(
        number("sent"),
        number("accepted") + number("rejected") + number("dropped") + number("waiting")
    );
    assert_eq!(number("rejected"), 0);
}

/// The process of actor `id` of this run.
fn pid_of_actor(run: &str, id: u32) -> u32 {
    let wanted = [format!("--actor-id\0{id}\0"), format!("{run}/ledgers/actor-{id}-")];
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    let mut found = processes.filter_map(|entry| {
        let pid: u32 = entry.file_name().to_str()?.parse().ok()?;
        let line = std::fs::read(entry.path().join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).into_owned();
        wanted.iter().all(|word| line.contains(word)).then_some(pid)
    });
    found.next().expect("the actor runs")
}

/// Four nodes with networks of their own: what the nodes are is only known when the job starts, so its
/// certificates are made then, and again on the node to which it comes back.
#[test]
fn over_several_hosts_certificates_are_issued_where_the_job_starts() {
    if !can_run_slurm(&["ip", "nsenter"]) {
        return;
    }
    let slurm = Slurm::start(4);
    let run: PathBuf = slurm.dir.path().join("run");
    let config = slurm.dir.path().join("cluster.toml");
    std::fs::write(&config, CONFIG).unwrap();
    slurm.begin(&run, &config);
    wait_until("learning over QUIC with two actors", || iteration(&run) >= 20);
    let address = || std::fs::read_to_string(run.join("address")).unwrap();
    let first = address();
    assert!(first.starts_with("quic/n") && first.contains(".lab:"), "{first}");
    assert_eq!(slurm.running_actors(), 2);
    slurm.run(
        program("caudata").unwrap().to_str().unwrap(),
        &["pki", "show", "--dir", run.join("pki").to_str().unwrap()],
    );

    // The node goes, and the learner's job comes back on another one.
    let node = first.trim_start_matches("quic/").split('.').next().unwrap();
    let node = format!("NodeName={node}");
    slurm.run("scontrol", &["update", &node, "State=DRAIN", "Reason=test"]);
    let before = events(&run).len();
    slurm.restart_learner(&run, before);
    let second = address();
    assert_ne!(first, second);
    let then = iteration(&run);
    wait_until("learning goes on with the learner elsewhere", || iteration(&run) > then + 20);

    slurm.submit(&["stop", "--run", run.to_str().unwrap()]);
    wait_until("nothing is left in the queue", || slurm.queue().trim().is_empty());
    accounts_for_everything(&run);
}
