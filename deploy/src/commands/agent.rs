//! `caudata-robot agent`: fetches, verifies, tries and stages policies, and takes commands from the network.
//! It never opens the bus.

use std::time::Duration;

use caudata_telemetry::{Metrics, MetricsServer, Process, StopFlag};

use crate::DeployError;
use crate::boundary::{CommandSender, LOOP_PAGE, RunFolder, Told, alone};
use crate::command_link::{CommandLink, LinkKey, UdpLink};
use crate::commands::run::RunArgs;
use crate::commands::source::Source;
use crate::follower::Follower;
use crate::notify::{Notifier, Word};
use crate::stage::Stage;
use crate::state::PolicyRef;
use crate::updates::PolicyEvent;

/// How often it looks whether the loop told something.
const TOLD_LOOK: Duration = Duration::from_millis(50);
/// How often commands are passed on.
const COMMANDS_EVERY: Duration = Duration::from_millis(20);

/// Until asked to stop.
pub fn run(args: &RunArgs, process: &Process) -> Result<(), DeployError> {
    let notifier = Notifier::from_environment()?;
    let folder = RunFolder::open(&args.run_folder())?;
    let _alone = alone(&folder.file("agent.lock"))?;
    let metrics = Metrics::new().beside(folder.file(LOOP_PAGE));
    let factory = args.factory.as_deref();
    let (source, agent_metrics) = Source::open(&args.source, factory, &metrics)?;
    let _endpoint =
        args.metrics_addr.map(|addr| metrics_endpoint(addr, metrics, process)).transpose()?;
    let stage = Stage::open(source.keeper.clone(), folder.clone());
    // What became of policies while nobody listened counts before the next one is chosen; who asks is
    // answered after that.
    let mut told = Told::of(&args.source.state, &folder);
    let mut asks = None;
    told.take(|event| match event {
        PolicyEvent::Ready { .. } => asks = Some(event),
        event => stage.hear(event),
    });
    let policy = match stage.running() {
        Some(policy) => policy,
        None => choose(&source)?,
    };
    stage.choose(policy.clone());
    if let Some(event) = asks {
        stage.hear(event);
    }
    let follower = match args.follow {
        true => Some(Follower::start(
            source.keeper.clone(),
            source.follow.clone(),
            policy,
            stage.clone(),
            agent_metrics,
        )?),
        false => None,
    };
    if let (Some(addr), Some(key)) = (args.link_addr, &args.link_key) {
        let link = UdpLink::listen(addr, LinkKey::read(key)?, args.dead_man)?;
        pass_on(link, CommandSender::new(&folder)?, process.stop.clone())?;
    }
    notifier.say(Word::Ready);
    while !process.stop.wait(TOLD_LOOK) {
        told.take(|event| stage.hear(event));
        notifier.say(Word::Alive);
    }
    drop(follower);
    told.take(|event| stage.hear(event));
    Ok(())
}

/// The server's newest policy, or else the best that is here.
fn choose(source: &Source) -> Result<PolicyRef, DeployError> {
    let error = match source.pull() {
        Ok(verified) => return Ok(verified.policy),
        Err(
            error @ (DeployError::Server(_)
            | DeployError::NoPolicy { .. }
            | DeployError::Stale { .. }
            | DeployError::StateLost
            // A card that takes nothing more still holds what ran before.
            | DeployError::Durable(_)
            | DeployError::Refused { .. }),
        ) => error,
        Err(error) => return Err(error),
    };
    match source.keeper.best()? {
        Some(policy) => {
            tracing::warn!(%error, running = %policy, "running what is on disk");
            Ok(policy)
        }
        None if source.keeper.is_torn() => {
            tracing::error!(%error, "no proof");
            Err(DeployError::StateLost)
        }
        None => Err(error),
    }
}

/// Commands from the network to the loop, from a thread of its own. A kill is also told to the supervisor,
/// which does not depend on the loop's heeding it.
fn pass_on(mut link: UdpLink, sender: CommandSender, stop: StopFlag) -> Result<(), DeployError> {
    let notifier = Notifier::from_environment()?;
    let work = move || {
        while !stop.wait(COMMANDS_EVERY) {
            let view = link.view();
            sender.send(&view);
            if view.killed {
                notifier.say(Word::Kill);
            }
        }
    };
    let thread = std::thread::Builder::new().name("commands".into());
    thread.spawn(work).map(drop).map_err(DeployError::system("a thread"))
}

fn metrics_endpoint(
    addr: std::net::SocketAddr,
    registry: Metrics,
    process: &Process,
) -> Result<MetricsServer, DeployError> {
    MetricsServer::start(addr, registry, process.stop.clone()).map_err(|error| {
        let said = std::io::Error::other(error.to_string());
        DeployError::system("the metrics address")(said)
    })
}
