//! Time itself: rate, gaps, bunched rows.

use super::{Finding, Run, Severity};
use crate::check::series::median_step_s;

/// The median rate may be off the one that `log.toml` claims by this share; a loop never keeps its rate exactly.
const RATE_TOLERANCE: f64 = 0.2;
/// A step longer than so many median steps, and than [`GAP_S`], is a gap.
const GAP_STEPS: f64 = 10.0;
/// See [`GAP_STEPS`], s.
const GAP_S: f64 = 0.2;
/// Steps shorter than this share of the median are bunched rows: stamps taken from a buffer, not when the sample was.
const BUNCHED: f64 = 0.2;
/// So large a share of bunched rows is said.
const BUNCHED_SHARE: f64 = 0.02;

pub(super) fn faults(run: &Run<'_>, out: &mut Vec<Finding>) {
    let time_s = run.log.table.time_s();
    let median = median_step_s(time_s);
    if median <= 0.0 {
        return;
    }
    let claimed = run.log.meta.rate_hz;
    let ratio = 1.0 / (median * claimed);
    if (ratio - 1.0).abs() > RATE_TOLERANCE {
        let hint = match ratio {
            r if (0.000_9..0.001_1).contains(&r) => "; is `t` in milliseconds?",
            r if (9e-7..1.1e-6).contains(&r) => "; is `t` in microseconds?",
            _ => "; correct `t` or `rate_hz`",
        };
        out.push(Finding {
            kind: if hint.contains("seconds?") {
                "unit"
            } else {
                "stamps"
            },
            at: "t".to_owned(),
            detail: format!(
                "rows come at {:.4} Hz where log.toml says {claimed:.4} Hz{hint}",
                1.0 / median
            ),
            severity: Severity::Fatal,
        });
    }
    let steps = || time_s.windows(2).map(|w| (w[0], w[1] - w[0]));
    let is_gap = |step: f64| step > GAP_STEPS * median && step > GAP_S;
    let gaps: Vec<(f64, f64)> = steps().filter(|&(_, step)| is_gap(step)).collect();
    if let Some(&(at, step)) = gaps.iter().max_by(|a, b| a.1.total_cmp(&b.1)) {
        let lost: f64 = gaps.iter().map(|g| g.1).sum();
        let share = lost / (time_s[time_s.len() - 1] - time_s[0]);
        out.push(Finding {
            kind: "gap",
            at: "t".to_owned(),
            detail: format!(
                "{} gap(s), the longest of {step:.2} s after t = {at:.2} s ({:.0} % of the run is missing)",
                gaps.len(),
                100.0 * share
            ),
            severity: if share > 0.5 { Severity::Fatal } else { Severity::Note },
        });
    }
    let bunched = steps().filter(|&(_, step)| step < BUNCHED * median).count();
    if bunched as f64 > BUNCHED_SHARE * time_s.len() as f64 {
        out.push(Finding {
            kind: "stamps",
            at: "t".to_owned(),
            detail: format!(
                "{bunched} of {} rows come less than {:.2} ms after the one before (median {:.2} ms): stamp rows when they are sampled, not when they are written",
                time_s.len(),
                1e3 * BUNCHED * median,
                1e3 * median
            ),
            severity: Severity::Fatal,
        });
    }
}
