//! `caudata-robot drive`: velocity commands from a keyboard, or from lines of another program, to a robot.

use std::io::BufRead;
use std::net::{SocketAddr, UdpSocket};
use std::path::PathBuf;
use std::sync::mpsc::sync_channel;
use std::time::Duration;

use caudata_task::COMMAND_DIM;
use caudata_telemetry::Process;

use crate::DeployError;
use crate::command_link::{DATAGRAM, Kind, LinkKey, Message};
use crate::walk_command::WalkCommand;

/// How often the present command is sent: four times within the time after which the robot stops.
const SEND_EVERY: Duration = Duration::from_millis(50);
/// Lines that wait.
const LINES_MAX: usize = 64;
/// One key press changes the speed by this, m/s and rad/s.
const STEP: f32 = 0.05;

#[derive(Debug, clap::Args)]
pub struct DriveArgs {
    /// The robot's --link-addr
    #[arg(value_name = "HOST:PORT")]
    robot: SocketAddr,
    /// File with the key that both ends share
    #[arg(long, value_name = "FILE")]
    link_key: PathBuf,
}

/// Each line of standard input: `vx,vy,yaw_rate`, or letters that change it. Ends with the input; the robot then stops by itself.
pub fn run(args: &DriveArgs, process: &Process) -> Result<(), DeployError> {
    let key = LinkKey::read(&args.link_key)?;
    let refused = |source| DeployError::System {
        what: "a socket",
        source,
    };
    let any: SocketAddr = match args.robot {
        SocketAddr::V4(_) => ([0, 0, 0, 0], 0).into(),
        SocketAddr::V6(_) => ([0_u16; 8], 0).into(),
    };
    let socket = UdpSocket::bind(any).map_err(refused)?;
    socket.connect(args.robot).map_err(refused)?;
    socket.set_read_timeout(Some(SEND_EVERY)).map_err(refused)?;
    let (lines, typed) = sync_channel::<String>(LINES_MAX);
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            if lines.send(line).is_err() {
                return;
            }
        }
    });
    let mut sender = Sender::default();
    while !process.stop.is_set() {
        match typed.recv_timeout(SEND_EVERY) {
            Ok(line) => sender.obey(&line),
            Err(std::sync::mpsc::RecvTimeoutError::Timeout) => {}
            Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => return Ok(()),
        }
        // A robot that is not there yet, or restarts, refuses datagrams for a while.
        let _ = socket.send(&sender.next().encode(&key));
        if sender.nonce == 0 {
            let mut buffer = [0; DATAGRAM];
            if let Ok(DATAGRAM) = socket.recv(&mut buffer) {
                sender.hear(&buffer, &key);
            }
        }
    }
    Ok(())
}

/// What is sent, and what it is sent with.
#[derive(Clone, Copy, Debug, Default)]
struct Sender {
    nonce: u64,
    sequence: u64,
    command: [f32; COMMAND_DIM],
    kill: bool,
}

impl Sender {
    fn obey(&mut self, line: &str) {
        if let Ok(WalkCommand(command)) = line.parse() {
            self.command = command;
            return;
        }
        for letter in line.chars() {
            let [vx, vy, yaw] = &mut self.command;
            match letter {
                'w' => *vx += STEP,
                's' => *vx -= STEP,
                'q' => *vy += STEP,
                'e' => *vy -= STEP,
                'a' => *yaw += STEP,
                'd' => *yaw -= STEP,
                ' ' => self.command = [0.0; COMMAND_DIM],
                'k' => self.kill = true,
                _ => {}
            }
        }
    }

    fn hear(&mut self, bytes: &[u8], key: &LinkKey) {
        if let Some(message) = Message::decode(bytes, key)
            && message.kind == Kind::Tell
        {
            self.nonce = message.nonce;
        }
    }

    fn next(&mut self) -> Message {
        self.sequence += 1;
        let kind = match (self.nonce, self.kill) {
            (0, _) => Kind::Ask,
            (_, true) => Kind::Kill,
            (_, false) => Kind::Velocity,
        };
        Message {
            kind,
            nonce: self.nonce,
            sequence: self.sequence,
            command: self.command,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_and_numbers() {
        let mut sender = Sender::default();
        sender.obey("www");
        assert!((sender.command[0] - 0.15).abs() < 1e-6);
        sender.obey("0.2,0,-0.1");
        assert_eq!(sender.command, [0.2, 0.0, -0.1]);
        assert_eq!(
            sender.next().kind,
            Kind::Ask,
            "nothing moves before the nonce is known"
        );
        sender.nonce = 5;
        assert_eq!(sender.next().kind, Kind::Velocity);
        sender.obey(" k");
        let last = sender.next();
        assert_eq!(
            (last.kind, last.command, last.sequence),
            (Kind::Kill, [0.0; 3], 3)
        );
    }
}
