//! How a service tells its supervisor where it listens: one JSON line on standard output.

use std::io::Write;
use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

/// `{"listening":"policy_server","addr":"127.0.0.1:7401"}`
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Announcement {
    /// What listens.
    pub listening: String,
    /// The bound address; never port 0.
    pub addr: SocketAddr,
}

impl Announcement {
    /// The announcement in a line, if it is one.
    pub fn parse(line: &str) -> Option<Self> {
        serde_json::from_str(line).ok()
    }
}

/// Prints where `listening` is bound, so that whoever started this process with port 0 finds it. A reader that has
/// gone away is no error: the log has the address too.
pub fn announce(listening: &str, addr: SocketAddr) {
    let announcement = Announcement {
        listening: listening.to_owned(),
        addr,
    };
    let mut out = std::io::stdout().lock();
    if serde_json::to_writer(&mut out, &announcement).is_ok() {
        let _ = out.write_all(b"\n").and_then(|()| out.flush());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_an_announcement_or_it_is_not() {
        let line = r#"{"listening":"policy_server","addr":"127.0.0.1:7401"}"#;
        let found = Announcement::parse(line).unwrap();
        assert_eq!(
            (found.listening.as_str(), found.addr.port()),
            ("policy_server", 7401)
        );
        assert_eq!(serde_json::to_string(&found).unwrap(), line);
        assert_eq!(Announcement::parse("{\"event\":\"started\"}"), None);
    }
}
