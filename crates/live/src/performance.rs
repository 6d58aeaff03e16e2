//! The loop: steps the robot in real time while somebody looks.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use caudata_config::Config;
use caudata_evaluation::EvaluationError;
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use crossbeam_channel::Receiver;
use serde_json::json;

use crate::hub::Hub;
use crate::order::Order;
use crate::stage::Stage;

/// How long it waits for somebody to look before it asks whether to end.
const PATIENCE: Duration = Duration::from_millis(100);
/// How often it looks for a newer policy.
const NEWER_EVERY: Duration = Duration::from_millis(500);
/// How far it may be late; then the time is lost, not caught up.
const LATE_MAX: Duration = Duration::from_millis(200);
/// At what share of its fastest command it begins to walk.
const PACE: f32 = 0.6;
/// Pause after something went wrong, before it starts anew.
const TROUBLE_PAUSE: Duration = Duration::from_secs(1);

/// What is shown.
#[derive(Debug)]
pub struct Show {
    /// The task, the engine and the ground.
    pub config: Config,
    /// The robot.
    pub model: Arc<RobotModel>,
    /// What moves it.
    pub policy: Policy,
}

/// Where the policy comes from.
#[derive(Debug)]
pub enum Policy {
    /// There is none: the robot holds its nominal pose.
    None,
    /// This one.
    Fixed(Box<PolicyFile>),
    /// Whatever lies here; it is replaced whole, by newer ones.
    Newest(PathBuf),
}

impl Show {
    /// Whether it can be shown: the robot comes onto the stage once.
    ///
    /// # Errors
    /// When the policy does not fit the robot, or the simulation cannot be built.
    pub fn check(&self) -> Result<(), EvaluationError> {
        let policy = match &self.policy {
            Policy::Fixed(policy) => Some(policy.as_ref()),
            Policy::None | Policy::Newest(_) => None,
        };
        Stage::new(&self.config, &self.model, policy)?;
        Ok(())
    }

    pub(crate) fn title(&self) -> String {
        format!("caudata: {}", self.model.name())
    }
}

/// The file of the newest policy, and which one was read last.
#[derive(Default)]
struct Newest {
    /// The robot has set off once: from then on it does what it is told.
    set_off: bool,
    read: Option<SystemTime>,
    looked: Option<Instant>,
}

impl Newest {
    /// The policy at `path`, if it is another one than before.
    fn policy(&mut self, path: &PathBuf) -> Option<PolicyFile> {
        if self.looked.is_some_and(|looked| looked.elapsed() < NEWER_EVERY) {
            return None;
        }
        self.looked = Some(Instant::now());
        let written = std::fs::metadata(path).and_then(|data| data.modified()).ok()?;
        if self.read == Some(written) {
            return None;
        }
        self.read = Some(written);
        PolicyFile::parse(std::fs::read(path).ok()?.into()).ok()
    }
}

/// Steps, tells, obeys, until `ended`.
pub fn perform(show: &Show, hub: &Hub, orders: &Receiver<Order>, ended: &AtomicBool) {
    let mut stage: Option<Stage> = None;
    let mut newest = Newest::default();
    let mut due = Instant::now();
    while !ended.load(Ordering::Relaxed) {
        if !hub.is_watched(PATIENCE) {
            // What was asked for while nobody looked is of the past.
            orders.try_iter().for_each(drop);
            due = Instant::now();
            continue;
        }
        let done = match &mut stage {
            Some(stage) => act(show, hub, orders, stage, &mut newest),
            None => enter(show, hub, &mut newest).map(|entered| stage = Some(entered)),
        };
        if let Err(error) = done {
            hub.say("note", &format!("the robot starts anew: {error}"));
            stage = None;
            newest = Newest { set_off: newest.set_off, ..Newest::default() };
            std::thread::sleep(TROUBLE_PAUSE);
        }
        let period = Duration::from_secs_f64(show.config.task.control_period_s);
        due = (due + period).max(Instant::now().checked_sub(LATE_MAX).unwrap_or(due));
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
}

/// The robot comes onto the stage.
fn enter(show: &Show, hub: &Hub, newest: &mut Newest) -> Result<Stage, EvaluationError> {
    let found = match &show.policy {
        Policy::Newest(path) => newest.policy(path).map(Box::new),
        Policy::None | Policy::Fixed(_) => None,
    };
    let policy = match &show.policy {
        Policy::Fixed(policy) => Some(policy),
        _ => found.as_ref(),
    };
    let mut stage = Stage::new(&show.config, &show.model, policy.map(AsRef::as_ref))?;
    if policy.is_some() {
        set_off(show, &mut stage, newest)?;
    }
    hub.keep("robot", &stage.robot());
    tell_policy(hub, policy.map(AsRef::as_ref));
    hub.keep("ground", &stage.ground());
    hub.keep("told", &stage.told());
    Ok(stage)
}

/// One step, and what was asked for before it.
fn act(
    show: &Show,
    hub: &Hub,
    orders: &Receiver<Order>,
    stage: &mut Stage,
    newest: &mut Newest,
) -> Result<(), EvaluationError> {
    let mut told = false;
    if let Policy::Newest(path) = &show.policy
        && let Some(policy) = newest.policy(path)
    {
        stage.follow(&policy)?;
        tell_policy(hub, Some(&policy));
        told = set_off(show, stage, newest)?;
    }
    for order in orders.try_iter() {
        told = true;
        if stage.obey(&order)? {
            hub.keep("ground", &stage.ground());
        }
    }
    if told {
        hub.keep("told", &stage.told());
    }
    if let Some(reason) = stage.step()? {
        hub.say("note", &format!("it fell ({reason}) and starts again"));
        stage.obey(&Order::Restart)?;
        hub.keep("ground", &stage.ground());
    }
    hub.frame(&stage.row());
    Ok(())
}

/// Whoever opens the page sees it walk, before anything is pressed; true the first time, when it sets off.
fn set_off(show: &Show, stage: &mut Stage, newest: &mut Newest) -> Result<bool, EvaluationError> {
    let first = !std::mem::replace(&mut newest.set_off, true);
    if first {
        let vx_max_mps = show.config.task.command.vx_mps[1];
        stage.obey(&Order::Drive { velocity: [PACE * vx_max_mps, 0.0, 0.0] })?;
    }
    Ok(first)
}

fn tell_policy(hub: &Hub, policy: Option<&PolicyFile>) {
    let about = policy.map(|policy| {
        let metadata = policy.metadata();
        json!({
            "version": metadata.version,
            "run_id": metadata.run_id,
            "env_steps": metadata.env_steps,
            "sha256": policy.sha256_hex(),
        })
    });
    hub.keep("policy", &about);
}
