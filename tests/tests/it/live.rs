//! The live page of the real program: by its protocol, and driven in a browser.

mod browser;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use caudata_tests::{FEW_SAMPLES, TINY, command, skipped};
use nix::sys::signal::Signal;
use serde_json::{Value, json};

use browser::Browser;

/// Most bytes of the page.
const PAGE_BYTES_MAX: usize = 1_500_000;

/// A program that serves a live page.
struct Served {
    child: Child,
    /// `127.0.0.1:port`
    host: String,
    token: String,
    /// With which a training is changed; empty without one.
    change: String,
}

impl Served {
    /// `caudata play` with these flags.
    fn play(flags: &[&str]) -> Self {
        let mut command = command("caudata", &["play"]).unwrap();
        command.args(flags);
        Self::start(command, false)
    }

    /// A tiny training without an end, in `run`.
    fn train(run: &Path) -> Self {
        let mut command = command("caudata", &["train"]).unwrap();
        command.args(TINY.iter().filter(|flag| **flag != "--json"));
        command.args(FEW_SAMPLES).arg("--out").arg(run);
        command.args(["--iterations", "1000000"]);
        command.args(["--set", "learner.publish_every=5"]);
        Self::start(command, true)
    }

    /// Waits for the address, and reads what else is printed, so that nothing waits for a reader.
    fn start(mut command: Command, trains: bool) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let mut after =
            |mark: &str| lines.find_map(|line| Some(line.ok()?.split_once(mark)?.1.to_owned()));
        let address = after("http://");
        let change = if trains { after("&change=") } else { None };
        std::thread::spawn(move || lines.for_each(drop));
        let address = address.expect("an address");
        let (host, token) = address.split_once("/?token=").expect("a token");
        Self {
            host: host.to_owned(),
            token: token.trim().to_owned(),
            change: change.unwrap_or_default(),
            child,
        }
    }

    fn address(&self) -> String {
        format!("http://{}/?token={}", self.host, self.token)
    }

    /// Sends a request, with what belongs into its head, and gives the connection.
    fn request(&self, line: &str, headers: &str, body: &str) -> TcpStream {
        let mut stream = TcpStream::connect(&self.host).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        let length = body.len();
        write!(
            stream,
            "{line} HTTP/1.1\r\nHost: x\r\n{headers}Content-Length: {length}\r\n\r\n{body}"
        )
        .unwrap();
        stream
    }

    /// The whole answer.
    fn ask(&self, line: &str, headers: &str, body: &str) -> String {
        let mut answer = String::new();
        let mut stream = self.request(line, headers, body);
        stream.read_to_string(&mut answer).unwrap();
        answer
    }

    fn order(&self, order: &Value) -> String {
        let token = format!("x-caudata-token: {}\r\n", self.token);
        self.ask("POST /order", &token, &order.to_string())
    }

    /// Asks for a change of the training, with this token for it.
    fn change(&self, token: &str, set: &[&str]) -> String {
        let (look, set) = (&self.token, json!(set).to_string());
        let headers = format!("x-caudata-token: {look}\r\nx-caudata-change: {token}\r\n");
        self.ask("POST /change", &headers, &set)
    }

    fn events(&self) -> Events {
        let line = format!("GET /events?token={}", self.token);
        Events(BufReader::new(self.request(&line, "", "")))
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = caudata_tests::signal(&self.child, Signal::SIGTERM);
        let _ = self.child.wait();
    }
}

/// What a client is told.
struct Events(BufReader<TcpStream>);

impl Events {
    /// The next event: its name, empty for a step, and its data.
    fn next(&mut self) -> (String, Value) {
        let mut name = String::new();
        loop {
            let mut line = String::new();
            assert!(self.0.read_line(&mut line).unwrap() > 0, "the stream ended");
            if let Some(event) = line.strip_prefix("event:") {
                name = event.trim().to_owned();
            }
            if let Some(data) = line.strip_prefix("data:") {
                return (name, serde_json::from_str(data).unwrap());
            }
        }
    }

    fn named(&mut self, wanted: &str) -> Value {
        loop {
            let (name, data) = self.next();
            if name == wanted {
                return data;
            }
        }
    }

    /// The base's place, m, after so many steps.
    fn place(&mut self, steps: usize) -> [f64; 2] {
        let mut row = Value::Null;
        for _ in 0..steps {
            row = self.named("");
        }
        [0, 1].map(|i| row[i].as_f64().unwrap())
    }
}

#[test]
fn a_stranger_sees_nothing_and_changes_nothing() {
    let served = Served::play(&["policies/flat.onnx"]);
    let wrong = "0".repeat(served.token.len());
    let short = &served.token[1..];
    for token in ["", &wrong, short] {
        for line in [
            format!("GET /?token={token}"),
            format!("GET /events?token={token}"),
            format!("POST /order?token={token}"),
            format!("POST /beside?token={token}"),
            format!("GET /else?token={token}"),
        ] {
            let answer = served.ask(&line, "", r#"{"do":"restart"}"#);
            assert!(answer.starts_with("HTTP/1.1 403"), "{line}: {answer}");
            assert!(!answer.contains("polymander"), "{line}: {answer}");
        }
    }
    let page = served.ask(&format!("GET /?token={}", served.token), "", "");
    assert!(page.starts_with("HTTP/1.1 200"), "{page}");
    assert!(page.len() < PAGE_BYTES_MAX, "{} bytes", page.len());
    for outside in ["http://", "https://", "src=", "@import", "url("] {
        assert!(!page.contains(outside), "{outside}");
    }
}

/// Looks at a page over TLS, prints the version, SHA-256 of the certificate and status, and what plain HTTP gets.
const LOOK: &str = r#"
import hashlib, socket, ssl, sys
port, path, authority = sys.argv[1:]
context = ssl.create_default_context(cafile=authority or None)
if not authority:
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
def ask(stream):
    stream.sendall(f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
    return stream.recv(12)
with context.wrap_socket(socket.create_connection(("127.0.0.1", int(port))), server_hostname="localhost") as stream:
    print(stream.version())
    print(hashlib.sha256(stream.getpeercert(True)).hexdigest().upper())
    print(ask(stream).decode())
with socket.create_connection(("127.0.0.1", int(port))) as stream:
    print(b"HTTP" in ask(stream))
"#;

#[test]
fn a_page_for_others_is_encrypted() {
    let dir = tempfile::tempdir().unwrap();
    let pki = dir.path().join("pki").display().to_string();
    let asked = ["--role", "server", "--name", "page", "--host", "localhost"];
    for flags in [&["init"][..], &[&["issue"], &asked[..]].concat()] {
        let all = [&["pki"], flags, &["--dir", &pki]].concat();
        let done = caudata_tests::finish(command("caudata", &all).unwrap()).unwrap();
        assert_eq!(done.code, Some(0), "{:?}", done.errors());
    }
    let (own, authority) = (format!("{pki}/page"), format!("{pki}/page/ca.crt"));
    let others: &[&str] = &["--page", "0.0.0.0:0"];
    let certified: &[&str] = &["--page", "0.0.0.0:0", "--page-tls", &own];
    for (flags, authority) in [(others, ""), (certified, &authority)] {
        let mut play = command("caudata", &["play", "policies/flat.onnx"]).unwrap();
        let mut child = play.args(flags).stdout(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let said: Vec<String> = lines
            .by_ref()
            .map_while(Result::ok)
            .take_while(|line| !line.contains("Ctrl-C"))
            .collect();
        let page = said.iter().find_map(|line| line.split_once("https://")).unwrap().1;
        let (host, path) = page.split_once('/').unwrap();
        let (name, port) = host.rsplit_once(':').unwrap();
        assert_ne!(name, "0.0.0.0", "leads nowhere from another computer");
        if !authority.is_empty() {
            assert_eq!(name, "localhost", "what the certificate holds");
        }
        let look = Command::new("python3")
            .args(["-c", LOOK, port, &format!("/{path}"), authority])
            .output()
            .unwrap();
        caudata_tests::signal(&child, Signal::SIGTERM).unwrap();
        child.wait().unwrap();
        let seen = String::from_utf8(look.stdout).unwrap();
        let [version, sum, status, plain] = seen.lines().collect::<Vec<_>>()[..] else {
            panic!("{seen} {}", String::from_utf8_lossy(&look.stderr));
        };
        assert_eq!((version, status, plain), ("TLSv1.3", "HTTP/1.1 200", "False"));
        let told = said.iter().any(|line| line.replace(':', "") == sum);
        assert_eq!(told, authority.is_empty(), "{said:?}");
    }
}

#[test]
fn the_robot_does_what_it_is_told() {
    let served = Served::play(&["policies/flat.onnx"]);
    let mut events = served.events();
    let robot = events.named("robot");
    assert_eq!(robot["joint_names"].as_array().unwrap().len(), 16);
    assert_eq!(events.named("ground")["kind"], "flat");
    let from = events.place(25);
    let ordered = served.order(&json!({"do": "drive", "velocity": [0.3, 0.0, 0.0]}));
    assert!(ordered.starts_with("HTTP/1.1 204"), "{ordered}");
    let velocity = &events.named("told")["velocity"];
    assert!((velocity[0].as_f64().unwrap() - 0.3).abs() < 1e-6, "{velocity}");
    // It heads +x; the first second is for starting.
    let [x, _] = events.place(200);
    assert!((0.6..1.4).contains(&(x - from[0])), "{} m in 4 s", x - from[0]);

    served.order(&json!({"do": "joint", "index": 9, "strength": 0.0}));
    assert_eq!(events.named("told")["strengths"][9], 0.0);
    served.order(&json!({"do": "terrain", "kind": "rough_easy"}));
    let ground = events.named("ground");
    assert_eq!(ground["kind"], "rough_easy");
    assert!(ground["ground"]["grid"]["columns"].as_u64().unwrap() > 50);
    let [x, y] = events.place(1);
    assert!(x.hypot(y) < 0.5, "it starts again at {x}, {y}");
    for refused in [json!({"do": "fly"}), json!({"do": "push", "velocity_mps": [9, 0]})] {
        let answer = served.order(&refused);
        assert!(answer.starts_with("HTTP/1.1 400"), "{answer}");
    }
    let long = served.order(&json!({"do": "restart", "why": "x".repeat(2000)}));
    assert!(long.starts_with("HTTP/1.1 413"), "{long}");
}

#[test]
fn a_push_moves_it_and_a_client_that_does_not_read_is_cut_off() {
    let served = Served::play(&["policies/flat.onnx"]);
    let mut silent = served.events().0;
    let mut events = served.events();
    events.named("ground");
    let [_, before] = events.place(50);
    served.order(&json!({"do": "push", "velocity_mps": [0.0, 2.0]}));
    let [_, after] = events.place(50);
    assert!(after - before > 0.1, "pushed by {} m", after - before);
    // What the system holds for the silent one is filled by grounds of 70 kB, each with its frames.
    let begun = Instant::now();
    let mut ended = false;
    while !ended && begun.elapsed() < Duration::from_secs(60) {
        served.order(&json!({"do": "terrain", "kind": "rough_hard"}));
        events.place(2);
        ended = silent.get_ref().peek(&mut [0]).is_err() || is_over(&served);
    }
    assert!(ended, "it still holds its place");
    events.place(10);
    let _ = silent.read(&mut [0]);
}

/// Whether the program has one connection left: that of the client that reads.
fn is_over(served: &Served) -> bool {
    let port = served.host.rsplit(':').next().unwrap();
    let port = format!(":{:04X}", port.parse::<u16>().unwrap());
    let table = std::fs::read_to_string("/proc/net/tcp").unwrap();
    const ESTABLISHED: &str = "01";
    let held = table.lines().filter(|line| {
        let mut words = line.split_whitespace().skip(1);
        words.next().is_some_and(|local| local.ends_with(&port))
            && words.nth(1) == Some(ESTABLISHED)
    });
    held.count() <= 1
}

#[test]
fn every_robot_that_ships_comes_onto_the_page() {
    for robot in ["polymander", "quadruped", "biped", "hexapod", "snake"] {
        let file = format!("robots/{robot}.robot.toml");
        let served = Served::play(&["--robot", &file]);
        let mut events = served.events();
        assert!(events.named("robot")["robot"]["links"].is_array(), "{robot}");
        events.place(10);
    }
    for policy in ["rough", "amphibious", "quadruped"] {
        let served = Served::play(&[&format!("policies/{policy}.onnx")]);
        served.events().place(10);
    }
}

#[test]
fn a_training_is_watched_under_its_newest_policy() {
    let folder = tempfile::tempdir().unwrap();
    let served = Served::train(&folder.path().join("run"));
    let stranger = served.ask("GET /events", "", "");
    assert!(stranger.starts_with("HTTP/1.1 403"), "{stranger}");
    let mut events = served.events();
    events.named("robot");
    let point = events.named("training");
    assert!(point["reward_terms"].is_object(), "{point}");
    let mut versions = std::iter::repeat_with(|| events.named("policy"))
        .filter_map(|policy| policy["version"].as_u64());
    let first = versions.next().unwrap();
    assert!(versions.any(|version| version > first), "a newer one comes");
    events.place(10);
}

#[test]
fn a_training_is_changed_with_the_token_for_it_and_not_without() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let served = Served::train(&run);
    let set = ["task.reward.weights.bend=-0.75"];
    for wrong in ["", &served.token, &served.change[1..]] {
        let answer = served.change(wrong, &set);
        assert!(answer.starts_with("HTTP/1.1 403"), "{answer}");
    }
    let mut events = served.events();
    events.named("training");
    for (wrong, said) in [
        ("task.reward.weights.bend=2", "this term costs"),
        ("task.reward.weights.bent=-1", "unknown key"),
        ("actors.lanes=9", "cannot change while a run goes on"),
    ] {
        let answer = served.change(&served.change, &[wrong]);
        assert!(answer.starts_with("HTTP/1.1 400"), "{answer}");
        assert!(answer.contains(said), "{answer}");
    }
    let long = "x".repeat(20_000);
    let refused = served.change(&served.change, &[&long]);
    assert!(refused.starts_with("HTTP/1.1 413"), "{refused}");

    let asked = served.change(&served.change, &set);
    assert!(asked.starts_with("HTTP/1.1 204"), "{asked}");
    let made = |settings: &Value| settings["made"][0]["set"][0] == set[0];
    while !made(&events.named("settings")) {}
    let record = std::fs::read_to_string(run.join("changes.toml")).unwrap();
    assert!(record.contains(set[0]), "{record}");

    // The same from the command line.
    let tune = |more: &[&str]| {
        let mut tune = command("caudata", &["tune", run.to_str().unwrap()]).unwrap();
        tune.args(more).output().unwrap()
    };
    let listed = String::from_utf8(tune(&[]).stdout).unwrap();
    assert!(listed.contains("task.reward.weights.bend = -0.75"), "{listed}");
    let done = tune(&["learner.ppo.entropy_weight=0.01"]);
    let said = String::from_utf8(done.stdout).unwrap();
    assert!(said.contains("changed after iteration"), "{said}");
    assert_eq!(tune(&["learner.ppo.gamma=0.9"]).status.code(), Some(64));
    drop(served);
    assert_eq!(tune(&set).status.code(), Some(66), "nothing runs any more");
}

/// A run beside another one: the same until now, of another seed.
fn copy_of(run: &Path) {
    let other = run.with_file_name("other");
    std::fs::create_dir(&other).unwrap();
    std::fs::copy(run.join("run_id.txt"), other.join("run_id.txt")).unwrap();
    std::fs::copy(run.join("progress.jsonl"), other.join("progress.jsonl")).unwrap();
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
    let other_seed = config.replace("\nseed = 1\n", "\nseed = 77\n");
    assert_ne!(config, other_seed);
    std::fs::write(other.join("config.toml"), other_seed).unwrap();
}

#[test]
fn a_browser_changes_a_weight_and_compares_two_runs() {
    let Some(mut browser) = Browser::start() else {
        return skipped("there is no Chromium here");
    };
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let served = Served::train(&run);
    let input = "document.querySelector('[title=\"task.reward.weights.power\"] input')";
    // Who only looks sees what it is, and cannot change it.
    browser.open(&served.address());
    browser.until(&format!("{input} && {input}.readOnly"));
    browser.open(&format!("{}&change={}", served.address(), served.change));
    browser.until(&format!("{input} && !{input}.readOnly && caudata.live"));
    let send = |browser: &mut Browser, value: &str| {
        browser.evaluate(&format!(
            "{{ {input}.value = '{value}'; {input}.dispatchEvent(new Event('input', {{ bubbles: true }})); \
             document.getElementById('settings-send').click(); }}"
        ));
    };
    let said = "document.getElementById('settings-said').textContent";
    send(&mut browser, "5");
    browser.until(&format!("{said}.includes('this term costs')"));
    send(&mut browser, "-0.2");
    browser.until(&format!("{said}.startsWith('changed after iteration')"));
    browser.until("document.querySelector('#settings-made li').textContent.includes('power=-0.2')");
    let record = std::fs::read_to_string(run.join("changes.toml")).unwrap();
    assert!(record.contains("power=-0.2"), "{record}");

    copy_of(&run);
    send(&mut browser, "-0.3");
    browser.until("document.querySelector('#beside-run option[value=other]')");
    browser.evaluate(
        "{ const s = document.getElementById('beside-run'); s.value = 'other'; s.onchange(); }",
    );
    let table = "document.getElementById('beside-table').textContent";
    browser.until(&format!("{table}.includes('run.seed177')"));
    let refused = served.ask(
        "POST /beside",
        &format!("x-caudata-token: {}\r\n", served.token),
        r#""../run""#,
    );
    assert!(refused.starts_with("HTTP/1.1 400"), "{refused}");

    browser.width(390);
    browser.until("document.documentElement.scrollWidth <= 390");
    let errors = browser.evaluate("document.documentElement.dataset.errors");
    assert_eq!(errors, "0");
}

#[test]
fn a_browser_drives_the_robot() {
    let Some(mut browser) = Browser::start() else {
        return skipped("there is no Chromium here");
    };
    let served = Served::play(&["policies/flat.onnx"]);
    browser.open(&served.address());
    browser.until("caudata.live && caudata.live.film && caudata.live.film.frames > 50");
    let x = "caudata.live.film.com(caudata.live.film.frames - 1)[0]";
    let from = browser.evaluate(x).as_f64().unwrap();
    browser.key("keyDown", "w");
    browser.until(&format!("{x} > {}", from + 0.4));
    browser.key("keyUp", "w");
    browser.until("caudata.live.drive.velocity[0] === 0");
    browser.evaluate("document.querySelector('#joints button').click()");
    browser.until("caudata.live.strengths[0] === 0.3");
    // A push, by a click into the middle of the picture: the robot is there.
    browser.until("caudata.live.seen || !document.getElementById('nogl').hidden");
    if browser.evaluate("document.getElementById('nogl').hidden") == true {
        browser.click("view");
        browser.until("caudata.live.pushed");
    }
    browser.evaluate(
        "{ const t = document.getElementById('terrain'); t.value = 'shore'; t.onchange(); }",
    );
    browser.until("caudata.live.film.water !== null && caudata.live.film.frames > 5");
    // On a phone nothing sticks out.
    browser.width(390);
    browser.until("document.documentElement.scrollWidth <= 390");
    assert_eq!(browser.evaluate("document.documentElement.dataset.errors"), "0");
    browser.open(&format!("http://{}/", served.host));
    browser
        .until("document.body && document.body.textContent.includes('opens only at the address')");
}
