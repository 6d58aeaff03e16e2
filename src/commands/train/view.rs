//! Showing progress: a bar on a terminal, plain lines elsewhere, the events themselves with `--json`.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use caudata_durable::OwnerError;
use caudata_telemetry::StopFlag;
use caudata_telemetry::progress::{Changed, Event, Iteration, Started, Warning};
use indicatif::ProgressBar;

use crate::say;

/// Plain lines come no faster than this, except the last one.
const PLAIN_EVERY: Duration = Duration::from_secs(1);
/// Pause between two looks at a run folder that another process has.
const OWNER_PAUSE: Duration = Duration::from_millis(100);

/// Where progress goes.
#[derive(Clone)]
pub enum View {
    /// Standard error is a terminal.
    Bar(ProgressBar),
    /// It is not.
    Plain {
        /// When the last line was printed.
        last: Option<Instant>,
    },
    /// `--json`: the events as they come.
    Json,
}

impl View {
    /// The view that fits the flags and the terminal.
    pub fn new(json: bool) -> Self {
        if json {
            return View::Json;
        }
        if !std::io::stderr().is_terminal() {
            return View::Plain { last: None };
        }
        View::Bar(say::laid_out(ProgressBar::new(0), "{bar:24} {pos}/{len}  {msg}"))
    }

    /// Shows an event of the learner, which came as `line`.
    pub fn event(&mut self, event: &Event, line: &str) {
        match (&mut *self, event) {
            (View::Json, _) => say::line(line),
            (_, Event::Started(started)) => self.started(started),
            (_, Event::Iteration(iteration)) => self.iteration(iteration),
            (_, Event::Changed(Changed { iteration, set })) => {
                self.note(&format!("changed after iteration {iteration}: {}", set.join(", ")));
            }
            (_, Event::Warning(warning)) => self.warn(&warning.message),
            (_, Event::Checkpoint(_) | Event::Published(_) | Event::Finished(_)) => {}
        }
    }

    /// A line for a person, above the bar; not among the events.
    pub fn note(&self, text: &str) {
        match self {
            View::Bar(bar) => bar.println(text),
            View::Plain { .. } => say::line(text),
            View::Json => tracing::info!("{text}"),
        }
    }

    /// For a run folder that another process still has: says once whom it waits for, until `stop` is raised.
    pub fn wait_for_owner<'a>(
        &'a self,
        stop: &'a StopFlag,
    ) -> impl FnMut(&OwnerError) -> bool + 'a {
        let mut said = false;
        move |taken| {
            if !std::mem::replace(&mut said, true) {
                self.note(&format!("{taken}; waiting for its end"));
            }
            !stop.wait(OWNER_PAUSE)
        }
    }

    /// Something that should not have happened; with `--json` an event.
    pub fn warn(&self, text: &str) {
        let View::Json = self else { return self.note(&format!("warning: {text}")) };
        let warning = Event::Warning(Warning { message: text.to_owned() });
        if let Ok(line) = serde_json::to_string(&warning) {
            say::line(line);
        }
    }

    /// Leaves the last state of the bar on the screen.
    pub fn done(&self) {
        if let View::Bar(bar) = self {
            bar.abandon();
        }
    }

    fn started(&mut self, started: &Started) {
        let from = started.resumed_from.as_ref().map(|path| format!(", resumed from {path}"));
        let metrics =
            started.metrics.as_ref().map(|addr| format!(", metrics at http://{addr}/metrics"));
        let [from, metrics] = [from, metrics].map(Option::unwrap_or_default);
        if started.iteration >= started.iterations {
            return self.note(&format!(
                "nothing left to learn: {} iterations are done{from}; more with --iterations",
                started.iteration
            ));
        }
        self.note(&format!(
            "learning on {}, iterations {} to {}{from}{metrics}",
            started.device,
            started.iteration + 1,
            started.iterations
        ));
        if let View::Bar(bar) = self {
            bar.set_length(started.iterations);
            bar.set_position(started.iteration);
        }
    }

    fn iteration(&mut self, iteration: &Iteration) {
        match self {
            View::Bar(bar) => {
                bar.set_position(iteration.iteration);
                bar.set_message(summary(iteration));
            }
            View::Plain { last } => {
                let due = last.is_none_or(|last| last.elapsed() >= PLAIN_EVERY);
                if due || iteration.iteration == iteration.iterations {
                    *last = Some(Instant::now());
                    say::line(format!(
                        "{}/{}  {}",
                        iteration.iteration,
                        iteration.iterations,
                        summary(iteration)
                    ));
                }
            }
            View::Json => {}
        }
    }
}

/// An iteration on one line.
fn summary(iteration: &Iteration) -> String {
    let episodes = match (iteration.mean_return, iteration.mean_episode_length) {
        (Some(mean), Some(length)) => format!("return {mean:.2}  length {length:.0}"),
        _ => format!("reward/step {:.4}", iteration.mean_step_reward),
    };
    format!(
        "{:.0} steps/s  {episodes}  lag {:.1}  KL {:.4}  ETA {}",
        iteration.steps_per_s,
        iteration.lag_mean,
        iteration.kl,
        clock(iteration.eta_s)
    )
}

/// `m:ss` or `h:mm:ss`.
pub fn clock(seconds: f64) -> String {
    if !seconds.is_finite() {
        return "?".into();
    }
    let seconds = seconds.max(0.0).round() as u64;
    let (hours, minutes, seconds) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
    match hours {
        0 => format!("{minutes}:{seconds:02}"),
        _ => format!("{hours}:{minutes:02}:{seconds:02}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_reads_naturally() {
        assert_eq!(clock(0.4), "0:00");
        assert_eq!(clock(125.0), "2:05");
        assert_eq!(clock(3_725.0), "1:02:05");
        assert_eq!(clock(f64::INFINITY), "?");
    }

    #[test]
    fn a_summary_speaks_of_episodes_once_there_are_any() {
        let mut iteration =
            Iteration { steps_per_s: 3041.2, kl: 0.0092, eta_s: 130.0, ..Default::default() };
        iteration.mean_step_reward = 0.0123;
        assert_eq!(
            summary(&iteration),
            "3041 steps/s  reward/step 0.0123  lag 0.0  KL 0.0092  ETA 2:10"
        );
        iteration.mean_return = Some(12.345);
        iteration.mean_episode_length = Some(498.7);
        assert!(
            summary(&iteration).contains("return 12.35  length 499")
                || summary(&iteration).contains("return 12.34  length 499")
        );
    }
}
