//! `caudata-robot drive`: velocity commands from a keyboard, or from lines of another program, to a robot.

use std::io::BufRead;
use std::net::{SocketAddr, UdpSocket};
use std::path::PathBuf;
use std::sync::mpsc::sync_channel;
use std::time::Duration;

use caudata_telemetry::Process;

use crate::DeployError;
use crate::command_link::{Commander, DATAGRAM, LinkKey};
use crate::walk_command::WalkCommand;

/// How often the present command is sent: four times within the time after which the robot stops.
const SEND_EVERY: Duration = Duration::from_millis(50);
/// Messages after the end of the input: the last line, a kill most of all, arrives although some are lost.
const LAST_MESSAGES: u32 = 20;
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

/// Each line of standard input: `vx,vy,yaw_rate`, or letters that change it. Ends a second after the input; the robot then stops by itself.
///
/// # Errors
/// [`DeployError::NotHeard`] where the robot never answered.
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
    // What the robot answers is looked at after every message.
    socket.set_nonblocking(true).map_err(refused)?;
    let (lines, typed) = sync_channel::<String>(LINES_MAX);
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            if lines.send(line).is_err() {
                return;
            }
        }
    });
    let mut sender = Commander::begin();
    let mut left = None;
    while !process.stop.is_set() && left != Some(0) {
        match typed.recv_timeout(SEND_EVERY) {
            Ok(line) => obey(&mut sender, &line),
            Err(std::sync::mpsc::RecvTimeoutError::Timeout) => {}
            Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => {
                left = Some(left.map_or(LAST_MESSAGES, |n| n - 1));
                std::thread::sleep(SEND_EVERY);
            }
        }
        // A robot that is not there yet, or restarts, refuses datagrams for a while.
        let _ = socket.send(&sender.next_message().encode(&key));
        let mut buffer = [0; DATAGRAM];
        while let Ok(DATAGRAM) = socket.recv(&mut buffer) {
            sender.hear(&buffer, &key);
        }
    }
    if sender.is_heard() {
        return Ok(());
    }
    Err(DeployError::NotHeard { robot: args.robot })
}

/// A line of the person, or of another program.
fn obey(to: &mut Commander, line: &str) {
    if let Ok(WalkCommand(command)) = line.parse() {
        to.command = command;
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
        obey(&mut sender, "www");
        assert!((sender.command[0] - 0.15).abs() < 1e-6);
        obey(&mut sender, "0.2,0,-0.1");
        assert_eq!(sender.command, [0.2, 0.0, -0.1]);
        let first = sender.next_message();
        assert_eq!(
            first.kind,
            Kind::Ask,
            "nothing moves before the nonce is known"
        );
        let told = Message {
            kind: Kind::Tell,
            nonce: 5,
            ..first
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("key");
        std::fs::write(&file, [7; 32]).unwrap();
        let key = LinkKey::read(&file).unwrap();
        sender.hear(&told.encode(&key), &key);
        assert_eq!(sender.next_message().kind, Kind::Velocity);
        obey(&mut sender, " k");
        let last = sender.next_message();
        assert_eq!(
            (last.kind, last.command, last.sequence),
            (Kind::Kill, [0.0; 3], 3)
        );
    }
}
