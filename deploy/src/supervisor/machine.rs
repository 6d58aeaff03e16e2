//! What the supervisor does when, as a function: a state, an event, the next state and what to do. It knows
//! no clock, no process and no signal; [`super`] tells it what happened.
//!
//! ```text
//!            agent ready            the loop died, at most three times in a row
//! Waiting ───────────────▶ Up ◀────────────────────────────────────▶ Down
//!    │                      │ asked to stop, asked twice, kill button   │ asked to stop,
//!    │ asked to stop,       ▼                                           │ kill button
//!    │ agent ended        Ending ──────────────────────▶ Over ◀─────────┘
//!    └────────────────────────────────────────────────────▲
//! ```
//!
//! *Invariant:* wherever a loop that may have had torque is gone and did not end in order, or does not end at
//! all, the servos are let go; after the kill button or a stop no loop is started, and the end does not wait
//! for what may never come.

use std::time::Duration;

use caudata_telemetry::ExitCode;

/// How often a loop that died is started again.
pub const RESTARTS_MAX: u32 = 3;

/// Where a run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// The agent finds the first policy; there is no loop yet.
    Waiting,
    /// The loop runs.
    Up {
        /// How often it died in a row before.
        deaths: u32,
    },
    /// The loop died, and is started again in a moment.
    Down {
        /// How often it died in a row.
        deaths: u32,
    },
    /// The loop runs, and its end is waited for: nothing is started again.
    Ending(Why),
    /// Everything has been said and done.
    Over(Verdict),
}

/// Why an end is waited for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Why {
    /// A signal: it stands down in order.
    Stop,
    /// A second one: it lets go at once.
    Insist,
    /// The kill button: it brakes.
    Kill,
    /// It did not brake after the kill button, and was ended.
    Deaf,
}

/// How a process ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// With exit code 0.
    InOrder,
    /// With an exit code that starting again does not change: a person or another file must set it right.
    Wrong(ExitCode),
    /// Otherwise: killed, crashed, or with a code for what may go better next time.
    Died(Option<ExitCode>),
}

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The agent has a policy.
    AgentReady,
    /// The agent ended before it ever was ready.
    AgentFailed(End),
    /// The loop ended.
    LoopEnded {
        /// How.
        end: End,
        /// Whether a loop of this run ever came so far that there may be torque.
        touched: bool,
        /// Whether it ran for so long that earlier deaths do not count any more.
        calm: bool,
        /// Whether it had said that it came to its end and let go: what went wrong after that (a full disk
        /// for its log, a signal) is no reason to walk again.
        stopping: bool,
    },
    /// The loop was ended by force, and is still there: a driver holds it.
    Undying {
        /// As of [`Event::LoopEnded`].
        touched: bool,
    },
    /// The loop gives no sign of life.
    LoopSilent,
    /// The pause before the loop is started again is over.
    PauseOver,
    /// The loop takes too long to do as it was asked.
    TooLong,
    /// A signal.
    Stop,
    /// A second one.
    Insist,
    /// The kill button.
    Kill,
    /// The kill button was pressed, and the loop does not brake.
    Deaf,
}

/// What to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Do {
    /// Start the loop.
    StartLoop,
    /// Ask the loop to stop; asked again, it lets go at once.
    AskLoop,
    /// End the loop.
    KillLoop,
    /// Let the servos go, unless another program has their port.
    LetGo,
    /// Let the servos go whoever has their port: it is our own loop, which neither moves nor ends.
    LetGoAnyway,
}

/// What a run came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// In order.
    Done,
    /// As the agent ended.
    Agent(End),
    /// As the loop ended.
    Loop(End),
    /// The loop does not end, not even by force.
    Undying,
    /// The loop died too often.
    GivenUp {
        /// How often in a row.
        deaths: u32,
    },
    /// A second signal.
    Interrupted,
    /// The kill button was pressed before there was a loop.
    KilledBefore,
    /// The kill button was pressed while the loop was down.
    KilledWhileDown,
    /// The kill button was pressed and the loop hung.
    KilledWhileHung,
}

/// The next state, and what to do on the way there, in this order.
pub fn next(state: State, event: Event) -> (State, &'static [Do]) {
    match state {
        State::Waiting => waiting(event),
        State::Up { deaths } => up(deaths, event),
        State::Down { deaths } => down(deaths, event),
        State::Ending(why) => ending(why, event),
        State::Over(_) => (state, &[]),
    }
}

fn waiting(event: Event) -> (State, &'static [Do]) {
    match event {
        Event::AgentReady => (State::Up { deaths: 0 }, &[Do::StartLoop]),
        Event::AgentFailed(end) => (State::Over(Verdict::Agent(end)), &[]),
        Event::Stop => (State::Over(Verdict::Done), &[]),
        Event::Insist => (State::Over(Verdict::Interrupted), &[]),
        Event::Kill => (State::Over(Verdict::KilledBefore), &[]),
        _ => (State::Waiting, &[]),
    }
}

fn up(deaths: u32, event: Event) -> (State, &'static [Do]) {
    match event {
        Event::Stop => (State::Ending(Why::Stop), &[Do::AskLoop]),
        Event::Insist => (State::Ending(Why::Insist), &[Do::AskLoop]),
        Event::Kill => (State::Ending(Why::Kill), &[]),
        Event::Deaf => (State::Ending(Why::Deaf), &[Do::KillLoop]),
        // Its end follows, and is dealt with then.
        Event::LoopSilent => (State::Up { deaths }, &[Do::KillLoop]),
        Event::Undying { touched } => undying(touched),
        Event::LoopEnded { end: End::Died(_), touched, calm, stopping: false } => {
            let deaths = if calm { 1 } else { deaths + 1 };
            let next = match deaths > RESTARTS_MAX {
                true => State::Over(Verdict::GivenUp { deaths }),
                false => State::Down { deaths },
            };
            (next, letting_go(touched))
        }
        Event::LoopEnded { end, touched, .. } => over(Verdict::Loop(end), end, touched),
        _ => (State::Up { deaths }, &[]),
    }
}

fn down(deaths: u32, event: Event) -> (State, &'static [Do]) {
    match event {
        Event::PauseOver => (State::Up { deaths }, &[Do::StartLoop]),
        Event::Stop => (State::Over(Verdict::Done), &[]),
        // It was let go of already; whoever presses this wants to be sure.
        Event::Insist => (State::Over(Verdict::Interrupted), &[Do::LetGo]),
        Event::Kill => (State::Over(Verdict::KilledWhileDown), &[Do::LetGo]),
        _ => (State::Down { deaths }, &[]),
    }
}

fn ending(why: Why, event: Event) -> (State, &'static [Do]) {
    match event {
        Event::Insist if why != Why::Deaf => (State::Ending(Why::Insist), &[Do::AskLoop]),
        Event::Kill if why == Why::Stop => (State::Ending(Why::Kill), &[]),
        Event::Deaf => (State::Ending(Why::Deaf), &[Do::KillLoop]),
        Event::LoopSilent if why == Why::Kill => (State::Ending(Why::Deaf), &[Do::KillLoop]),
        Event::LoopSilent | Event::TooLong => (State::Ending(why), &[Do::KillLoop]),
        Event::Undying { touched } => undying(touched),
        Event::LoopEnded { end, touched, .. } => match why {
            // Told twice, and whatever it says: once more.
            Why::Insist => (State::Over(Verdict::Interrupted), letting_go(touched)),
            Why::Deaf => (State::Over(Verdict::KilledWhileHung), letting_go(touched)),
            Why::Stop | Why::Kill => over(Verdict::Loop(end), end, touched),
        },
        _ => (State::Ending(why), &[]),
    }
}

/// A loop that ended in order has let go itself, and asked whether the servos did.
fn over(verdict: Verdict, end: End, touched: bool) -> (State, &'static [Do]) {
    match end {
        End::InOrder => (State::Over(verdict), &[]),
        _ => (State::Over(verdict), letting_go(touched)),
    }
}

/// Nothing is started beside it: it has the port, and nobody knows what it does next.
fn undying(touched: bool) -> (State, &'static [Do]) {
    let todo: &[Do] = if touched { &[Do::LetGoAnyway] } else { &[] };
    (State::Over(Verdict::Undying), todo)
}

/// What is known of a loop that runs; each a time that has passed since.
#[derive(Clone, Copy, Debug, Default)]
pub struct Signs {
    /// The last sign of life.
    pub heard: Duration,
    /// Its first tick, if it came so far.
    pub ready: Option<Duration>,
    /// It said that it came to its end.
    pub stopping: bool,
    /// It said that it brakes, or has let go.
    pub brakes: bool,
    /// The kill button.
    pub pressed: Option<Duration>,
    /// It was asked to end, last.
    pub asked: Option<Duration>,
    /// It was ended by force.
    pub killed: Option<Duration>,
}

/// How long what may take.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Until the first tick.
    pub start: Duration,
    /// Silence after that.
    pub silent: Duration,
    /// From the kill button to braking.
    pub brake: Duration,
    /// Tidying up.
    pub stopping: Duration,
    /// Standing down when asked, or after the kill button.
    pub stand_down: Duration,
    /// The same when asked twice.
    pub insisted: Duration,
    /// Until a process that was ended by force is gone.
    pub undying: Duration,
}

/// What the signs of a loop that runs come to, if anything. `touched` as of [`Event::LoopEnded`].
pub fn judge(signs: &Signs, limits: &Limits, state: State, touched: bool) -> Option<Event> {
    let over = |age: Option<Duration>, limit| age.is_some_and(|age| age > limit);
    if signs.killed.is_some() {
        // Nothing else can be asked of it any more.
        return over(signs.killed, limits.undying).then_some(Event::Undying { touched });
    }
    // A loop that was not there yet when the button was pressed needs as long from its first tick on.
    let could_brake = match (signs.pressed, signs.ready) {
        (Some(pressed), Some(ready)) => Some(pressed.min(ready)),
        _ => None,
    };
    if !signs.brakes && over(could_brake, limits.brake) {
        return Some(Event::Deaf);
    }
    let silence = match (signs.ready, signs.stopping) {
        (_, true) => limits.stopping,
        (Some(_), false) => limits.silent,
        (None, false) => limits.start,
    };
    if signs.heard > silence {
        return Some(Event::LoopSilent);
    }
    let patience = match state {
        State::Ending(Why::Insist) => limits.insisted,
        _ => limits.stand_down,
    };
    over(signs.asked, patience).then_some(Event::TooLong)
}

/// A robot that this run never touched may be somebody else's.
fn letting_go(touched: bool) -> &'static [Do] {
    if touched { &[Do::LetGo] } else { &[] }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CRASH: End = End::Died(None);
    const FAULT: End = End::Wrong(ExitCode::Unavailable);

    fn ended(end: End, touched: bool) -> Event {
        Event::LoopEnded { end, touched, calm: false, stopping: false }
    }

    const UP: State = State::Up { deaths: 0 };
    const fn down(deaths: u32) -> State {
        State::Down { deaths }
    }
    const fn over(verdict: Verdict) -> State {
        State::Over(verdict)
    }

    #[test]
    fn what_follows_what() {
        use Event::*;
        use State::*;
        use Verdict::*;
        let calm = LoopEnded { end: CRASH, touched: true, calm: true, stopping: false };
        let tidying = |end| LoopEnded { end, touched: true, calm: false, stopping: true };
        let [undying, untouched] = [true, false].map(|touched| Event::Undying { touched });
        let table: &[(State, Event, State, &[Do])] = &[
            // Before the first loop.
            (Waiting, AgentReady, UP, &[Do::StartLoop]),
            (Waiting, AgentFailed(FAULT), over(Agent(FAULT)), &[]),
            (Waiting, Stop, over(Done), &[]),
            (Waiting, Insist, over(Interrupted), &[]),
            (Waiting, Kill, over(KilledBefore), &[]),
            // The loop ends by itself.
            (UP, ended(End::InOrder, true), over(Loop(End::InOrder)), &[]),
            (UP, ended(FAULT, true), over(Loop(FAULT)), &[Do::LetGo]),
            // The port is another program's: its robot must not be let go.
            (UP, ended(FAULT, false), over(Loop(FAULT)), &[]),
            // The loop dies.
            (UP, ended(CRASH, true), down(1), &[Do::LetGo]),
            (UP, ended(CRASH, false), down(1), &[]),
            (Up { deaths: 2 }, ended(CRASH, true), down(3), &[Do::LetGo]),
            (Up { deaths: 3 }, ended(CRASH, true), over(GivenUp { deaths: 4 }), &[Do::LetGo]),
            (Up { deaths: 3 }, calm, down(1), &[Do::LetGo]),
            (down(2), PauseOver, Up { deaths: 2 }, &[Do::StartLoop]),
            (UP, LoopSilent, UP, &[Do::KillLoop]),
            // It had come to its end: it does not rise again, however it died then.
            (UP, tidying(CRASH), over(Loop(CRASH)), &[Do::LetGo]),
            (UP, tidying(End::InOrder), over(Loop(End::InOrder)), &[]),
            // It does not even end by force.
            (UP, undying, over(Verdict::Undying), &[Do::LetGoAnyway]),
            (UP, untouched, over(Verdict::Undying), &[]),
            (Ending(Why::Deaf), undying, over(Verdict::Undying), &[Do::LetGoAnyway]),
            (Ending(Why::Insist), undying, over(Verdict::Undying), &[Do::LetGoAnyway]),
            (Ending(Why::Stop), untouched, over(Verdict::Undying), &[]),
            (down(1), undying, down(1), &[]),
            // Stop.
            (UP, Stop, Ending(Why::Stop), &[Do::AskLoop]),
            (down(1), Stop, over(Done), &[]),
            (Ending(Why::Stop), ended(End::InOrder, true), over(Loop(End::InOrder)), &[]),
            (Ending(Why::Stop), ended(CRASH, true), over(Loop(CRASH)), &[Do::LetGo]),
            (Ending(Why::Stop), LoopSilent, Ending(Why::Stop), &[Do::KillLoop]),
            (Ending(Why::Stop), TooLong, Ending(Why::Stop), &[Do::KillLoop]),
            (Ending(Why::Stop), PauseOver, Ending(Why::Stop), &[]),
            // Twice.
            (Ending(Why::Stop), Insist, Ending(Why::Insist), &[Do::AskLoop]),
            (Ending(Why::Kill), Insist, Ending(Why::Insist), &[Do::AskLoop]),
            (Ending(Why::Insist), TooLong, Ending(Why::Insist), &[Do::KillLoop]),
            (Ending(Why::Insist), ended(End::InOrder, true), over(Interrupted), &[Do::LetGo]),
            (Ending(Why::Insist), ended(CRASH, true), over(Interrupted), &[Do::LetGo]),
            (Ending(Why::Insist), ended(CRASH, false), over(Interrupted), &[]),
            (down(1), Insist, over(Interrupted), &[Do::LetGo]),
            // The kill button.
            (UP, Kill, Ending(Why::Kill), &[]),
            (Ending(Why::Stop), Kill, Ending(Why::Kill), &[]),
            (Ending(Why::Insist), Kill, Ending(Why::Insist), &[]),
            (down(1), Kill, over(KilledWhileDown), &[Do::LetGo]),
            (Ending(Why::Kill), ended(End::InOrder, true), over(Loop(End::InOrder)), &[]),
            (Ending(Why::Kill), ended(CRASH, true), over(Loop(CRASH)), &[Do::LetGo]),
            (Ending(Why::Kill), Deaf, Ending(Why::Deaf), &[Do::KillLoop]),
            (Ending(Why::Kill), LoopSilent, Ending(Why::Deaf), &[Do::KillLoop]),
            (Ending(Why::Deaf), ended(CRASH, true), over(KilledWhileHung), &[Do::LetGo]),
            (Ending(Why::Deaf), Insist, Ending(Why::Deaf), &[]),
            // Afterwards nothing happens any more.
            (over(Done), AgentReady, over(Done), &[]),
            (over(Interrupted), ended(CRASH, true), over(Interrupted), &[]),
        ];
        for (state, event, then, todo) in table {
            assert_eq!(next(*state, *event), (*then, *todo), "{state:?}, {event:?}");
        }
    }

    /// A world in which a process behaves as processes do: what it may say and when it may end depends on
    /// what became of it.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct World {
        state: State,
        /// A loop is there.
        runs: bool,
        /// It has ticked.
        ready: bool,
        /// It said that it came to its end.
        stopping: bool,
        /// It was ended by force.
        killed: bool,
        /// A loop of this run has ticked.
        touched: bool,
        /// A loop that may have had torque is gone without order, or stays without end, and the servos were
        /// not let go since.
        held: bool,
        /// Somebody asked for the end.
        asked: bool,
        /// The kill button was pressed.
        pressed: bool,
    }

    /// Everything that may happen in `world` that the machine hears of.
    fn events(world: &World) -> Vec<Event> {
        use Event::*;
        let mut all = vec![AgentReady, AgentFailed(FAULT), PauseOver, Stop, Insist, Kill];
        // The supervisor looks whether a pause is over only where no loop runs.
        all.retain(|event| *event != PauseOver || !world.runs);
        if !world.runs {
            return all;
        }
        let (touched, stopping) = (world.touched, world.stopping);
        let mut ends = vec![CRASH, FAULT];
        // One that has ticked ends in order after it said so only.
        if stopping || !world.ready {
            ends.push(End::InOrder);
        }
        for end in ends {
            for calm in [false, true] {
                all.push(LoopEnded { end, touched, calm: calm && world.ready, stopping });
            }
        }
        match world.killed {
            true => all.push(Undying { touched }),
            false => {
                all.push(LoopSilent);
                all.extend((world.pressed && world.ready).then_some(Deaf));
                all.extend(world.asked.then_some(TooLong));
            }
        }
        all
    }

    /// `world` after `event`; panics where something is done that must never be.
    fn after(world: &World, event: Event) -> World {
        let mut after = *world;
        after.asked |= matches!(event, Event::Stop | Event::Insist | Event::Kill);
        after.pressed |= event == Event::Kill;
        match event {
            Event::LoopEnded { end, .. } => {
                (after.runs, after.killed) = (false, false);
                after.held |= world.ready && end != End::InOrder;
            }
            Event::Undying { .. } => after.held |= world.ready,
            _ => {}
        }
        let (state, todo) = next(world.state, event);
        after.state = state;
        let by_hand = matches!(event, Event::Insist | Event::Kill);
        for todo in todo {
            match todo {
                Do::StartLoop => {
                    assert!(!after.asked, "{world:?}, {event:?}: it rises again");
                    assert!(!world.stopping, "{world:?}, {event:?}: after its end");
                    assert!(!after.held && !after.runs, "{world:?}, {event:?}");
                    (after.runs, after.ready) = (true, false);
                }
                Do::LetGo => {
                    assert!(world.touched || by_hand, "{world:?}, {event:?}: whose?");
                    assert!(!after.runs, "{world:?}, {event:?}: beside a loop");
                    after.held = false;
                }
                Do::LetGoAnyway => {
                    let undying = matches!(event, Event::Undying { .. });
                    assert!(world.touched && undying, "{world:?}, {event:?}: whose?");
                    after.held = false;
                }
                Do::AskLoop => assert!(after.runs, "{world:?}, {event:?}"),
                Do::KillLoop => {
                    assert!(after.runs, "{world:?}, {event:?}");
                    after.killed = true;
                }
            }
        }
        assert!(!after.held, "{world:?}, {event:?}: torque is left");
        let undying = state == State::Over(Verdict::Undying);
        let left = matches!(state, State::Over(_)) && after.runs && !undying;
        assert!(!left, "{world:?}, {event:?}: a loop is left");
        after
    }

    /// Every world that can be reached, none twice: what must never happen does not, and no end waits for
    /// what may never come.
    #[test]
    fn whatever_happens_servos_are_let_go_and_nothing_starts_after_a_kill_or_a_stop() {
        let begin = World {
            state: State::Waiting,
            runs: false,
            ready: false,
            stopping: false,
            killed: false,
            touched: false,
            held: false,
            asked: false,
            pressed: false,
        };
        let mut known = vec![begin];
        let mut looked_at = 0;
        let mut steps = 0;
        while let Some(world) = known.get(looked_at).copied() {
            looked_at += 1;
            if matches!(world.state, State::Over(_)) {
                continue;
            }
            let mut reached: Vec<World> = Vec::new();
            for event in events(&world) {
                let after = after(&world, event);
                let gone = matches!(event, Event::LoopEnded { .. } | Event::Undying { .. });
                if world.asked && gone {
                    let over = matches!(after.state, State::Over(_));
                    assert!(over, "{world:?}, {event:?}: what is waited for?");
                }
                if world.asked && matches!(event, Event::LoopSilent | Event::TooLong) {
                    assert!(after.killed, "{world:?}, {event:?}: it is not ended");
                }
                reached.push(after);
            }
            // What the machine does not hear of: the first tick, also after a kill, and the end of the work.
            if world.runs && !world.ready && !world.killed {
                reached.push(World { ready: true, touched: true, ..world });
            }
            if world.runs && world.ready && !world.stopping && !world.killed {
                reached.push(World { stopping: true, ..world });
            }
            steps += reached.len();
            for world in reached {
                if !known.contains(&world) {
                    known.push(world);
                }
            }
        }
        // There are no more: a machine that does less would show as fewer.
        assert!(looked_at >= 140 && steps >= 855, "{looked_at} {steps}");
        eprintln!("{looked_at} worlds, {steps} steps between them");
    }

    const LIMITS: Limits = Limits {
        start: Duration::from_secs(120),
        silent: Duration::from_millis(300),
        brake: Duration::from_millis(60),
        stopping: Duration::from_secs(30),
        stand_down: Duration::from_secs(50),
        insisted: Duration::from_secs(2),
        undying: Duration::from_secs(3),
    };

    fn ms(number: u64) -> Duration {
        Duration::from_millis(number)
    }

    #[test]
    fn what_the_signs_of_a_loop_come_to() {
        let walks = Signs { ready: Some(ms(60_000)), ..Signs::default() };
        let pressed = Signs { pressed: Some(ms(61)), ..walks };
        let undying = Event::Undying { touched: true };
        let table = [
            (walks, UP, None),
            (Signs { heard: ms(300), ..walks }, UP, None),
            (Signs { heard: ms(301), ..walks }, UP, Some(Event::LoopSilent)),
            // Before its first tick it may take longer, tidying up as well.
            (Signs { heard: ms(301), ready: None, ..walks }, UP, None),
            (Signs { heard: ms(120_001), ready: None, ..walks }, UP, Some(Event::LoopSilent)),
            (Signs { heard: ms(30_000), stopping: true, ..walks }, UP, None),
            (Signs { heard: ms(30_001), stopping: true, ..walks }, UP, Some(Event::LoopSilent)),
            // The kill button.
            (pressed, UP, Some(Event::Deaf)),
            (Signs { pressed: Some(ms(60)), ..pressed }, UP, None),
            (Signs { brakes: true, ..pressed }, UP, None),
            // Pressed long before the first tick, which was 60 ms, then 61 ms ago: it has the same time from
            // there on.
            (Signs { pressed: Some(ms(5_000)), ready: Some(ms(60)), ..walks }, UP, None),
            (
                Signs { pressed: Some(ms(5_000)), ready: Some(ms(61)), ..walks },
                UP,
                Some(Event::Deaf),
            ),
            // No tick yet: nothing that could brake.
            (Signs { pressed: Some(ms(5_000)), ready: None, ..walks }, UP, None),
            // Asked.
            (Signs { asked: Some(ms(2_001)), ..walks }, State::Ending(Why::Stop), None),
            (
                Signs { asked: Some(ms(2_001)), ..walks },
                State::Ending(Why::Insist),
                Some(Event::TooLong),
            ),
            (
                Signs { asked: Some(ms(50_001)), ..walks },
                State::Ending(Why::Stop),
                Some(Event::TooLong),
            ),
            // Ended by force: nothing counts but whether it is gone.
            (Signs { killed: Some(ms(3_000)), heard: ms(9_000), ..pressed }, UP, None),
            (Signs { killed: Some(ms(3_001)), ..walks }, UP, Some(undying)),
        ];
        for (signs, state, event) in table {
            assert_eq!(judge(&signs, &LIMITS, state, true), event, "{signs:?}");
        }
    }
}
