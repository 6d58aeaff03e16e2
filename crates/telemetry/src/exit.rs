//! Exit codes, and the one error type that leaves a binary: a code, a line, and a hint where the user can
//! act.

use std::error::Error;
use std::fmt;
use std::io::{self, Write};

use crate::error::ServeError;

/// How a process ended. The numbers follow `sysexits.h` where it has a word for the case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, enum_iterator::Sequence)]
#[repr(u8)]
pub enum ExitCode {
    /// Everything asked for was done.
    Ok = 0,
    /// A configuration key, value or command-line flag is wrong.
    BadConfig = 64,
    /// An input was read and is not valid: robot file, log, policy file.
    BadInput = 65,
    /// An input cannot be read: missing, or no permission.
    NoInput = 66,
    /// A service that this process needs is gone (policy server, learner).
    Unavailable = 69,
    /// A bug, or something nobody foresaw.
    Internal = 70,
    /// The operating system refuses a resource: port in use, no shared memory, too many files.
    OsResource = 71,
    /// An output cannot be created.
    CannotCreate = 73,
    /// Disk full, or an I/O error while writing.
    IoError = 74,
    /// Starved or timed out; the same command may succeed later.
    TempFail = 75,
    /// The far side speaks another protocol or version.
    Protocol = 76,
    /// The policy does not fit this robot, task or process (contract mismatch).
    PolicyRefused = 77,
    /// A checkpoint is damaged.
    CheckpointDamaged = 78,
    /// Everything ran, and a measured figure misses its target.
    TargetMissed = 79,
    /// Diagnosis: several causes explain the gap as well; the report says what to record.
    Ambiguous = 80,
    /// Diagnosis: named causes explain a part of the gap.
    PartlyExplained = 81,
    /// Diagnosis: a gap that no cause of the catalogue explains.
    Unexplained = 82,
    /// Diagnosis: what would show it was not recorded.
    InsufficientData = 83,
    /// Diagnosis: the logs contradict themselves.
    DataFault = 84,
    /// Servos do not say that they let go: their torque may still be on.
    TorqueOn = 86,
    /// Another process is at work in the run folder.
    InUse = 87,
    /// Interrupted by a second Ctrl-C, or before a training had begun: nothing was drained.
    Interrupted = 130,
}

impl ExitCode {
    /// All codes.
    pub fn all() -> impl Iterator<Item = Self> {
        enum_iterator::all()
    }

    /// The number the shell sees.
    pub fn number(self) -> u8 {
        self as u8
    }

    /// The code with this number, so that a supervisor can pass a child's on.
    pub fn from_number(number: i32) -> Option<Self> {
        Self::all().find(|code| i32::from(code.number()) == number)
    }

    /// The code that an I/O error stands for while reading (`writing = false`) or writing.
    pub fn of_io(error: &io::Error, writing: bool) -> Self {
        use io::ErrorKind as K;
        match error.kind() {
            K::AddrInUse | K::AddrNotAvailable => ExitCode::OsResource,
            K::StorageFull | K::QuotaExceeded | K::FileTooLarge => ExitCode::IoError,
            K::ConnectionRefused | K::ConnectionReset | K::ConnectionAborted | K::BrokenPipe => {
                ExitCode::Unavailable
            }
            K::TimedOut => ExitCode::TempFail,
            // Bytes that are no text.
            K::InvalidData if !writing => ExitCode::BadInput,
            K::NotFound | K::PermissionDenied | K::IsADirectory | K::NotADirectory if writing => {
                ExitCode::CannotCreate
            }
            K::NotFound | K::PermissionDenied | K::IsADirectory | K::NotADirectory => {
                ExitCode::NoInput
            }
            _ => ExitCode::IoError,
        }
    }
}

impl From<ExitCode> for std::process::ExitCode {
    fn from(code: ExitCode) -> Self {
        code.number().into()
    }
}

/// Why a process ends early: an exit code, an error with its causes, and a hint where the user can act.
///
/// It does not implement [`Error`], so that `?` turns any error into it: an [`io::Error`] anywhere in
/// the chain of causes picks the code, anything else is [`ExitCode::Internal`]. Say better with
/// [`FailureExt::or_exit`] wherever the cause is known.
pub struct Failure {
    code: ExitCode,
    error: anyhow::Error,
    hint: Option<String>,
    /// What the line begins with.
    label: &'static str,
}

impl Failure {
    /// A failure from an error or a message.
    pub fn new(code: ExitCode, error: impl Into<anyhow::Error>) -> Self {
        Self { code, error: error.into(), hint: None, label: "error" }
    }

    /// The outcome of a command that did all it was asked to, where the outcome has an exit code of its own
    /// (a verdict, a missed target): it is printed as `result: …`, not as an error.
    pub fn outcome(code: ExitCode, message: impl fmt::Display) -> Self {
        Self { label: "result", ..Self::message(code, message) }
    }

    /// The failure of a child process that has said itself what went wrong: only the code is passed on,
    /// nothing is printed again.
    pub fn said_already(code: ExitCode) -> Self {
        Self { label: "", ..Self::message(code, "the child process has said why") }
    }

    /// A failure from a message: lower case, no full stop.
    pub fn message(code: ExitCode, message: impl fmt::Display) -> Self {
        Self::new(code, anyhow::anyhow!("{message}"))
    }

    /// Adds what the user can do about it.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// The same where there is something.
    pub fn hint_if(mut self, hint: Option<impl Into<String>>) -> Self {
        self.hint = hint.map(Into::into).or(self.hint);
        self
    }

    /// Puts what was being done in front of the error.
    pub fn context(mut self, what: impl fmt::Display + Send + Sync + 'static) -> Self {
        self.error = self.error.context(what);
        self
    }

    /// The exit code.
    pub fn code(&self) -> ExitCode {
        self.code
    }

    /// The hint, if there is one.
    pub fn hint_text(&self) -> Option<&str> {
        self.hint.as_deref()
    }

    /// Writes the one line `error: …` (or `result: …`) with all causes, and `hint: …` below it.
    pub fn write_to(&self, out: &mut dyn Write) -> io::Result<()> {
        if self.label.is_empty() {
            return Ok(());
        }
        writeln!(out, "{}: {self}", self.label)?;
        if let Some(hint) = &self.hint {
            writeln!(out, "hint: {hint}")?;
        }
        Ok(())
    }
}

impl fmt::Display for Failure {
    /// The error and its causes on one line; a cause that the line already says is not repeated.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut line = String::new();
        for cause in self.error.chain() {
            let text = cause.to_string().replace('\n', " ");
            if line.contains(&text) {
                continue;
            }
            if !line.is_empty() {
                line.push_str(": ");
            }
            line.push_str(text.trim());
        }
        f.write_str(&line)
    }
}

impl fmt::Debug for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?} ({}): {self}", self.code, self.code.number())
    }
}

impl<E: Error + Send + Sync + 'static> From<E> for Failure {
    fn from(error: E) -> Self {
        let error = anyhow::Error::from(error);
        if error.is::<ServeError>() {
            return Self::new(ExitCode::OsResource, error)
                .hint("choose another address, or port 0 for any free one");
        }
        let code = error
            .chain()
            .find_map(|cause| cause.downcast_ref::<io::Error>())
            .map_or(ExitCode::Internal, |io| ExitCode::of_io(io, false));
        Self { code, error, hint: None, label: "error" }
    }
}

/// Names the exit code at the place where the cause is known.
pub trait FailureExt<T> {
    /// On error, end with this code.
    fn or_exit(self, code: ExitCode) -> Result<T, Failure>;
    /// On error, end with this code and say what was being done.
    fn or_exit_with<C>(self, code: ExitCode, what: impl FnOnce() -> C) -> Result<T, Failure>
    where
        C: fmt::Display + Send + Sync + 'static;
}

impl<T, E: Into<anyhow::Error>> FailureExt<T> for Result<T, E> {
    fn or_exit(self, code: ExitCode) -> Result<T, Failure> {
        self.map_err(|error| Failure::new(code, error))
    }

    fn or_exit_with<C>(self, code: ExitCode, what: impl FnOnce() -> C) -> Result<T, Failure>
    where
        C: fmt::Display + Send + Sync + 'static,
    {
        self.map_err(|error| Failure::new(code, error).context(what()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_has_its_own_number_and_comes_back_from_it() {
        for code in ExitCode::all() {
            assert_eq!(ExitCode::from_number(i32::from(code.number())), Some(code));
        }
        assert_eq!(ExitCode::from_number(1), None);
    }

    #[test]
    fn an_io_error_in_the_chain_picks_the_code() {
        let cases = [
            (io::ErrorKind::AddrInUse, ExitCode::OsResource),
            (io::ErrorKind::NotFound, ExitCode::NoInput),
            (io::ErrorKind::StorageFull, ExitCode::IoError),
            (io::ErrorKind::ConnectionRefused, ExitCode::Unavailable),
        ];
        for (kind, code) in cases {
            assert_eq!(Failure::from(io::Error::from(kind)).code(), code, "{kind:?}");
        }
        let writing = ExitCode::of_io(&io::ErrorKind::NotFound.into(), true);
        assert_eq!(writing, ExitCode::CannotCreate);
    }

    #[test]
    fn a_failure_prints_one_line_and_a_hint() {
        let failure = Failure::message(ExitCode::BadConfig, "port 7 is taken")
            .context("cannot start the server")
            .hint("choose another port");
        let mut out = Vec::new();
        failure.write_to(&mut out).unwrap();
        assert_eq!(
            String::from_utf8(out).unwrap(),
            "error: cannot start the server: port 7 is taken\nhint: choose another port\n"
        );
        let mut out = Vec::new();
        let outcome = Failure::outcome(ExitCode::Ambiguous, "delay or low-pass");
        outcome.write_to(&mut out).unwrap();
        assert_eq!(out, b"result: delay or low-pass\n");
        assert_eq!(outcome.code(), ExitCode::Ambiguous);
        let mut out = Vec::new();
        let passed_on = Failure::said_already(ExitCode::Unavailable);
        passed_on.write_to(&mut out).unwrap();
        assert_eq!((out.as_slice(), passed_on.code()), (&b""[..], ExitCode::Unavailable));
    }
}
