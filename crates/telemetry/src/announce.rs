//! How a server tells whoever started it where it listens: one JSON line on standard output.

use std::io::{self, BufRead, Write};
use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

/// The line: `{"listening":"policy_server","address":"127.0.0.1:40123"}`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Listening {
    /// Which service.
    pub listening: String,
    /// Where it is bound.
    pub address: SocketAddr,
}

/// Writes the line for `service` to standard output. A reader that is gone does no harm.
pub fn announce(service: &str, address: SocketAddr) {
    let line = Listening { listening: service.to_owned(), address };
    let mut out = io::stdout().lock();
    if let Ok(text) = serde_json::to_string(&line) {
        let _ = writeln!(out, "{text}").and_then(|()| out.flush());
    }
}

/// Reads lines until `service` announces its address; `None` when the stream ends before.
pub fn read_announcement(service: &str, out: &mut dyn BufRead) -> Option<SocketAddr> {
    let mut line = String::new();
    loop {
        line.clear();
        if out.read_line(&mut line).ok()? == 0 {
            return None;
        }
        match serde_json::from_str::<Listening>(line.trim()) {
            Ok(found) if found.listening == service => return Some(found.address),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_right_line_is_found_among_others() {
        let text = "noise\n{\"listening\":\"other\",\"address\":\"127.0.0.1:1\"}\n\
                    {\"listening\":\"policy_server\",\"address\":\"127.0.0.1:2\"}\n";
        let found = read_announcement("policy_server", &mut text.as_bytes());
        assert_eq!(found, Some(SocketAddr::from(([127, 0, 0, 1], 2))));
        assert_eq!(read_announcement("robot", &mut text.as_bytes()), None);
    }
}
