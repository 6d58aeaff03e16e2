//! What a run tells while it goes on: progress events, TensorBoard, metrics, curves, `accounting.json`.
//!
//! None of it decides anything: what cannot be written is counted and said once, and training goes on.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use caudata_config::Config;
use caudata_telemetry::progress::{self, Event, EventWriter};
use caudata_telemetry::spans::{self, Part};
use caudata_telemetry::{Advisor, EventFile, IterationLoad, Pulse};

use super::metrics::LearnerMetrics;
use super::settings::ACCOUNT_FILE;
use crate::batch::Accounting;
use crate::checkpoint::EpisodeWindow;
use crate::ppo::UpdateStats;
use crate::report::{History, Point, TERM_PREFIX, draw_curves};

/// Where reports go.
pub(super) struct Reporter {
    run_dir: PathBuf,
    events: EventWriter<Box<dyn Write + Send>>,
    tensorboard: Option<EventFile>,
    pub metrics: LearnerMetrics,
    /// Beats while the run makes progress, or waits for what it needs.
    pub pulse: Pulse,
    advisor: Advisor,
    /// Chunks received and dropped until the last iteration.
    counted: (u64, u64),
    /// Seconds by part of the work until the last iteration.
    spans: [f64; Part::ALL.len()],
    said: bool,
    /// It has said that episodes end at once.
    doubted: bool,
}

/// One finished iteration.
pub(super) struct IterationReport<'a> {
    pub iteration: u64,
    pub iterations: u64,
    pub policy_version: u64,
    pub steps_total: u64,
    /// Names of the reward terms, in the order of all per-term arrays.
    pub term_names: &'a [String],
    pub batch_steps: usize,
    pub mean_step_reward: f64,
    pub lag_mean: f64,
    pub lag_max: u64,
    /// Age at which data is dropped, versions.
    pub lag_allowed: u64,
    pub stats: &'a UpdateStats,
    pub episodes: &'a EpisodeWindow,
    pub accounting: &'a Accounting,
    pub collection_s: f64,
    pub learning_s: f64,
    /// Collection, learning and everything else.
    pub total_s: f64,
    /// Seconds of training since the run began.
    pub wall_s: f64,
    pub eta_s: f64,
}

/// From this iteration on it is said when episodes are shorter than [`AT_ONCE`] control steps: nothing can be
/// learned from such.
const DOUBT_FROM: u64 = 3;
const AT_ONCE: f64 = 5.0;

impl Reporter {
    pub fn new(
        run_dir: &Path,
        events: Box<dyn Write + Send>,
        metrics: LearnerMetrics,
        pulse: Pulse,
    ) -> Self {
        let mut reporter = Self {
            run_dir: run_dir.to_owned(),
            events: EventWriter::new(events),
            tensorboard: None,
            metrics,
            pulse,
            advisor: Advisor::default(),
            counted: (0, 0),
            spans: spans::totals(),
            said: false,
            doubted: false,
        };
        match EventFile::create(run_dir, unix_time_s()) {
            Ok(file) => reporter.tensorboard = Some(file),
            Err(error) => reporter.failed("the TensorBoard file", &error.to_string()),
        }
        reporter
    }

    /// Puts the settings of the run where TensorBoard shows them.
    pub fn settings(&mut self, config: &Config) {
        let Some(file) = &mut self.tensorboard else { return };
        let settings = serde_json::to_value(config).unwrap_or_default();
        let text = config.to_toml().unwrap_or_default();
        let written = file.settings(unix_time_s(), &settings, &text);
        if let Err(error) = written.and_then(|()| file.flush()) {
            self.failed("the TensorBoard file", &error.to_string());
        }
    }

    pub fn event(&mut self, event: &Event) {
        if let Err(error) = self.events.write(event) {
            self.failed("progress events", &error.to_string());
        }
    }

    pub fn warn(&mut self, message: String) {
        tracing::warn!("{message}");
        self.event(&Event::Warning(progress::Warning { message }));
    }

    /// Tells of an iteration and adds it to `history`.
    pub fn iteration(&mut self, report: &IterationReport, history: &mut History) {
        let mut event = event_of(report);
        let spans = spans::totals();
        event.spans_s = spans::between(&self.spans, &spans);
        self.spans = spans;
        self.update_metrics(report, &event);
        self.write_scalars(report, &event);
        history.push(point_of(report, &event));
        if !self.doubted && event.iteration >= DOUBT_FROM {
            self.doubted = event.mean_episode_length.is_some_and(|n| n < AT_ONCE);
            if self.doubted {
                let steps = event.mean_episode_length.unwrap_or_default();
                self.warn(format!(
                    "episodes end after {steps:.1} control steps: either the simulation of this robot breaks down, or \
                     a condition of [task.termination] holds from the start. `caudata robot check` swings every joint \
                     and says what is wrong"
                ));
            }
        }
        self.event(&Event::Iteration(Box::new(event)));
    }

    /// Draws the curves and writes `accounting.json`.
    pub fn pictures(&mut self, history: &History, accounting: &Accounting) {
        if let Err(error) = draw_curves(&self.run_dir.join("curves"), history) {
            self.failed("curves", &error.to_string());
        }
        let path = self.run_dir.join(ACCOUNT_FILE);
        let json = serde_json::to_vec_pretty(&accounting.report()).unwrap_or_default();
        if let Err(error) = caudata_durable::replace(&path, &json) {
            self.failed("accounting.json", &error.to_string());
        }
    }

    fn failed(&mut self, what: &str, error: &str) {
        self.metrics.report_failures.inc();
        if !self.said {
            tracing::warn!(what, error, "reports cannot be written; training goes on");
            self.said = true;
        }
    }

    fn update_metrics(&mut self, report: &IterationReport, event: &progress::Iteration) {
        let load = self.load_of(report, event);
        let advice = self.advisor.after(&load);
        self.counted = (event.accounting.received, event.accounting.dropped);
        let m = &self.metrics;
        m.scale_advice.set(advice.as_metric());
        m.staleness_max.set(report.lag_max as f64);
        m.iterations.inc();
        m.steps.inc_by(report.batch_steps as u64);
        m.skipped_updates.inc_by(report.stats.skipped);
        m.policy_version.set(i64::try_from(event.policy_version).unwrap_or(i64::MAX));
        m.staleness.set(report.lag_mean);
        m.effective_share.set(report.stats.effective_share);
        m.kl.set(event.kl);
        m.learning_rate.set(event.learning_rate);
        m.mean_step_reward.set(event.mean_step_reward);
        if let Some(mean_return) = event.mean_return {
            m.mean_return.set(mean_return);
        }
        m.collect.observe(report.collection_s);
        m.learn.observe(report.learning_s);
    }

    fn load_of(&self, report: &IterationReport, event: &progress::Iteration) -> IterationLoad {
        let (received, dropped) = self.counted;
        IterationLoad {
            waiting_s: report.collection_s,
            learning_s: report.learning_s,
            lag_max: report.lag_max,
            lag_allowed: report.lag_allowed,
            received: event.accounting.received.saturating_sub(received),
            dropped: event.accounting.dropped.saturating_sub(dropped),
        }
    }

    fn write_scalars(&mut self, report: &IterationReport, event: &progress::Iteration) {
        let Some(file) = &mut self.tensorboard else { return };
        let now = unix_time_s();
        let by_iteration = file.scalars(now, report.iteration, &scalars(report, event));
        let by_time: Vec<(String, f64)> = [
            ("Train/mean_reward/time", event.mean_return),
            ("Train/mean_episode_length/time", event.mean_episode_length),
        ]
        .into_iter()
        .filter_map(|(tag, value)| Some((tag.to_owned(), value?)))
        .collect();
        let written = by_iteration
            .and_then(|()| match by_time.is_empty() {
                true => Ok(()),
                false => file.scalars(now, report.wall_s as u64, &by_time),
            })
            .and_then(|()| file.flush());
        if let Err(error) = written {
            self.failed("the TensorBoard file", &error.to_string());
        }
    }
}

fn event_of(report: &IterationReport) -> progress::Iteration {
    let stats = report.stats;
    let terms = report.term_names.iter().enumerate();
    progress::Iteration {
        iteration: report.iteration,
        iterations: report.iterations,
        policy_version: report.policy_version,
        steps_total: report.steps_total,
        steps_per_s: report.batch_steps as f64 / report.total_s.max(1e-9),
        mean_return: report.episodes.mean_return(),
        mean_episode_length: report.episodes.mean_steps(),
        mean_step_reward: report.mean_step_reward,
        reward_terms: terms
            .filter_map(|(i, term)| Some((term.clone(), report.episodes.mean_term(i)?)))
            .collect(),
        lag_mean: report.lag_mean,
        lag_max: report.lag_max,
        effective_share: stats.effective_share,
        kl: stats.kl,
        surrogate_loss: stats.surrogate,
        value_loss: stats.value_loss,
        entropy: stats.entropy,
        learning_rate: stats.learning_rate,
        mean_std: stats.mean_std,
        clip_fraction: stats.clip_fraction,
        collection_s: report.collection_s,
        learning_s: report.learning_s,
        spans_s: BTreeMap::new(),
        eta_s: report.eta_s,
        accounting: report.accounting.summary(),
    }
}

/// rsl_rl's tags, and ours under `Caudata/`.
fn scalars(report: &IterationReport, event: &progress::Iteration) -> Vec<(String, f64)> {
    let stats = report.stats;
    let mut scalars: Vec<(String, f64)> = [
        ("Loss/value_function", stats.value_loss),
        ("Loss/surrogate", stats.surrogate),
        ("Loss/entropy", stats.entropy),
        ("Loss/learning_rate", stats.learning_rate),
        ("Policy/mean_std", stats.mean_std),
        ("Perf/total_fps", event.steps_per_s),
        ("Perf/collection_time", report.collection_s),
        ("Perf/learning_time", report.learning_s),
        ("Caudata/mean_step_reward", report.mean_step_reward),
        ("Caudata/environment_steps", report.steps_total as f64),
        ("Caudata/lag_mean", report.lag_mean),
        ("Caudata/lag_max", report.lag_max as f64),
        ("Caudata/effective_sample_share", stats.effective_share),
        ("Caudata/kl", stats.kl),
        ("Caudata/clip_fraction", stats.clip_fraction),
        ("Caudata/gradient_norm", stats.gradient_norm),
        ("Caudata/explained_variance", stats.explained_variance),
        ("Caudata/skipped_updates", stats.skipped as f64),
        ("Caudata/chunks_rejected", event.accounting.rejected as f64),
        ("Caudata/chunks_dropped", event.accounting.dropped as f64),
        ("Caudata/chunks_lost", report.accounting.lost() as f64),
    ]
    .into_iter()
    .map(|(tag, value)| (tag.to_owned(), value))
    .collect();
    if let (Some(mean_return), Some(length)) = (event.mean_return, event.mean_episode_length) {
        scalars.push(("Train/mean_reward".into(), mean_return));
        scalars.push(("Train/mean_episode_length".into(), length));
    }
    if stats.teacher_loss > 0.0 {
        scalars.push(("Loss/teacher".into(), stats.teacher_loss));
    }
    scalars.extend(event.reward_terms.iter().map(|(name, sum)| (format!("Episode/{name}"), *sum)));
    scalars
}

fn point_of(report: &IterationReport, event: &progress::Iteration) -> Point {
    let known = [
        ("mean_step_reward", Some(event.mean_step_reward)),
        ("kl", Some(event.kl)),
        ("mean_std", Some(event.mean_std)),
        ("steps_per_s", Some(event.steps_per_s)),
        ("value_loss", Some(event.value_loss)),
        ("learning_rate", Some(event.learning_rate)),
        ("mean_return", event.mean_return),
        ("mean_episode_length", event.mean_episode_length),
    ];
    let known = known.into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?)));
    let terms = event.reward_terms.iter();
    let terms = terms.map(|(name, sum)| (format!("{TERM_PREFIX}{name}"), *sum));
    Point { iterations: 1, steps: report.steps_total as f64, values: known.chain(terms).collect() }
}

fn unix_time_s() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64()
}
