//! Rank 0's side: gathering the others, and an update over all of them.

use std::io::ErrorKind;
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};

use caudata_telemetry::StopFlag;
use tch::Tensor;

use super::link::{Certificates, Link};
use super::wire::{Forward, Hello, Kind, PAYLOAD_MAX, Reader, Writer, check_length};
use super::{RankSettings, share, unless_asked};
use crate::LearnerError;
use crate::network::ActorCritic;
use crate::ppo::{Drawn, Head, Local, Minibatch, Reduction, Total, host};

/// Pause between two looks at the listener.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// How long one that connects may take to introduce itself. Others wait for it.
const HELLO_MAX: Duration = Duration::from_secs(5);
/// How long a rank may take to hear of the end.
const END_MAX: Duration = Duration::from_secs(1);

/// The ranks of a run, seen from rank 0.
#[derive(Debug)]
pub struct Ranks {
    local: Local,
    /// Ranks 1, 2, … in order.
    others: Vec<Link>,
    answer_timeout: Duration,
    leaving: Option<u32>,
    out: Writer,
}

impl Ranks {
    /// Listens at the address of `settings` and waits until every other rank is there. `net` is worked on by `threads` threads of this process.
    ///
    /// # Errors
    /// When the address cannot be had, certificates are missing, ranks do not come in time, or `stop` is raised while they are waited for.
    pub fn gather(
        settings: &RankSettings,
        net: &ActorCritic,
        threads: usize,
        stop: &StopFlag,
    ) -> Result<Self, LearnerError> {
        let (addresses, folder) = settings.resolve()?;
        let listener = TcpListener::bind(addresses.as_slice())
            .and_then(|listener| listener.set_nonblocking(true).map(|()| listener))
            .map_err(|source| LearnerError::RankAddress {
                address: settings.address.clone(),
                source,
            })?;
        Self::gather_at(&listener, folder.is_some(), settings, net, threads, stop)
    }

    /// As [`gather`](Self::gather), at a listener that does not block.
    ///
    /// # Errors
    /// As there.
    pub fn gather_at(
        listener: &TcpListener,
        secured: bool,
        settings: &RankSettings,
        net: &ActorCritic,
        threads: usize,
        stop: &StopFlag,
    ) -> Result<Self, LearnerError> {
        let folder = settings.tls_dir.as_deref().filter(|_| secured);
        let certificates = folder
            .map(Certificates::read)
            .transpose()
            .map_err(LearnerError::setting)?;
        let mut seats: Vec<Option<Link>> = (1..settings.count).map(|_| None).collect();
        let until = Instant::now() + settings.join_timeout;
        while seats.iter().any(Option::is_none) {
            let asked = stop.is_set();
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() || asked {
                let missing = (1..settings.count)
                    .zip(&seats)
                    .filter(|(_, seat)| seat.is_none());
                let missing: Vec<String> = missing.map(|(rank, _)| rank.to_string()).collect();
                return Err(LearnerError::RanksMissing {
                    missing: missing.join(", "),
                    address: settings.address.clone(),
                    why: match asked {
                        true => "until this one was asked to stop".to_owned(),
                        false => format!("within {:.0} s", settings.join_timeout.as_secs_f64()),
                    },
                });
            }
            match listener.accept() {
                Ok((stream, peer)) => {
                    let patience = HELLO_MAX.min(left);
                    let certificates = certificates.as_ref();
                    match greet(
                        stream,
                        certificates,
                        settings,
                        net,
                        &mut seats,
                        patience,
                        stop,
                    ) {
                        Ok(rank) => tracing::info!(rank, %peer, "a rank is here"),
                        Err(reason) => tracing::warn!(%peer, reason, "a rank is refused"),
                    }
                }
                Err(error) => {
                    if error.kind() != ErrorKind::WouldBlock {
                        tracing::warn!(%error, "a rank could not connect");
                    }
                    stop.wait(LOOK_EVERY);
                }
            }
        }
        Ok(Self {
            local: Local::new(net, threads, settings.count as usize)?,
            others: seats.into_iter().flatten().collect(),
            answer_timeout: settings.answer_timeout,
            leaving: None,
            out: Writer::default(),
        })
    }

    fn count(&self) -> u32 {
        self.others.len() as u32 + 1
    }

    /// Sends what `self.out` holds to all others.
    fn tell_all(&mut self, kind: Kind) -> Result<(), LearnerError> {
        check_length(self.out.0.len() as u64, PAYLOAD_MAX).map_err(|reason| {
            LearnerError::setting(format!(
                "a batch is too large for several ranks: {kind:?} is {reason}"
            ))
        })?;
        let patience = self.answer_timeout;
        for (rank, link) in (1..).zip(&mut self.others) {
            link.send(kind, &self.out, patience)
                .map_err(|reason| lost(rank, link, reason))?;
        }
        Ok(())
    }

    fn tell_parameters(&mut self) -> Result<(), LearnerError> {
        self.out.0.clear();
        self.out.f32s(&self.local.net().to_vec()?);
        self.tell_all(Kind::Parameters)
    }
}

/// A rank that connected: its number when it has a seat now, else why not. `patience` is for each of its steps.
fn greet(
    stream: TcpStream,
    certificates: Option<&Certificates>,
    settings: &RankSettings,
    net: &ActorCritic,
    seats: &mut [Option<Link>],
    patience: Duration,
    stop: &StopFlag,
) -> Result<u32, String> {
    let mut link = Link::accepted(stream, certificates, patience, || unless_asked(stop))?;
    let hello = match link.receive(patience, || unless_asked(stop))? {
        (Kind::Hello, payload) => Reader(payload).hello(),
        (other, _) => return Err(format!("it sent {other:?} instead of a hello")),
    };
    let seat = hello.and_then(|hello| seat_of(&hello, settings, net));
    let mut words = Writer::default();
    match seat {
        Ok(index) => {
            link.send(Kind::Welcome, &words, HELLO_MAX)?;
            link.admit();
            // One that comes twice has lost its first connection; two processes with one number are found out when the first is missed.
            seats[index] = Some(link);
            Ok(index as u32 + 1)
        }
        Err(reason) => {
            words.text(&reason);
            link.send(Kind::Refused, &words, HELLO_MAX)?;
            Err(reason)
        }
    }
}

/// The place of the rank that says `hello`, from 0, or why it has none.
fn seat_of(hello: &Hello, settings: &RankSettings, net: &ActorCritic) -> Result<usize, String> {
    let (own, theirs) = (&settings.identity, &hello.identity);
    if theirs.run_id != own.run_id {
        return Err(format!(
            "it is of run {}, not {}",
            theirs.run_id, own.run_id
        ));
    }
    let parameters = net.layout().len() as u64;
    let same = hello.ranks == settings.count && hello.parameters == parameters;
    if !same || theirs.config_hash != own.config_hash {
        return Err("its configuration is another: start all ranks with the same".to_owned());
    }
    if theirs.contract_hash != own.contract_hash {
        return Err("its robot or task is another: start all ranks with the same".to_owned());
    }
    if !(1..settings.count).contains(&hello.rank) {
        return Err(format!("{} is no rank of {}", hello.rank, settings.count));
    }
    Ok(hello.rank as usize - 1)
}

fn lost(rank: u32, link: &Link, reason: String) -> LearnerError {
    LearnerError::RankLost {
        rank,
        peer: link.peer.to_string(),
        reason,
    }
}

/// An answer of a rank begins with whether it was asked to stop.
fn note_leaving(leaving: &mut Option<u32>, rank: u32, flag: u8) {
    if flag != 0 {
        leaving.get_or_insert(rank);
    }
}

impl Reduction for Ranks {
    fn begin(&mut self, tables: Vec<Tensor>) -> Result<(), LearnerError> {
        self.out.0.clear();
        self.tell_all(Kind::Begin)?;
        for table in &tables {
            let rows = table.size().first().copied().unwrap_or(0);
            self.out.0.clear();
            self.out.u64(rows as u64);
            self.out.f32s(&host(table)?);
            self.tell_all(Kind::Table)?;
        }
        self.local.begin(tables);
        self.tell_parameters()
    }

    fn forward(&mut self, head: Head, table: usize, rows: usize) -> Result<Tensor, LearnerError> {
        self.out.0.clear();
        self.out.forward(&Forward {
            head,
            table: table as u32,
            rows: rows as u64,
        });
        self.tell_all(Kind::Forward)?;
        let (count, ranks) = (self.local.cut(rows).len(), self.count());
        let own = share(0, ranks, count);
        let mut outputs = self.local.forward(head, table, rows, own)?;
        let width = match head {
            Head::Policy => self.local.net().spec().act_dim,
            Head::Value => 1,
        };
        let parts = self.local.cut(rows);
        let device = self.local.net().device();
        for (rank, link) in (1..).zip(&mut self.others) {
            let expected: usize = parts[share(rank, ranks, count)]
                .iter()
                .map(|part| part.1)
                .sum();
            let answer = link.expect(Kind::Outputs, self.answer_timeout);
            let read = answer.and_then(|payload| {
                let mut reader = Reader(payload);
                note_leaving(&mut self.leaving, rank, reader.u8()?);
                let values = reader.f32s()?;
                match values.len() == expected * width {
                    true => Ok(values),
                    false => Err(format!(
                        "it sent {} outputs for {expected} rows",
                        values.len()
                    )),
                }
            });
            let values = match read {
                Ok(values) => values,
                Err(reason) => return Err(lost(rank, link, reason)),
            };
            if expected > 0 {
                let values = Tensor::from_slice(&values).view([expected as i64, width as i64]);
                outputs.push(values.to_device(device));
            }
        }
        Ok(Tensor::cat(&outputs, 0))
    }

    fn load(&mut self, drawn: Drawn) -> Result<(), LearnerError> {
        self.out.0.clear();
        self.out.u64(drawn.rows as u64);
        self.out.f32s(&host(&drawn.prox_log_std)?);
        self.out.f32s(&host(&drawn.samples)?);
        self.tell_all(Kind::Drawn)?;
        self.local.load(drawn);
        Ok(())
    }

    fn shuffle(&mut self, order: &[i64]) -> Result<(), LearnerError> {
        self.out.0.clear();
        let narrow = |&index: &i64| u32::try_from(index);
        let order_narrow: Vec<u32> = order
            .iter()
            .map(narrow)
            .collect::<Result<_, _>>()
            .map_err(|_| LearnerError::setting("a batch is too large for several ranks"))?;
        self.out.u32s(order_narrow);
        self.tell_all(Kind::Shuffle)?;
        self.local.shuffle(order)
    }

    fn gradient(&mut self, minibatch: &Minibatch) -> Result<Total, LearnerError> {
        self.tell_parameters()?;
        self.out.0.clear();
        self.out.minibatch(minibatch);
        self.tell_all(Kind::Gradient)?;
        let (count, ranks) = (self.local.cut(minibatch.part.1).len(), self.count());
        let mut total = Total::default();
        total.add(self.local.gradient(minibatch, share(0, ranks, count))?)?;
        let len = self.local.net().layout().len();
        let device = self.local.net().device();
        for (rank, link) in (1..).zip(&mut self.others) {
            if share(rank, ranks, count).is_empty() {
                continue;
            }
            self.out.0.clear();
            self.out.sums(&total.sums);
            if let Some(gradient) = &total.gradient {
                self.out.f32s(&host(gradient)?);
            }
            let patience = self.answer_timeout;
            let answer = link
                .send(Kind::Before, &self.out, patience)
                .and_then(|()| link.expect(Kind::Total, patience));
            let read = answer.and_then(|payload| {
                let mut reader = Reader(payload);
                note_leaving(&mut self.leaving, rank, reader.u8()?);
                let sums = reader.sums()?;
                let gradient = reader.f32s()?;
                match gradient.len() == len {
                    true => Ok((sums, gradient)),
                    false => Err(format!(
                        "it sent a gradient of {} numbers for {len} parameters",
                        gradient.len()
                    )),
                }
            });
            let (sums, gradient) = match read {
                Ok(read) => read,
                Err(reason) => return Err(lost(rank, link, reason)),
            };
            total = Total {
                sums,
                gradient: Some(Tensor::from_slice(&gradient).to_device(device)),
            };
        }
        Ok(total)
    }

    fn finish(&mut self) {
        self.out.0.clear();
        for (rank, link) in (1..).zip(&mut self.others) {
            if let Err(reason) = link.send(Kind::End, &self.out, END_MAX) {
                tracing::warn!(rank, reason, "a rank did not hear of the end");
            }
        }
    }

    fn leaving(&self) -> Option<u32> {
        self.leaving
    }
}
