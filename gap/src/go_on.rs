//! Whether a computation that takes minutes goes on.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use crate::error::GapError;

/// Asked between simulations of seconds each, from any thread. Where nobody is asked, work goes on to its
/// end.
#[derive(Clone, Default)]
pub struct GoOn(Option<Arc<dyn Fn() -> bool + Send + Sync>>);

impl GoOn {
    /// As long as `asked` answers true.
    pub fn as_long_as(asked: impl Fn() -> bool + Send + Sync + 'static) -> Self {
        Self(Some(Arc::new(asked)))
    }

    /// The same, and not beyond `end`, if there is one.
    pub fn until(&self, end: Option<Instant>) -> Self {
        let Some(end) = end else { return self.clone() };
        let asked = self.clone();
        Self::as_long_as(move || asked.check().is_ok() && Instant::now() < end)
    }

    /// Nothing, while work goes on.
    ///
    /// # Errors
    /// [`GapError::Stopped`] where it shall end.
    pub fn check(&self) -> Result<(), GapError> {
        match &self.0 {
            Some(asked) if !asked() => Err(GapError::Stopped),
            _ => Ok(()),
        }
    }
}

impl fmt::Debug for GoOn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.0 {
            Some(_) => "GoOn(asks)",
            None => "GoOn(always)",
        })
    }
}
