//! Which column of a table is its clock.

use super::map::unit;
use super::run::ImportError;
use super::sheet::{Clock, Recording};
use super::units::unit_word;
use super::words::{CLOCKS, Words};
use crate::check::series::unit_of_steps;

/// Fewest rows from which a column that rises is a clock.
const FEWEST_STAMPS: usize = 20;

/// The clock of a recording whose form tells of none.
pub(super) fn clock(recording: &Recording) -> Result<Clock, ImportError> {
    let header: Vec<&str> = recording.sheets.iter().flat_map(|s| s.header()).collect();
    for sheet in &recording.sheets {
        for column in sheet.header() {
            let words = Words::of(column);
            // a column that is called `ms`
            let alone = unit_word(&column.trim().to_lowercase());
            let alone = alone.filter(|name| unit(name).is_ok_and(|(_, of)| of == "time"));
            if words.has(CLOCKS) || alone.is_some() {
                let stamps: Vec<f64> = sheet.values(column, None)?.into_iter().flatten().collect();
                return Ok(Clock {
                    column: column.to_owned(),
                    unit: words.unit.or(alone).unwrap_or_else(|| clock_unit(&stamps)),
                    remark: String::new(),
                });
            }
        }
    }
    if let Some((column, unit)) = rising(recording)? {
        let remark = "the only column that rises from row to row".to_owned();
        return Ok(Clock { column, unit, remark });
    }
    Err(ImportError::Format {
        file: recording.file.clone(),
        message: match header.iter().all(|name| name.parse::<f64>().is_ok()) {
            true => {
                "its first line is numbers: put one with the columns' names above it".to_owned()
            }
            false => format!("no column is called time; it has {}", header.join(", ")),
        },
    })
}

/// The one column whose values rise from row to row and that does not just count them, with its unit; of several the
/// one with a unit of time.
fn rising(recording: &Recording) -> Result<Option<(String, &'static str)>, ImportError> {
    let mut found = Vec::new();
    for sheet in &recording.sheets {
        for column in sheet.header() {
            // a column of words, or with holes, is no clock
            let Ok(values) = sheet.values(column, None) else { continue };
            let Some(stamps) = values.into_iter().collect::<Option<Vec<_>>>() else { continue };
            let steps = || stamps.windows(2).map(|w| w[1] - w[0]);
            if stamps.len() < FEWEST_STAMPS || steps().any(|step| step <= 0.0) {
                continue;
            }
            let named = Words::of(column).unit;
            let of_time = |name: &&str| unit(name).is_ok_and(|(_, of)| of == "time");
            if named.is_some_and(|name| !of_time(&name)) {
                continue;
            }
            if named.is_some() || steps().any(|step| step != 1.0) {
                found.push((column.to_owned(), named, clock_unit(&stamps)));
            }
        }
    }
    if found.iter().any(|(_, named, _)| named.is_some()) {
        found.retain(|(_, named, _)| named.is_some());
    }
    let only = (found.len() == 1).then(|| found.swap_remove(0));
    Ok(only.map(|(column, named, guessed)| (column, named.unwrap_or(guessed))))
}

/// What the stamps of rows are in.
fn clock_unit(stamps: &[f64]) -> &'static str {
    let span = stamps.last().unwrap_or(&0.0) - stamps.first().unwrap_or(&0.0);
    unit_of_steps(span / (stamps.len().max(2) - 1) as f64)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::super::{Format, open};
    use super::*;

    fn of(header: &str, row: impl Fn(usize) -> String) -> Result<Clock, ImportError> {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("rig.csv");
        let rows: String = (0..40).map(|k| row(k) + "\n").collect();
        std::fs::write(&file, format!("{header}\n{rows}")).unwrap();
        clock(&open(&file, Format::Csv, None).unwrap()[0])
    }

    #[test]
    fn the_only_column_that_rises_is_the_clock() {
        // an index counts rows, an angle may rise, and a mode is a word
        let row = |k: usize| format!("{k},{},{k}.5,hold", 20 * k);
        let clock = of(",Tick(ms),w_ist [deg],mode", row).unwrap();
        assert_eq!((clock.column.as_str(), clock.unit), ("Tick(ms)", "ms"));
        assert!(clock.remark.contains("only column that rises"));
        // without a unit by its steps: 0.02 apart can be no milliseconds
        let row = |k: usize| format!("{k},{},{}", 0.02 * k as f64, (0.3 * k as f64).sin());
        assert_eq!(of("n,x,w_ist [deg]", row).unwrap().unit, "s");
    }

    #[test]
    fn of_two_columns_that_rise_none_is_guessed() {
        let row = |k: usize| format!("{},{}", 0.02 * k as f64, 0.5 * k as f64);
        let Err(error) = of("x,turned", row) else { panic!("guessed") };
        assert!(error.to_string().contains("no column is called time"), "{error}");
    }
}
