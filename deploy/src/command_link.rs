//! Velocity commands over the network: authenticated, fresh, newest wins, and silence stops the robot.
//!
//! UDP, one datagram per command:
//! `CDL1 | kind | nonce (8) | sequence (8) | vx, vy, yaw rate (3 × f32) | tag (16)`, little endian. The tag
//! is the first half of HMAC-SHA-256 over everything before it, with a key that both ends hold. The nonce is
//! drawn by the robot when it starts and told to whoever asks (kind 0); with it in every command, and
//! sequence numbers that only grow, nothing recorded earlier counts, not after a restart of the robot either.
//! A kill needs the nonce only: whoever holds the key may stop the robot, whatever others have sent, and to
//! repeat a kill does no harm.
//!
//! A velocity says whether a dead-man's button is held. One with the button let go makes the robot stand at
//! once. One from a sender that has no such button (kind 2) moves the robot only where the robot does not ask
//! for the button.

mod message;

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use caudata_proto::checks::Check;
use caudata_signing::random_bytes;
use caudata_task::COMMAND_DIM;
use caudata_telemetry::Joined;
pub use message::{DATAGRAM, KEY_MIN, Kind, LinkKey, Message};

use crate::DeployError;

/// Age of the newest command beyond which the robot is told to stand still.
pub const LINK_STOP: Duration = Duration::from_millis(200);
/// Age beyond which it stands.
pub const LINK_STAND: Duration = Duration::from_secs(1);
/// How often the listener looks whether it is still wanted; and how much older than it is a command may be
/// taken for.
const LISTEN_LOOK: Duration = Duration::from_millis(20);
/// Datagrams taken before it is looked whether the listener is still wanted.
const TAKEN_AT_ONCE: u32 = 1024;
/// Largest command, m/s and rad/s.
const COMMAND_MAX: f32 = 20.0;

/// What the control loop sees of a link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkView {
    /// Newest command.
    pub command: [f32; COMMAND_DIM],
    /// How old it is.
    pub age: Duration,
    /// The kill button was pressed; it stays so.
    pub killed: bool,
    /// The dead-man's button was let go of, or is asked for and not there: the robot stands.
    pub released: bool,
}

/// Where commands come from while the robot walks. Never waits.
pub trait CommandLink: Send {
    /// The newest.
    fn view(&mut self) -> LinkView;
}

/// The far end of a link: what it sends, and what it knows of the robot.
#[derive(Clone, Copy, Debug, Default)]
pub struct Commander {
    /// vx, vy (m/s), yaw rate (rad/s).
    pub command: [f32; COMMAND_DIM],
    /// The kill button.
    pub kill: bool,
    /// Whether somebody holds the dead-man's button; `None`: there is none.
    pub held: Option<bool>,
    nonce: u64,
    sequence: u64,
    /// Sequence number of the newest [`Kind::Ask`] that was answered.
    answered: u64,
}

/// Every so many messages the nonce is asked for again: a robot whose agent was restarted has another one.
const ASK_EVERY: u64 = 10;
/// An answer to a question that was asked more messages ago does not count: five seconds of `drive`, longer
/// than a network takes for it. (Counting the newest question only, none would ever be answered over a
/// network that takes longer than a sender pauses.)
const ANSWER_WITHIN: u64 = 100;

impl Commander {
    /// A sender whose sequence numbers begin at the clock's milliseconds: above those of one that began
    /// earlier, which counts up more slowly.
    pub fn begin() -> Self {
        let since = std::time::UNIX_EPOCH.elapsed().unwrap_or_default();
        Self { sequence: u64::try_from(since.as_millis()).unwrap_or(0), ..Self::default() }
    }

    /// Whether the robot has answered.
    pub fn is_heard(&self) -> bool {
        self.nonce != 0
    }

    /// Takes what the robot answered. Answers to questions of long ago do not count, nor do those that came
    /// late, behind one to a newer question.
    pub fn hear(&mut self, bytes: &[u8], key: &LinkKey) {
        if let Some(message) = Message::decode(bytes, key)
            && message.kind == Kind::Tell
            && message.sequence > self.answered
            && message.sequence <= self.sequence
            && self.sequence - message.sequence < ANSWER_WITHIN
        {
            (self.nonce, self.answered) = (message.nonce, message.sequence);
        }
    }

    /// What to send next.
    pub fn next_message(&mut self) -> Message {
        self.sequence += 1;
        let asks = self.nonce == 0 || self.sequence.is_multiple_of(ASK_EVERY);
        let kind = match (asks, self.kill, self.held) {
            (true, _, _) => Kind::Ask,
            (false, true, _) => Kind::Kill,
            (false, false, None) => Kind::Velocity,
            (false, false, Some(true)) => Kind::Held,
            (false, false, Some(false)) => Kind::Released,
        };
        Message { kind, nonce: self.nonce, sequence: self.sequence, command: self.command }
    }
}

/// The robot's end, without the network: what counts and what does not.
#[derive(Clone, Debug, Default)]
pub struct Receiver {
    nonce: u64,
    sequence: u64,
    command: [f32; COMMAND_DIM],
    /// When the newest command came.
    at: Option<Duration>,
    killed: bool,
    released: bool,
    /// Only those with a dead-man's button may move the robot.
    asks_for_button: bool,
    /// Datagrams that did not count.
    pub ignored: u64,
}

impl Receiver {
    /// With a nonce that was never used before.
    pub fn new(nonce: u64) -> Self {
        Self { nonce, ..Self::default() }
    }

    /// From now on a velocity counts only while its sender says that a dead-man's button is held.
    pub fn asking_for_button(mut self, asks: bool) -> Self {
        (self.asks_for_button, self.released) = (asks, asks);
        self
    }

    /// Takes a datagram that came at `now`, or later; what to answer, if anything.
    pub fn take(&mut self, bytes: &[u8], key: &LinkKey, now: Duration) -> Option<Message> {
        self.take_by(DATAGRAM_CHECKS, bytes, key, now)
    }

    /// [`Receiver::take`] by these checks.
    fn take_by(
        &mut self,
        checks: &[Check<DatagramCheck>],
        bytes: &[u8],
        key: &LinkKey,
        now: Duration,
    ) -> Option<Message> {
        let message = Message::read(bytes).filter(|message| {
            let came = Datagram { bytes, key, message, receiver: self };
            !checks.iter().any(|check| (check.refuse)(&came))
        });
        let sane = |command: &[f32]| command.iter().all(|v| v.abs() <= COMMAND_MAX);
        match message {
            Some(Message { kind: Kind::Ask, sequence, .. }) => {
                return Some(Message {
                    kind: Kind::Tell,
                    nonce: self.nonce,
                    sequence,
                    command: [0.0; COMMAND_DIM],
                });
            }
            Some(message) if message.kind == Kind::Kill => self.killed = true,
            Some(message) if message.kind != Kind::Tell && sane(&message.command) => {
                self.command = message.command;
                self.released = match message.kind {
                    Kind::Held => false,
                    Kind::Released => true,
                    _ => self.asks_for_button,
                };
                self.at = Some(now);
                self.sequence = message.sequence;
            }
            _ => self.ignored += 1,
        }
        None
    }

    /// What the loop sees at `now`.
    pub fn view(&self, now: Duration) -> LinkView {
        LinkView {
            command: self.command,
            age: self.at.map_or(Duration::MAX, |at| now.saturating_sub(at)),
            killed: self.killed,
            released: self.released,
        }
    }
}

/// A datagram that came, and where.
struct Datagram<'a> {
    bytes: &'a [u8],
    key: &'a LinkKey,
    message: &'a Message,
    receiver: &'a Receiver,
}

/// Looks at a datagram that came; true: it does not count.
type DatagramCheck = fn(&Datagram<'_>) -> bool;

/// What a datagram must be to count.
const DATAGRAM_CHECKS: &[Check<DatagramCheck>] = &[
    // It was made with the link's key.
    Check { name: "command tag", refuse: |came| !came.key.made(came.bytes) },
    // For this start of the robot.
    Check::new("command nonce", |came| {
        came.message.kind != Kind::Ask && came.message.nonce != came.receiver.nonce
    }),
    // And after the newest that counted. To repeat a kill does no harm.
    Check::new("command sequence", |came| {
        !matches!(came.message.kind, Kind::Ask | Kind::Kill)
            && came.message.sequence <= came.receiver.sequence
    }),
];

/// Listens in a thread of its own; dropped, it ends.
pub struct UdpLink {
    start: Instant,
    receiver: Arc<Mutex<Receiver>>,
    last: Receiver,
    stop: Arc<std::sync::atomic::AtomicBool>,
    _thread: Joined,
    address: SocketAddr,
}

impl UdpLink {
    /// Listens on `addr`. `asks_for_button`: only senders whose dead-man's button is held may move the robot.
    ///
    /// # Errors
    /// [`DeployError::System`].
    pub fn listen(
        addr: SocketAddr,
        key: LinkKey,
        asks_for_button: bool,
    ) -> Result<Self, DeployError> {
        let refused = DeployError::system("the command link's address");
        let socket = UdpSocket::bind(addr).map_err(refused)?;
        let address = socket.local_addr().map_err(refused)?;
        let start = Instant::now();
        let mut door = Door::open(socket, start).map_err(refused)?;
        let nonce = random_nonce().map_err(refused)?;
        let first = Receiver::new(nonce).asking_for_button(asks_for_button);
        let receiver = Arc::new(Mutex::new(first.clone()));
        let stop = Arc::new(std::sync::atomic::AtomicBool::new(false));
        let (shared, stopped) = (receiver.clone(), stop.clone());
        let listen = move || {
            while !stopped.load(std::sync::atomic::Ordering::Relaxed) {
                door.take_all(|bytes, came| {
                    let mut receiver = shared.lock().unwrap_or_else(PoisonError::into_inner);
                    let answer = receiver.take(bytes, &key, came);
                    answer.map(|message| message.encode(&key))
                });
            }
        };
        let _thread = Joined::spawn("command-link", listen).map_err(refused)?;
        tracing::info!(%address, "listening for commands");
        Ok(Self { start, receiver, last: first, stop, _thread, address })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

/// A socket, and since when what is in it can have been there.
#[derive(Debug)]
struct Door {
    socket: UdpSocket,
    start: Instant,
    /// When nothing was left in the socket, last. What is found in it came after that: how long after nobody
    /// knows, where this process was held up meanwhile.
    empty_at: Duration,
}

impl Door {
    fn open(socket: UdpSocket, start: Instant) -> io::Result<Self> {
        socket.set_read_timeout(Some(LISTEN_LOOK))?;
        Ok(Self { socket, start, empty_at: start.elapsed() })
    }

    /// Waits for a datagram, for [`LISTEN_LOOK`] at most, and takes all that are there. `each` gets its bytes
    /// and the earliest time, since the start, that it can have come; what it answers goes back to the
    /// sender.
    fn take_all(&mut self, mut each: impl FnMut(&[u8], Duration) -> Option<[u8; DATAGRAM]>) {
        let mut buffer = [0; 2 * DATAGRAM];
        for look in 0..TAKEN_AT_ONCE {
            // Before looking: what comes between the look and the clock is not taken for older than it is,
            // but never for younger.
            let looked_at = self.start.elapsed();
            let _ = self.socket.set_nonblocking(look > 0);
            match self.socket.recv_from(&mut buffer) {
                Ok((length, from)) => {
                    if let Some(answer) = each(&buffer[..length], self.empty_at) {
                        // Lost answers are asked for again.
                        let _ = self.socket.send_to(&answer, from);
                    }
                }
                // An answer that could not be delivered is told with the next look; it says nothing about
                // what waits here.
                Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
                Err(_) => {
                    self.empty_at = looked_at;
                    return;
                }
            }
        }
    }
}

impl CommandLink for UdpLink {
    fn view(&mut self) -> LinkView {
        // Held by the listener just now: what was seen last counts for one more tick.
        if let Ok(receiver) = self.receiver.try_lock() {
            self.last.clone_from(&receiver);
        }
        self.last.view(self.start.elapsed())
    }
}

impl Drop for UdpLink {
    fn drop(&mut self) {
        self.stop.store(true, std::sync::atomic::Ordering::Relaxed);
    }
}

/// A number that nobody can guess.
pub(crate) fn random_nonce() -> io::Result<u64> {
    // 0 is what those send who do not know it yet.
    Ok(u64::from_le_bytes(random_bytes()?).max(1))
}

#[cfg(test)]
mod tests {
    use caudata_proto::checks::each_left_out;

    use super::*;
    use caudata_proto::hex::hex;
    use hmac::{Hmac, Mac};

    const MS: Duration = Duration::from_millis(1);

    fn made_of(key: &[u8]) -> LinkKey {
        LinkKey(Hmac::new_from_slice(key).unwrap())
    }

    fn key() -> LinkKey {
        made_of(b"sixteen bytes or more")
    }

    #[test]
    fn hmac_of_rfc_4231_test_cases_1_2_and_6() {
        let of = |key: &[u8], text: &[u8]| hex(&made_of(key).hmac(text).finalize().into_bytes());
        assert_eq!(
            of(&[0x0b; 20], b"Hi There"),
            "b0344c61d8db38535ca8afceaf0bf12b881dc200c9833da726e9376c2e32cff7"
        );
        assert_eq!(
            of(b"Jefe", b"what do ya want for nothing?"),
            "5bdcc146bf60754e6a042426089575c75a003f089d2739839dec58b964ec3843"
        );
        assert_eq!(
            of(&[0xaa; 131], b"Test Using Larger Than Block-Size Key - Hash Key First"),
            "60e431591ee0b67f0d8a26aacbf5b77f8e0bc6213728c5140546040f0ee37f54"
        );
    }

    fn velocity(nonce: u64, sequence: u64, vx: f32) -> [u8; DATAGRAM] {
        let message = Message { kind: Kind::Velocity, nonce, sequence, command: [vx, 0.0, 0.0] };
        message.encode(&key())
    }

    /// One command counted; whether the next one moves the robot, which somebody without the key, of another
    /// start of the robot or of a moment ago sends.
    #[test]
    fn each_step_and_no_other_keeps_its_command_out() {
        let table = each_left_out(DATAGRAM_CHECKS, |name, checks| {
            let mut link = Receiver::new(3);
            link.take(&velocity(3, 5, 0.1), &key(), MS);
            let datagram = match name {
                "command tag" => {
                    let mut bytes = velocity(3, 6, 0.1);
                    bytes[21..25].copy_from_slice(&0.2_f32.to_le_bytes());
                    bytes
                }
                "command nonce" => velocity(2, 6, 0.2),
                _ => velocity(3, 5, 0.2),
            };
            link.take_by(checks, &datagram, &key(), MS);
            match link.view(MS).command[0] {
                0.2 => Ok(()),
                vx => Err(format!("{} ignored, vx stays {vx}", link.ignored)),
            }
        });
        // Seen with --nocapture: `make mutants`.
        eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
    }

    #[test]
    fn fault_47_only_fresh_and_authentic_commands_count() {
        let mut link = Receiver::new(77);
        assert_eq!(link.view(MS).age, Duration::MAX, "never heard anything");
        link.take(&velocity(77, 5, 0.2), &key(), 100 * MS);
        let view = link.view(150 * MS);
        assert_eq!((view.command, view.age), ([0.2, 0.0, 0.0], 50 * MS));
        // Replayed, older, of an earlier start, of another key, not a number, too fast, cut short: none of
        // them counts.
        let other = made_of(b"another key of 16+");
        let forged = Message::decode(&velocity(77, 6, 0.9), &key()).unwrap().encode(&other);
        let mut flipped = velocity(77, 6, 0.9);
        flipped[21] ^= 1;
        for bytes in [
            &velocity(77, 5, 0.9)[..],
            &velocity(77, 4, 0.9),
            &velocity(76, 6, 0.9),
            &forged,
            &flipped,
            &velocity(77, 6, f32::NAN),
            &velocity(77, 6, 1e9),
            &velocity(77, 6, 0.9)[..DATAGRAM - 1],
            b"",
        ] {
            link.take(bytes, &key(), 200 * MS);
            assert_eq!(link.view(200 * MS).command, [0.2, 0.0, 0.0]);
        }
        assert_eq!((link.view(200 * MS).age, link.ignored), (100 * MS, 9));
        // A flood in order: the newest wins.
        for sequence in 6..1006 {
            link.take(&velocity(77, sequence, 0.001 * sequence as f32), &key(), 300 * MS);
        }
        assert!((link.view(300 * MS).command[0] - 1.005).abs() < 1e-6);
    }

    #[test]
    fn a_robot_with_a_new_nonce_is_found_again_and_old_answers_do_not_count() {
        let mut commander = Commander { command: [0.2, 0.0, 0.0], ..Commander::default() };
        let mut robot = Receiver::new(5);
        let round = |commander: &mut Commander, robot: &mut Receiver| {
            let message = commander.next_message().encode(&key());
            let answer = robot.take(&message, &key(), MS)?.encode(&key());
            commander.hear(&answer, &key());
            Some(answer)
        };
        let old = round(&mut commander, &mut robot).unwrap();
        round(&mut commander, &mut robot);
        assert_eq!(robot.view(MS).command[0], 0.2);
        // Its agent was restarted: within ten messages it hears again.
        let mut robot = Receiver::new(6);
        for _ in 0..ASK_EVERY {
            round(&mut commander, &mut robot);
        }
        commander.hear(&old, &key());
        round(&mut commander, &mut robot);
        assert_eq!(robot.view(MS).command[0], 0.2);
    }

    #[test]
    fn answers_may_take_longer_than_the_sender_pauses_but_not_for_ever() {
        // Each answer comes so many messages after its question.
        let heard_after = |late: usize| {
            let (mut commander, mut robot) = (Commander::begin(), Receiver::new(5));
            let mut on_the_way = std::collections::VecDeque::new();
            for _ in 0..3 * late + 10 {
                let message = commander.next_message().encode(&key());
                on_the_way.push_back(robot.take(&message, &key(), MS));
                if on_the_way.len() > late
                    && let Some(answer) = on_the_way.pop_front().flatten()
                {
                    commander.hear(&answer.encode(&key()), &key());
                }
            }
            commander.is_heard()
        };
        assert!(heard_after(0) && heard_after(1) && heard_after(40));
        assert!(heard_after(ANSWER_WITHIN as usize - 1));
        assert!(!heard_after(ANSWER_WITHIN as usize));
        // One that overtook it makes an older one late; one that nobody asked for yet is none.
        let mut commander = Commander::begin();
        let asked: Vec<Message> = (0..3).map(|_| commander.next_message()).collect();
        let tell = |sequence, nonce| {
            let message =
                Message { kind: Kind::Tell, nonce, sequence, command: [0.0; COMMAND_DIM] };
            message.encode(&key())
        };
        commander.hear(&tell(asked[2].sequence + 1, 9), &key());
        assert!(!commander.is_heard());
        commander.hear(&tell(asked[1].sequence, 6), &key());
        commander.hear(&tell(asked[0].sequence, 5), &key());
        assert_eq!(commander.nonce, 6);
    }

    #[test]
    fn a_button_that_is_let_go_of_stands_the_robot_and_one_that_is_asked_for_must_be_held() {
        let said = |sequence, kind| {
            let message = Message { kind, nonce: 7, sequence, command: [0.2, 0.0, 0.0] };
            message.encode(&key())
        };
        let mut link = Receiver::new(7);
        let hear = |link: &mut Receiver, sequence, kind| {
            link.take(&said(sequence, kind), &key(), MS);
            link.view(MS).released
        };
        let said_in_order = [
            (Kind::Velocity, false),
            (Kind::Held, false),
            (Kind::Released, true),
            (Kind::Held, false),
        ];
        for (sequence, (kind, released)) in (1..).zip(said_in_order) {
            assert_eq!(hear(&mut link, sequence, kind), released, "{kind:?}");
        }
        // An old one cannot press the button again.
        assert!(hear(&mut link, 9, Kind::Released));
        assert!(hear(&mut link, 4, Kind::Held));
        // Where the robot asks for a button, silence about it is no button.
        let mut link = Receiver::new(7).asking_for_button(true);
        assert!(link.view(MS).released, "before anybody spoke");
        assert!(hear(&mut link, 1, Kind::Velocity));
        assert!(!hear(&mut link, 2, Kind::Held));
        assert!(hear(&mut link, 3, Kind::Velocity));
    }

    #[test]
    fn what_waited_in_the_socket_while_nobody_listened_is_as_old_as_it_may_be() {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        sender.connect(socket.local_addr().unwrap()).unwrap();
        let mut door = Door::open(socket, Instant::now()).unwrap();
        let came = |door: &mut Door| {
            let mut all = Vec::new();
            while all.is_empty() {
                door.take_all(|_, came| {
                    all.push(came);
                    None
                });
            }
            all
        };
        // Looked at just now and found empty.
        door.take_all(|_, _| unreachable!("nothing was sent"));
        let empty_at = door.empty_at;
        // The process is held up; meanwhile somebody drives on.
        for _ in 0..5 {
            sender.send(b"x").unwrap();
        }
        std::thread::sleep(60 * MS);
        for taken in came(&mut door) {
            assert_eq!(taken, empty_at, "none of them is taken for a new one");
        }
        assert!(door.empty_at >= empty_at + 60 * MS);
        // The next one is new again.
        let before = door.start.elapsed();
        door.take_all(|_, _| None);
        sender.send(b"x").unwrap();
        assert!(came(&mut door).iter().all(|taken| *taken >= before));
    }

    #[test]
    fn a_kill_stays() {
        let mut link = Receiver::new(1);
        let kill = Message { kind: Kind::Kill, nonce: 1, sequence: 1, command: [0.0; 3] };
        link.take(&kill.encode(&key()), &key(), MS);
        link.take(&velocity(1, 2, 0.2), &key(), 2 * MS);
        assert!(link.view(2 * MS).killed);
    }

    #[test]
    fn a_kill_counts_whatever_others_have_sent_but_not_from_before_a_restart() {
        let kill = |nonce| Message { kind: Kind::Kill, nonce, sequence: 1, command: [0.0; 3] };
        let mut link = Receiver::new(7);
        link.take(&velocity(7, 1000, 0.2), &key(), MS);
        link.take(&kill(6).encode(&key()), &key(), 2 * MS);
        assert!(!link.view(2 * MS).killed);
        link.take(&kill(7).encode(&key()), &key(), 3 * MS);
        assert!(link.view(3 * MS).killed);
    }

    #[test]
    fn a_sender_that_begins_later_is_heard() {
        let mut link = Receiver::new(7);
        let mut speed = |vx: f32| {
            let mut sender = Commander::begin();
            sender.command[0] = vx;
            for _ in 0..5 {
                let sent = sender.next_message().encode(&key());
                if let Some(told) = link.take(&sent, &key(), MS) {
                    sender.hear(&told.encode(&key()), &key());
                }
            }
            std::thread::sleep(10 * MS);
            link.view(MS).command[0]
        };
        assert_eq!([speed(0.1), speed(0.2)], [0.1, 0.2]);
    }

    #[test]
    fn over_a_socket_the_nonce_is_asked_for_and_then_commands_arrive() {
        let mut link = UdpLink::listen("127.0.0.1:0".parse().unwrap(), key(), false).unwrap();
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.connect(link.address()).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        let ask = Message { kind: Kind::Ask, nonce: 0, sequence: 1, command: [0.0; 3] };
        socket.send(&ask.encode(&key())).unwrap();
        let mut buffer = [0; DATAGRAM];
        socket.recv(&mut buffer).unwrap();
        let told = Message::decode(&buffer, &key()).unwrap();
        assert_eq!(told.kind, Kind::Tell);
        let begun = Instant::now();
        let mut sequence = 1;
        while link.view().command[0] != 0.3 && begun.elapsed() < Duration::from_secs(20) {
            sequence += 1;
            socket.send(&velocity(told.nonce, sequence, 0.3)).unwrap();
            std::thread::sleep(5 * MS);
        }
        assert_eq!(link.view().command[0], 0.3);
    }
}
