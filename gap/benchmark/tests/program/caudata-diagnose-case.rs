//! Diagnoses one case folder and writes `report.json` into the current folder:
//! `caudata-diagnose-case [--without ID]… [--budget S] CASE`. For the tests of the benchmark; `caudata bench gap` starts
//! itself.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use caudata_gap::Options;
use caudata_gap_benchmark::examinee;

/// `sysexits.h`: the input cannot be used.
const BAD_INPUT: u8 = 65;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            // the parent reads the last line; without a reader there is nobody to tell
            let _ = writeln!(std::io::stderr(), "{message}");
            ExitCode::from(BAD_INPUT)
        }
    }
}

fn run() -> Result<(), String> {
    let mut options = Options { threads: 1, ..Options::default() };
    let mut folder = None;
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--without" => options.without.push(args.next().ok_or("--without needs an effect id")?),
            "--budget" => {
                let seconds = args.next().and_then(|s| s.parse().ok());
                options.budget_s = Some(seconds.ok_or("--budget needs a number of seconds")?);
            }
            _ => folder = Some(PathBuf::from(arg)),
        }
    }
    let folder = folder.ok_or("give a case folder")?;
    examinee::write_report(&folder, options).map_err(|e| e.to_string())
}
