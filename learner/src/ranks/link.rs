//! One connection between two ranks: TCP, with TLS on both sides where it leaves this host. Blocking, with a time limit for every frame.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_signing::pki::{CA_FILE, CERTIFICATE_FILE, KEY_FILE, Role, identity_of_der};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::server::WebPkiClientVerifier;
use rustls::{
    ClientConfig, ClientConnection, Connection, RootCertStore, ServerConfig, ServerConnection,
};

use super::wire::{GREETING_MAX, HEAD_BYTES, Kind, PAYLOAD_MAX, Writer, head, parse_head};

/// Longest single wait on the socket; between two the clock and the flag are looked at.
const SLICE: Duration = Duration::from_millis(100);
/// Bytes that are asked for at once, so that memory follows what has come and not what was announced.
const READ_STEP: usize = 4 << 20;

/// Why a connection cannot be used any more, in words.
pub type Broken = String;

/// What a link runs over. A call touches the socket once or twice and never loops, so that it returns within two slices, come what may.
trait Duplex: Read + Write + Send + std::fmt::Debug {}
impl<T: Read + Write + Send + std::fmt::Debug> Duplex for T {}

/// A connection to another rank.
#[derive(Debug)]
pub struct Link {
    stream: Box<dyn Duplex>,
    /// Of the other side.
    pub peer: SocketAddr,
    payload: Vec<u8>,
    /// Longest payload that is received.
    payload_max: u64,
}

/// TLS over a socket, a step at a time: the streams of rustls go on as long as single bytes come.
#[derive(Debug)]
struct Tls {
    session: Connection,
    socket: TcpStream,
}

impl Tls {
    /// After the handshake, with another learner.
    fn over(
        session: Connection,
        socket: TcpStream,
        patience: Duration,
        mut look: impl FnMut() -> Result<(), Broken>,
    ) -> Result<Self, Broken> {
        let mut tls = Self { session, socket };
        let until = Instant::now() + patience;
        while tls.session.is_handshaking() || tls.session.wants_write() {
            look()?;
            in_time(until, "did not finish the handshake")?;
            moved(tls.step())?;
        }
        check_role(tls.session.peer_certificates())?;
        Ok(tls)
    }

    /// One write on the socket where there is something to write, else one read.
    fn step(&mut self) -> io::Result<usize> {
        if self.session.wants_write() {
            return self.session.write_tls(&mut self.socket);
        }
        let come = self.session.read_tls(&mut self.socket)?;
        if let Err(error) = self.session.process_new_packets() {
            // Tells the other side why.
            let _ = self.session.write_tls(&mut self.socket);
            return Err(io::Error::new(ErrorKind::InvalidData, error));
        }
        Ok(come)
    }
}

impl Read for Tls {
    fn read(&mut self, room: &mut [u8]) -> io::Result<usize> {
        let held = self.session.reader().read(room);
        match held {
            Err(error) if error.kind() == ErrorKind::WouldBlock => {
                self.step()?;
                self.session.reader().read(room)
            }
            done => done,
        }
    }
}

impl Write for Tls {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.session.wants_write() {
            self.session.write_tls(&mut self.socket)?;
        }
        match self.session.writer().write(bytes)? {
            // What the session holds has not gone out yet.
            0 => Err(ErrorKind::WouldBlock.into()),
            taken => Ok(taken),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.session.wants_write() {
            self.session.write_tls(&mut self.socket)?;
        }
        match self.session.wants_write() {
            true => Err(ErrorKind::WouldBlock.into()),
            false => Ok(()),
        }
    }
}

/// Certificates of a process, for both sides of a connection.
#[derive(Clone, Debug)]
pub struct Certificates {
    server: Arc<ServerConfig>,
    client: Arc<ClientConfig>,
}

impl Certificates {
    /// `ca.crt`, `tls.crt` and `tls.key` of `folder`.
    ///
    /// # Errors
    /// In words: the file that cannot be used, and why.
    pub fn read(folder: &Path) -> Result<Self, String> {
        let path = |name: &str| folder.join(name);
        let named = |name: &str, error: &dyn std::fmt::Display| {
            format!("cannot use {}: {error}", path(name).display())
        };
        let chain = |name: &'static str| -> Result<Vec<CertificateDer<'static>>, String> {
            let read = CertificateDer::pem_file_iter(path(name)).map_err(|e| named(name, &e))?;
            read.collect::<Result<_, _>>().map_err(|e| named(name, &e))
        };
        let mut roots = RootCertStore::empty();
        for root in chain(CA_FILE)? {
            roots.add(root).map_err(|e| named(CA_FILE, &e))?;
        }
        let roots = Arc::new(roots);
        let own = chain(CERTIFICATE_FILE)?;
        let key = PrivateKeyDer::from_pem_file(path(KEY_FILE)).map_err(|e| named(KEY_FILE, &e))?;
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let versions = &[&rustls::version::TLS13];
        let verifier =
            WebPkiClientVerifier::builder_with_provider(Arc::clone(&roots), Arc::clone(&provider))
                .build()
                .map_err(|e| named(CA_FILE, &e))?;
        let server = ServerConfig::builder_with_provider(Arc::clone(&provider))
            .with_protocol_versions(versions)
            .map_err(|e| named(CERTIFICATE_FILE, &e))?
            .with_client_cert_verifier(verifier)
            .with_single_cert(own.clone(), key.clone_key())
            .map_err(|e| named(CERTIFICATE_FILE, &e))?;
        let client = ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(versions)
            .map_err(|e| named(CERTIFICATE_FILE, &e))?
            .with_root_certificates(roots)
            .with_client_auth_cert(own, key)
            .map_err(|e| named(CERTIFICATE_FILE, &e))?;
        Ok(Self {
            server: Arc::new(server),
            client: Arc::new(client),
        })
    }
}

/// A certificate of the lab is not enough: ranks are learners.
fn check_role(chain: Option<&[CertificateDer<'_>]>) -> Result<(), Broken> {
    let own = chain.and_then(<[_]>::first);
    let own = own.ok_or_else(|| "it shows no certificate".to_owned())?;
    match identity_of_der(own)?.role {
        Role::Learner => Ok(()),
        other => Err(format!("its certificate is that of {other}, not learner")),
    }
}

fn prepared(stream: &TcpStream) -> io::Result<SocketAddr> {
    // Accepted sockets may inherit the listener's mode.
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(SLICE))?;
    stream.set_write_timeout(Some(SLICE))?;
    stream.peer_addr()
}

impl Link {
    /// The side that accepted. The handshake must end within `patience`; `look` is called between its steps and may give up.
    ///
    /// # Errors
    /// In words.
    pub fn accepted(
        stream: TcpStream,
        certificates: Option<&Certificates>,
        patience: Duration,
        look: impl FnMut() -> Result<(), Broken>,
    ) -> Result<Self, Broken> {
        let peer = prepared(&stream).map_err(|e| e.to_string())?;
        let stream: Box<dyn Duplex> = match certificates {
            None => Box::new(stream),
            Some(certificates) => {
                let session = ServerConnection::new(Arc::clone(&certificates.server));
                let session = session.map_err(|e| e.to_string())?;
                Box::new(Tls::over(session.into(), stream, patience, look)?)
            }
        };
        Ok(Self::over(stream, peer))
    }

    /// The side that connected, to a host of this name; as [`accepted`](Self::accepted).
    ///
    /// # Errors
    /// In words.
    pub fn connected(
        stream: TcpStream,
        certificates: Option<&Certificates>,
        host: &str,
        patience: Duration,
        look: impl FnMut() -> Result<(), Broken>,
    ) -> Result<Self, Broken> {
        let peer = prepared(&stream).map_err(|e| e.to_string())?;
        let stream: Box<dyn Duplex> = match certificates {
            None => Box::new(stream),
            Some(certificates) => {
                let name = ServerName::try_from(host.to_owned()).map_err(|e| e.to_string())?;
                let session = ClientConnection::new(Arc::clone(&certificates.client), name);
                let session = session.map_err(|e| e.to_string())?;
                Box::new(Tls::over(session.into(), stream, patience, look)?)
            }
        };
        Ok(Self::over(stream, peer))
    }

    fn over(stream: Box<dyn Duplex>, peer: SocketAddr) -> Self {
        Self {
            stream,
            peer,
            payload: Vec::new(),
            payload_max: GREETING_MAX,
        }
    }

    /// The other side is known now: its frames may be long.
    pub fn admit(&mut self) {
        self.payload_max = PAYLOAD_MAX;
    }

    /// Sends one frame within `patience`.
    ///
    /// # Errors
    /// In words; the connection is of no use then.
    pub fn send(&mut self, kind: Kind, payload: &Writer, patience: Duration) -> Result<(), Broken> {
        let until = Instant::now() + patience;
        let head = head(kind, payload.0.len())?;
        for mut bytes in [head.as_slice(), payload.0.as_slice()] {
            while !bytes.is_empty() {
                in_time(until, "did not take a frame")?;
                let taken = moved(self.stream.write(bytes))?;
                bytes = &bytes[taken..];
            }
        }
        while let Err(error) = self.stream.flush() {
            again(&error)?;
            in_time(until, "did not take a frame")?;
        }
        Ok(())
    }

    /// The next frame, which must come within `patience`; `look` is called ten times a second or more and may give up.
    ///
    /// # Errors
    /// In words; the connection is of no use then.
    pub fn receive(
        &mut self,
        patience: Duration,
        mut look: impl FnMut() -> Result<(), Broken>,
    ) -> Result<(Kind, &[u8]), Broken> {
        let until = Instant::now() + patience;
        let mut head = [0; HEAD_BYTES];
        self.fill(&mut head, until, &mut look)?;
        let (kind, length) = parse_head(&head, self.payload_max)?;
        let length = usize::try_from(length).map_err(|e| e.to_string())?;
        let mut payload = std::mem::take(&mut self.payload);
        payload.clear();
        while payload.len() < length {
            let first = payload.len();
            payload.resize(length.min(first + READ_STEP), 0);
            self.fill(&mut payload[first..], until, &mut look)?;
        }
        self.payload = payload;
        Ok((kind, &self.payload))
    }

    /// As [`receive`](Self::receive), of one kind.
    ///
    /// # Errors
    /// Another kind is an error, too.
    pub fn expect(&mut self, wanted: Kind, patience: Duration) -> Result<&[u8], Broken> {
        let (kind, payload) = self.receive(patience, || Ok(()))?;
        if kind == wanted {
            return Ok(payload);
        }
        Err(format!("it sent {kind:?} instead of {wanted:?}"))
    }

    fn fill(
        &mut self,
        mut room: &mut [u8],
        until: Instant,
        look: &mut impl FnMut() -> Result<(), Broken>,
    ) -> Result<(), Broken> {
        while !room.is_empty() {
            look()?;
            in_time(until, "did not send a frame")?;
            let come = moved(self.stream.read(room))?;
            room = &mut room[come..];
        }
        Ok(())
    }
}

/// Looked at before every step, whatever the last one has moved.
fn in_time(until: Instant, what: &str) -> Result<(), Broken> {
    match Instant::now() < until {
        true => Ok(()),
        false => Err(format!("it {what} in time")),
    }
}

/// The bytes that a step has moved: none where it is to be tried once more.
fn moved(step: io::Result<usize>) -> Result<usize, Broken> {
    match step {
        Ok(0) => Err("it closed the connection".to_owned()),
        Ok(count) => Ok(count),
        Err(error) => again(&error).map(|()| 0),
    }
}

/// Whether to try once more after `error`.
fn again(error: &io::Error) -> Result<(), Broken> {
    match error.kind() {
        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted => Ok(()),
        ErrorKind::ConnectionReset | ErrorKind::BrokenPipe | ErrorKind::UnexpectedEof => {
            Err("it closed the connection".to_owned())
        }
        _ => Err(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_signing::pki::{Authority, Request};
    use std::net::TcpListener;
    use std::time::SystemTime;

    const PATIENCE: Duration = Duration::from_secs(20);

    /// What both sides of a connection say of its beginning.
    fn meet(
        server: Option<&Certificates>,
        client: Option<&Certificates>,
    ) -> [Result<Link, Broken>; 2] {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let client = client.cloned();
        let connecting = std::thread::spawn(move || {
            let stream = TcpStream::connect(address).unwrap();
            let client = client.as_ref();
            let mut link = Link::connected(stream, client, "localhost", PATIENCE, || Ok(()))?;
            // TLS 1.3: the one who connects hears of a refusal with the first answer.
            link.expect(Kind::Welcome, PATIENCE)?;
            link.admit();
            Ok(link)
        });
        let (stream, _) = listener.accept().unwrap();
        let mut accepted = Link::accepted(stream, server, PATIENCE, || Ok(()));
        if let Ok(link) = &mut accepted {
            link.send(Kind::Welcome, &Writer::default(), PATIENCE)
                .unwrap();
        }
        [accepted, connecting.join().unwrap()]
    }

    fn certificates(dir: &Path, role: Role) -> Certificates {
        let folder = &dir.join("lab");
        let now = SystemTime::now();
        let authority = Authority::open(folder)
            .or_else(|_| Authority::create(folder, "test", now))
            .unwrap();
        let request = Request {
            role,
            name: role.name().to_owned(),
            hosts: vec!["localhost".to_owned()],
            days: 1,
        };
        Certificates::read(&authority.issue(&request, now, false).unwrap()).unwrap()
    }

    #[test]
    fn frames_of_any_length_pass_with_and_without_tls() {
        let dir = tempfile::tempdir().unwrap();
        let learner = certificates(dir.path(), Role::Learner);
        for own in [None, Some(&learner)] {
            let [here, there] = meet(own, own).map(Result::unwrap);
            let [mut here, mut there] = [here, there];
            for length in [0_usize, 1, 4096, 9_000_001] {
                let payload = Writer((0..length).map(|i| i as u8).collect());
                let expected = payload.0.clone();
                let sending = std::thread::spawn(move || {
                    here.send(Kind::Table, &payload, PATIENCE).unwrap();
                    here
                });
                assert_eq!(there.expect(Kind::Table, PATIENCE).unwrap(), expected);
                here = sending.join().unwrap();
            }
        }
    }

    #[test]
    fn only_a_learner_is_a_rank() {
        let [dir, elsewhere] = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let learner = certificates(dir.path(), Role::Learner);
        let actor = certificates(dir.path(), Role::Actor);
        let [accepted, _] = meet(Some(&learner), Some(&actor));
        assert!(accepted.unwrap_err().contains("actor, not learner"));
        let stranger = certificates(elsewhere.path(), Role::Learner);
        let [accepted, connected] = meet(Some(&learner), Some(&stranger));
        assert!(accepted.is_err() && connected.is_err());
        let [accepted, connected] = meet(Some(&learner), None);
        assert!(accepted.is_err() && connected.is_err());
    }

    #[test]
    fn silence_and_a_closed_connection_are_told_apart() {
        let [here, there] = meet(None, None).map(Result::unwrap);
        let [mut here, there] = [here, there];
        let silent = here.expect(Kind::Total, Duration::from_millis(300));
        assert!(silent.unwrap_err().contains("in time"));
        drop(there);
        let closed = here.expect(Kind::Total, PATIENCE);
        assert!(closed.unwrap_err().contains("closed"));
    }

    /// The accepted side of a connection to a peer that sends `at_once`, and then `drops` byte by byte, faster than a slice, for 20 s or
    /// until nobody listens.
    fn dripping(at_once: Vec<u8>, drops: Vec<u8>) -> TcpStream {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut peer = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        peer.set_nodelay(true).unwrap();
        std::thread::spawn(move || {
            peer.write_all(&at_once).unwrap();
            for drop in drops {
                std::thread::sleep(Duration::from_millis(20));
                if peer.write_all(&[drop]).is_err() {
                    return;
                }
            }
        });
        listener.accept().unwrap().0
    }

    fn frame(kind: Kind, length: usize) -> Vec<u8> {
        let mut frame = head(kind, length).unwrap().to_vec();
        frame.resize(HEAD_BYTES + length, 0);
        frame
    }

    #[test]
    fn a_peer_that_drips_bytes_is_waited_for_no_longer_than_a_silent_one() {
        let short = Duration::from_millis(300);
        let plain = |stream| Link::accepted(stream, None, PATIENCE, || Ok(())).unwrap();

        let mut link = plain(dripping(Vec::new(), frame(Kind::Hello, 1000)));
        let late = link.expect(Kind::Hello, short).unwrap_err();
        assert!(late.contains("in time"), "{late}");

        let stream = dripping(frame(Kind::Hello, 9), frame(Kind::Total, 1000));
        let mut link = plain(stream);
        link.expect(Kind::Hello, PATIENCE).unwrap();
        let late = link.expect(Kind::Total, short).unwrap_err();
        assert!(late.contains("in time"), "{late}");

        // A handshake that begins with a record of 16 KiB.
        let dir = tempfile::tempdir().unwrap();
        let learner = certificates(dir.path(), Role::Learner);
        let mut record = vec![22, 3, 1, 0x40, 0];
        record.resize(1000, 0);
        let stream = dripping(Vec::new(), record);
        let late = Link::accepted(stream, Some(&learner), short, || Ok(())).unwrap_err();
        assert!(late.contains("in time"), "{late}");
    }

    #[test]
    fn a_wait_is_given_up_while_bytes_drip() {
        let stream = dripping(Vec::new(), frame(Kind::Hello, 1000));
        let mut link = Link::accepted(stream, None, PATIENCE, || Ok(())).unwrap();
        let mut looks = 0;
        let given_up = link.receive(PATIENCE * 10, || {
            looks += 1;
            match looks > 5 {
                true => Err("asked".to_owned()),
                false => Ok(()),
            }
        });
        assert_eq!(given_up.unwrap_err(), "asked");
    }

    #[test]
    fn who_is_not_known_yet_sends_no_long_frames() {
        let announced = head(Kind::Hello, 1 << 20).unwrap().to_vec();
        let stream = dripping(announced, Vec::new());
        let mut link = Link::accepted(stream, None, PATIENCE, || Ok(())).unwrap();
        let refused = link.expect(Kind::Hello, PATIENCE).unwrap_err();
        assert!(refused.contains("more than"), "{refused}");
    }
}
