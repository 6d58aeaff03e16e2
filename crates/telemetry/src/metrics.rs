//! The metrics of one process, in the Prometheus text format. Cheap to clone; updating one is an atomic add.

use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};

use prometheus_client::registry::Registry;

/// A number that only grows.
pub type Counter = prometheus_client::metrics::counter::Counter;
/// Seconds spent on something; only grows.
pub type SecondsCounter =
    prometheus_client::metrics::counter::Counter<f64, std::sync::atomic::AtomicU64>;
/// A real number that goes up and down.
pub type Gauge = prometheus_client::metrics::gauge::Gauge<f64, std::sync::atomic::AtomicU64>;
/// A whole number that goes up and down.
pub type IntGauge = prometheus_client::metrics::gauge::Gauge;
/// A distribution over fixed buckets.
pub type Histogram = prometheus_client::metrics::histogram::Histogram;

/// Numbers that only grow, told apart by labels.
pub type LabelledCounter =
    prometheus_client::metrics::family::Family<Vec<(String, String)>, Counter>;

/// What a metric can be.
pub trait Kind: prometheus_client::registry::Metric + Clone {
    /// One to which nothing has happened.
    fn empty() -> Self;
}

/// Those that begin at 0.
macro_rules! from_nothing {
    ($($kind:ty),+) => {
        $(impl Kind for $kind {
            fn empty() -> Self {
                Self::default()
            }
        })+
    };
}

from_nothing!(Counter, SecondsCounter, Gauge, IntGauge, LabelledCounter);

/// Over durations in seconds, with buckets from 10 µs to 100 s, three to a decade.
impl Kind for Histogram {
    fn empty() -> Self {
        let buckets = (-5..=1)
            .flat_map(|decade| [1.0, 2.0, 5.0].map(|mantissa| mantissa * 10f64.powi(decade)));
        Self::new(buckets.chain([100.0]))
    }
}

/// The metrics of a part of a program: for each its handle, kind, full name and help text. Handles are cheap to
/// clone and share what they count.
#[macro_export]
macro_rules! metrics {
    ($(#[$about:meta])* $visible:vis struct $name:ident {
        $($field:ident: $kind:ty = $full_name:literal, $help:literal;)+
    }) => {
        $(#[$about])*
        #[derive(Clone, Debug)]
        $visible struct $name {
            $(#[doc = $help] pub $field: $kind,)+
        }

        impl $name {
            /// Puts all of them on the page.
            pub fn register(metrics: &$crate::Metrics) -> Self {
                Self {
                    $($field: metrics.make($full_name, $help),)+
                }
            }
        }
    };
}

/// The registry of one process. Names are full and in base units, as they appear on the page:
/// `caudata_actor_steps_total`, `caudata_inference_latency_seconds`.
#[derive(Clone, Debug, Default)]
pub struct Metrics {
    registry: Arc<RwLock<Registry>>,
    /// A page that another process writes, shown above this one's.
    beside: Option<Arc<Path>>,
}

/// What ends a page.
const END: &str = "# EOF\n";
/// Largest page of another process that is shown, bytes.
const BESIDE_MAX: u64 = 1 << 20;

impl Metrics {
    /// An empty registry.
    pub fn new() -> Self {
        Self::default()
    }

    /// Shows the page that another process keeps in `file` ([`Metrics::write_page`]) together with this one;
    /// nothing while there is none. For a process that must not open a socket itself.
    pub fn beside(self, file: PathBuf) -> Self {
        Self { beside: Some(file.into()), ..self }
    }

    /// Keeps the page in `file`, whole at any time.
    pub fn write_page(&self, file: &Path) -> std::io::Result<()> {
        let new = file.with_extension("new");
        std::fs::write(&new, self.encode())?;
        std::fs::rename(new, file)
    }

    /// A new metric on the page. A counter's `name` ends in `_total`.
    pub fn make<K: Kind>(&self, name: &str, help: &str) -> K {
        let metric = K::empty();
        // The encoder appends `_total` itself; we keep it in the name so that one string finds all uses.
        let name = name.strip_suffix("_total").unwrap_or(name);
        // It ends each help text with a full stop.
        let help = help.trim_end_matches('.');
        let mut registry = self.registry.write().unwrap_or_else(PoisonError::into_inner);
        registry.register(name, help, metric.clone());
        metric
    }

    /// The page as Prometheus reads it.
    pub fn encode(&self) -> String {
        let mut page = self.page_beside();
        let registry = self.registry.read().unwrap_or_else(PoisonError::into_inner);
        // Writing to a String cannot fail.
        let _ = prometheus_client::encoding::text::encode(&mut page, &registry);
        page
    }

    fn page_beside(&self) -> String {
        let file = self.beside.as_deref();
        let small = |file: &&Path| std::fs::metadata(file).is_ok_and(|m| m.len() <= BESIDE_MAX);
        let page = file.filter(small).and_then(|file| std::fs::read_to_string(file).ok());
        let page = page.unwrap_or_default();
        page.strip_suffix(END).unwrap_or_default().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_shows_each_metric_under_its_full_name() {
        let metrics = Metrics::new();
        let steps: Counter = metrics.make("caudata_test_steps_total", "Steps");
        steps.inc_by(3);
        let lag: Gauge = metrics.make("caudata_test_lag_seconds", "Lag");
        lag.set(0.5);
        let waiting: Histogram = metrics.make("caudata_test_wait_seconds", "Waiting");
        waiting.observe(0.003);
        let page = metrics.encode();
        assert!(page.contains("\ncaudata_test_steps_total 3\n"), "{page}");
        assert!(page.contains("\ncaudata_test_lag_seconds 0.5\n"), "{page}");
        // 3 ms lies above 2 ms and below 5 ms.
        assert!(page.contains("caudata_test_wait_seconds_bucket{le=\"0.002\"} 0"), "{page}");
        assert!(page.contains("caudata_test_wait_seconds_bucket{le=\"0.005\"} 1"), "{page}");
    }

    #[test]
    fn the_page_of_another_process_is_shown_above_and_a_torn_one_is_not() {
        let folder = std::env::temp_dir().join(format!("caudata-metrics-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("loop.prom");
        let (here, there) = (Metrics::new(), Metrics::new());
        here.make::<Counter>("caudata_test_here_total", "Here").inc();
        there.make::<Counter>("caudata_test_there_total", "There").inc();
        let here = here.beside(file.clone());
        assert!(!here.encode().contains("there"));
        there.write_page(&file).unwrap();
        let page = here.encode();
        assert!(page.contains("caudata_test_there_total 1\n"), "{page}");
        assert!(page.contains("caudata_test_here_total 1\n"), "{page}");
        assert_eq!((page.matches(END).count(), page.ends_with(END)), (1, true));
        std::fs::write(&file, "caudata_test_th").unwrap();
        assert!(!here.encode().contains("test_th\n"));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
