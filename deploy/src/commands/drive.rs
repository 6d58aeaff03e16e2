//! `caudata-robot drive`: velocity commands from a keyboard, a gamepad, or lines of another program, to a
//! robot.

use std::fs::File;
use std::io::{IsTerminal, Read};
use std::net::{SocketAddr, UdpSocket};
use std::path::PathBuf;
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use caudata_telemetry::Process;
use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};

use crate::DeployError;
use crate::command_link::{Commander, DATAGRAM, LinkKey};
use crate::gamepad::{EVENT_BYTES, Gamepad, Speeds};
use crate::walk_command::WalkCommand;

/// How often the present command is sent: four times within the time after which the robot stops.
const SEND_EVERY: Duration = Duration::from_millis(50);
/// Messages after the end of the input: the last line, a kill most of all, arrives although some are lost.
const LAST_MESSAGES: u32 = 20;
/// Lines, keys or events that wait.
const INPUTS_WAITING_MAX: usize = 64;
/// One key press changes the speed by this, m/s and rad/s.
const STEP: f32 = 0.05;
/// A key that is held is heard again within this time: keyboards begin to repeat after 0.25 to 0.7 s. As much
/// longer the robot goes on after it was let go of.
const REPEATS_WITHIN: Duration = Duration::from_millis(800);

#[derive(Debug, clap::Args)]
pub struct DriveArgs {
    /// The robot's --link-addr
    #[arg(value_name = "HOST:PORT")]
    robot: SocketAddr,
    /// File with the key that both ends share
    #[arg(long, value_name = "FILE")]
    link_key: PathBuf,
    /// A key moves the robot while it is held, and nothing does otherwise (a dead-man's button): w s forward
    /// and back, q e left and right, a d turn, k kills. Needs a terminal; 0.8 s after the last key the robot
    /// stands
    #[arg(long, conflicts_with = "gamepad")]
    hold: bool,
    /// Gamepad, as Linux shows it (`/dev/input/js0`): left stick velocity, right stick turning, while
    /// --held-button is held
    #[arg(long, value_name = "DEVICE")]
    gamepad: Option<PathBuf>,
    /// Button of the gamepad that must be held for the robot to move: the left shoulder
    #[arg(long, value_name = "N", default_value_t = 4)]
    held_button: u8,
    /// Button of the gamepad that kills
    #[arg(long, value_name = "N", default_value_t = 1)]
    kill_button: u8,
    /// Speed of a key that is held, and of a stick all the way, m/s. Lower than the fastest trained command:
    /// fingers slip
    #[arg(long, value_name = "N", default_value_t = 0.2, value_parser = speed)]
    speed: f32,
    /// The same of turning, rad/s
    #[arg(long, value_name = "N", default_value_t = 0.5, value_parser = speed)]
    turn: f32,
}

fn speed(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if value > 0.0 && value <= 5.0 => Ok(value),
        _ => Err("must be above 0 and at most 5".to_owned()),
    }
}

/// What came in.
enum Input {
    Line(String),
    Key(u8),
    Event([u8; EVENT_BYTES]),
}

/// Sends what is typed, pressed or read, until the input ends or the process is asked to stop. The robot then
/// stops by itself.
///
/// # Errors
/// [`DeployError::NotHeard`] where the robot never answered; [`DeployError::Folder`] where there is no
/// gamepad or terminal.
pub fn run(args: &DriveArgs, process: &Process) -> Result<(), DeployError> {
    let key = LinkKey::read(&args.link_key)?;
    let refused = DeployError::system("a socket");
    let any: SocketAddr = match args.robot {
        SocketAddr::V4(_) => ([0, 0, 0, 0], 0).into(),
        SocketAddr::V6(_) => ([0_u16; 8], 0).into(),
    };
    let socket = UdpSocket::bind(any).map_err(refused)?;
    socket.connect(args.robot).map_err(refused)?;
    // What the robot answers is looked at after every message.
    socket.set_nonblocking(true).map_err(refused)?;
    let (inputs, came) = sync_channel::<Input>(INPUTS_WAITING_MAX);
    let mut driver = Driver::new(args);
    let _keys = match (&args.gamepad, args.hold) {
        (Some(path), _) => {
            let mut device = File::open(path).map_err(DeployError::folder(path))?;
            read(move || event(&mut device), inputs);
            None
        }
        (None, true) => {
            let keys = Keys::at_once()?;
            read(pressed, inputs);
            Some(keys)
        }
        (None, false) => {
            read(typed, inputs);
            None
        }
    };
    let mut left = None;
    while !process.stop.is_set() && left != Some(0) {
        match came.recv_timeout(SEND_EVERY) {
            Ok(input) => driver.obey(input, Instant::now()),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                driver.let_go();
                left = Some(left.map_or(LAST_MESSAGES, |n| n - 1));
                std::thread::sleep(SEND_EVERY);
            }
        }
        // A robot that is not there yet, or restarts, refuses datagrams for a while.
        let message = driver.commander(Instant::now()).next_message();
        let _ = socket.send(&message.encode(&key));
        let mut buffer = [0; DATAGRAM];
        while let Ok(DATAGRAM) = socket.recv(&mut buffer) {
            driver.commander.hear(&buffer, &key);
        }
    }
    if driver.commander.is_heard() {
        return Ok(());
    }
    Err(DeployError::NotHeard { robot: args.robot })
}

/// Reads one input after the other in a thread of its own, until there is none, or nobody wants it.
fn read(mut next: impl FnMut() -> Option<Input> + Send + 'static, to: SyncSender<Input>) {
    std::thread::spawn(move || while next().is_some_and(|input| to.send(input).is_ok()) {});
}

fn typed() -> Option<Input> {
    let line = std::io::stdin().lines().next()?;
    line.ok().map(Input::Line)
}

fn pressed() -> Option<Input> {
    let mut key = [0];
    std::io::stdin().read_exact(&mut key).ok().map(|()| Input::Key(key[0]))
}

/// The next event; a gamepad that is unplugged has none, which ends the command.
fn event(device: &mut File) -> Option<Input> {
    let mut event = [0; EVENT_BYTES];
    device.read_exact(&mut event).ok().map(|()| Input::Event(event))
}

/// A terminal that gives keys as they are pressed; dropped, it is as it was.
struct Keys(Termios);

impl Keys {
    fn at_once() -> Result<Self, DeployError> {
        let refused = |source| DeployError::folder("standard input")(source);
        let input = std::io::stdin();
        if !input.is_terminal() {
            let what = "--hold needs a terminal, which tells keys as they are pressed";
            return Err(refused(std::io::Error::other(what)));
        }
        let before = tcgetattr(&input).map_err(|e| refused(e.into()))?;
        let mut settings = before.clone();
        settings.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
        tcsetattr(&input, OptionalActions::Now, &settings).map_err(|e| refused(e.into()))?;
        Ok(Self(before))
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        let _ = tcsetattr(std::io::stdin(), OptionalActions::Now, &self.0);
    }
}

/// What the person wants, out of what came in.
struct Driver {
    commander: Commander,
    pad: Gamepad,
    full: Speeds,
    held_button: u8,
    kill_button: u8,
    /// When a key was heard last, of keys that must be held.
    key_at: Option<Instant>,
    holds_keys: bool,
}

impl Driver {
    fn new(args: &DriveArgs) -> Self {
        let mut commander = Commander::begin();
        commander.held = (args.hold || args.gamepad.is_some()).then_some(false);
        Self {
            commander,
            pad: Gamepad::default(),
            full: Speeds { linear_mps: args.speed, yaw_radps: args.turn },
            held_button: args.held_button,
            kill_button: args.kill_button,
            key_at: None,
            holds_keys: args.hold,
        }
    }

    fn obey(&mut self, input: Input, now: Instant) {
        match input {
            Input::Line(line) => obey_line(&mut self.commander, &line),
            Input::Key(b'k') => self.commander.kill = true,
            Input::Key(key) => {
                if let Some(command) = held_key(key, self.full) {
                    self.commander.command = command;
                    self.key_at = Some(now);
                } else {
                    self.key_at = None;
                }
            }
            Input::Event(event) => {
                self.pad.take(event);
                self.commander.command = self.pad.command(self.full);
                self.commander.held = Some(self.pad.is_down(self.held_button));
                self.commander.kill |= self.pad.is_down(self.kill_button);
            }
        }
    }

    /// The input is gone: nobody holds anything.
    fn let_go(&mut self) {
        self.key_at = None;
        if let Some(held) = &mut self.commander.held {
            *held = false;
        }
    }

    /// As it stands at `now`.
    fn commander(&mut self, now: Instant) -> &mut Commander {
        if self.holds_keys {
            let held = |at: Instant| now.saturating_duration_since(at) < REPEATS_WITHIN;
            self.commander.held = Some(self.key_at.is_some_and(held));
        }
        &mut self.commander
    }
}

/// What a key means while it is held; `None`: nothing, which lets go.
fn held_key(key: u8, full: Speeds) -> Option<[f32; 3]> {
    let Speeds { linear_mps: v, yaw_radps: r } = full;
    match key {
        b'w' => Some([v, 0.0, 0.0]),
        b's' => Some([-v, 0.0, 0.0]),
        b'q' => Some([0.0, v, 0.0]),
        b'e' => Some([0.0, -v, 0.0]),
        b'a' => Some([0.0, 0.0, r]),
        b'd' => Some([0.0, 0.0, -r]),
        _ => None,
    }
}

/// A line of the person, or of another program: `vx,vy,yaw_rate`, or with a fourth number that says whether a
/// dead-man's button is held (1) or not (0); or letters that change the speed.
fn obey_line(to: &mut Commander, line: &str) {
    let (numbers, held) = match line.trim().rsplit_once(',') {
        Some((numbers, "1")) => (numbers, Some(true)),
        Some((numbers, "0")) => (numbers, Some(false)),
        _ => (line, None),
    };
    // With a button first: three numbers that end in 0 or 1 have none, and are two without their last.
    if let (Ok(WalkCommand(command)), Some(held)) = (numbers.parse(), held) {
        (to.command, to.held) = (command, Some(held));
        return;
    }
    if let Ok(WalkCommand(command)) = line.parse() {
        (to.command, to.held) = (command, None);
        return;
    }
    for letter in line.chars() {
        let [vx, vy, yaw] = &mut to.command;
        match letter {
            'w' => *vx += STEP,
            's' => *vx -= STEP,
            'q' => *vy += STEP,
            'e' => *vy -= STEP,
            'a' => *yaw += STEP,
            'd' => *yaw -= STEP,
            ' ' => to.command = [0.0; 3],
            'k' => to.kill = true,
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command_link::{Kind, Message};

    #[test]
    fn keys_and_numbers() {
        let mut sender = Commander::default();
        obey_line(&mut sender, "www");
        assert!((sender.command[0] - 0.15).abs() < 1e-6);
        obey_line(&mut sender, "0.2,0,-0.1");
        assert_eq!(sender.command, [0.2, 0.0, -0.1]);
        let first = sender.next_message();
        assert_eq!(first.kind, Kind::Ask, "nothing moves before the nonce is known");
        let told = Message { kind: Kind::Tell, nonce: 5, ..first };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("key");
        std::fs::write(&file, [7; 32]).unwrap();
        let private = std::os::unix::fs::PermissionsExt::from_mode(0o600);
        std::fs::set_permissions(&file, private).unwrap();
        let key = LinkKey::read(&file).unwrap();
        sender.hear(&told.encode(&key), &key);
        assert_eq!(sender.next_message().kind, Kind::Velocity);
        obey_line(&mut sender, " k");
        let last = sender.next_message();
        assert_eq!((last.kind, last.command, last.sequence), (Kind::Kill, [0.0; 3], 3));
    }

    #[test]
    fn lines_of_another_program_may_say_whether_a_button_is_held() {
        let mut sender = Commander::default();
        for (line, command, held) in [
            ("0.2,0,-0.1", [0.2, 0.0, -0.1], None),
            ("0.2,0,0.1,1", [0.2, 0.0, 0.1], Some(true)),
            ("0.2,0,0,0", [0.2, 0.0, 0.0], Some(false)),
            // Three numbers stay three numbers.
            ("0.1,0,1", [0.1, 0.0, 1.0], None),
            ("0.1,0,0", [0.1, 0.0, 0.0], None),
        ] {
            obey_line(&mut sender, line);
            assert_eq!((sender.command, sender.held), (command, held), "{line}");
        }
    }

    fn driver(flags: &[&str]) -> Driver {
        #[derive(clap::Parser)]
        struct Program {
            #[command(flatten)]
            args: DriveArgs,
        }
        let words = ["drive", "127.0.0.1:1", "--link-key", "key"];
        let words = words.iter().chain(flags);
        Driver::new(&<Program as clap::Parser>::parse_from(words).args)
    }

    #[test]
    fn a_key_counts_while_it_is_held() {
        let mut driver = driver(&["--hold", "--speed", "0.25"]);
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        assert_eq!(driver.commander(at(0)).held, Some(false));
        // Held: heard again after the keyboard's pause, and then thirty times a second.
        for ms in [0, 700, 733, 766] {
            driver.obey(Input::Key(b'w'), at(ms));
            let said = driver.commander(at(ms + 30));
            assert_eq!((said.command, said.held), ([0.25, 0.0, 0.0], Some(true)));
        }
        assert_eq!(driver.commander(at(766 + 799)).held, Some(true));
        assert_eq!(driver.commander(at(766 + 800)).held, Some(false));
        // Any other key lets go at once.
        driver.obey(Input::Key(b'a'), at(2000));
        assert_eq!(driver.commander(at(2001)).held, Some(true));
        driver.obey(Input::Key(b' '), at(2010));
        assert_eq!(driver.commander(at(2011)).held, Some(false));
        driver.obey(Input::Key(b'k'), at(2020));
        assert!(driver.commander(at(2021)).kill);
    }

    #[test]
    fn a_gamepad_moves_the_robot_while_its_button_is_held() {
        let mut driver = driver(&["--gamepad", "/dev/input/js0"]);
        let now = Instant::now();
        let event = |kind, number, value: i16| {
            let [low, high] = value.to_le_bytes();
            Input::Event([0, 0, 0, 0, low, high, kind, number])
        };
        driver.obey(event(2, 1, -32_767), now);
        let said = driver.commander(now);
        assert_eq!((said.command, said.held), ([0.2, 0.0, 0.0], Some(false)));
        driver.obey(event(1, 4, 1), now);
        assert_eq!(driver.commander(now).held, Some(true));
        // Unplugged while it is held.
        driver.let_go();
        assert_eq!(driver.commander(now).held, Some(false));
        assert!(!driver.commander(now).kill);
        driver.obey(event(1, 1, 1), now);
        driver.obey(event(1, 1, 0), now);
        assert!(driver.commander(now).kill, "a kill stays");
    }
}
