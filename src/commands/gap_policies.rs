//! `caudata gap policies` and `caudata gap paper`: what an extended model is worth to a policy. The work is
//! in `crates/studies`.

use std::path::PathBuf;

use caudata_config::ConfigArgs;
use caudata_studies::paper;
use caudata_studies::policies::{self, Compared, Effort, Given, Robots};
use caudata_telemetry::{Failure, Process};
use clap::Args;

use super::gap_diagnose::steps;
use crate::commands::train;
use crate::say;

#[derive(Debug, Args)]
pub struct PoliciesArgs {
    #[command(flatten)]
    robots: Robots,
    /// Folder for runs, evaluations, policies.json and policies.html. What is finished in it is not done
    /// again: the same command goes on where it was stopped, and takes more seeds
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    effort: Effort,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// How policies are trained; without these flags the preset flat
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Debug, Args)]
pub struct PaperArgs {
    #[command(flatten)]
    plan: paper::Plan,
    /// Ends with the pictures: no policies are trained
    #[arg(long)]
    no_policies: bool,
    #[command(flatten)]
    effort: Effort,
    /// How policies are trained; without these flags the preset flat
    #[command(flatten)]
    config: ConfigArgs,
}

pub fn run(args: &PoliciesArgs, process: &Process) -> Result<(), Failure> {
    let given = given(&args.effort, &args.config)?;
    let steps = steps(args.json, process, "the same command goes on from here")?;
    let compared = policies::compare(&args.robots, &args.out, &args.effort, &given, steps)?;
    say::either(args.json, &compared, |compared| {
        print(compared);
        let file = args.out.join(policies::PAGE);
        say::line(format_args!("pictures   {}", file.display()));
    })
}

pub fn paper(args: &PaperArgs, process: &Process) -> Result<(), Failure> {
    // Hours before the trainings that need it.
    let given = given(&args.effort, &args.config)?;
    let after_stop = "what was made so far is in the output folder";
    let mut steps = steps(false, process, after_stop)?;
    let drawn = paper::draw(&args.plan, &mut steps)?;
    say::tables(drawn.tables());
    if !args.no_policies {
        print(&drawn.train(&args.effort, &given, steps)?);
    }
    say::line(format!("pictures   {}", drawn.page.display()));
    say::line(format!("report     {}", drawn.report.display()));
    Ok(())
}

fn given(effort: &Effort, config: &ConfigArgs) -> Result<Given, Failure> {
    let given = Given::read(effort, config)?;
    train::programs()?;
    Ok(given)
}

fn print(compared: &Compared) {
    say::tables(policies::tables(compared));
    say::line(policies::about(compared));
}
