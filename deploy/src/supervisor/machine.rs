//! What the supervisor does when, as a function: a state, an event, the next state and what to do. It knows no clock, no process and no
//! signal; [`super`] tells it what happened.
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
//! *Invariant:* wherever a loop that may have had torque is gone and did not end in order, the servos are let go; after the kill button or
//! a stop no loop is started.

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
    /// Let the servos go.
    LetGo,
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
    /// The loop died too often.
    GivenUp {
        /// How often in a row.
        deaths: u32,
    },
    /// A second signal.
    Interrupted,
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
        Event::Kill => (State::Over(Verdict::KilledWhileDown), &[]),
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
        Event::LoopEnded {
            end: End::Died(_),
            touched,
            calm,
        } => {
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

/// A robot that this run never touched may be somebody else's.
fn letting_go(touched: bool) -> &'static [Do] {
    match touched {
        true => &[Do::LetGo],
        false => &[],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CRASH: End = End::Died(None);
    const FAULT: End = End::Wrong(ExitCode::Unavailable);

    fn ended(end: End, touched: bool) -> Event {
        Event::LoopEnded {
            end,
            touched,
            calm: false,
        }
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
        let calm = LoopEnded {
            end: CRASH,
            touched: true,
            calm: true,
        };
        let table: &[(State, Event, State, &[Do])] = &[
            // Before the first loop.
            (Waiting, AgentReady, UP, &[Do::StartLoop]),
            (Waiting, AgentFailed(FAULT), over(Agent(FAULT)), &[]),
            (Waiting, Stop, over(Done), &[]),
            (Waiting, Insist, over(Interrupted), &[]),
            (Waiting, Kill, over(KilledWhileDown), &[]),
            // The loop ends by itself.
            (UP, ended(End::InOrder, true), over(Loop(End::InOrder)), &[]),
            (UP, ended(FAULT, true), over(Loop(FAULT)), &[Do::LetGo]),
            // The port is another program's: its robot must not be let go.
            (UP, ended(FAULT, false), over(Loop(FAULT)), &[]),
            // The loop dies.
            (UP, ended(CRASH, true), down(1), &[Do::LetGo]),
            (UP, ended(CRASH, false), down(1), &[]),
            (Up { deaths: 2 }, ended(CRASH, true), down(3), &[Do::LetGo]),
            (
                Up { deaths: 3 },
                ended(CRASH, true),
                over(GivenUp { deaths: 4 }),
                &[Do::LetGo],
            ),
            (Up { deaths: 3 }, calm, down(1), &[Do::LetGo]),
            (down(2), PauseOver, Up { deaths: 2 }, &[Do::StartLoop]),
            (UP, LoopSilent, UP, &[Do::KillLoop]),
            // Stop.
            (UP, Stop, Ending(Why::Stop), &[Do::AskLoop]),
            (down(1), Stop, over(Done), &[]),
            (
                Ending(Why::Stop),
                ended(End::InOrder, true),
                over(Loop(End::InOrder)),
                &[],
            ),
            (
                Ending(Why::Stop),
                ended(CRASH, true),
                over(Loop(CRASH)),
                &[Do::LetGo],
            ),
            (
                Ending(Why::Stop),
                LoopSilent,
                Ending(Why::Stop),
                &[Do::KillLoop],
            ),
            (
                Ending(Why::Stop),
                TooLong,
                Ending(Why::Stop),
                &[Do::KillLoop],
            ),
            (Ending(Why::Stop), PauseOver, Ending(Why::Stop), &[]),
            // Twice.
            (
                Ending(Why::Stop),
                Insist,
                Ending(Why::Insist),
                &[Do::AskLoop],
            ),
            (
                Ending(Why::Kill),
                Insist,
                Ending(Why::Insist),
                &[Do::AskLoop],
            ),
            (
                Ending(Why::Insist),
                TooLong,
                Ending(Why::Insist),
                &[Do::KillLoop],
            ),
            (
                Ending(Why::Insist),
                ended(End::InOrder, true),
                over(Interrupted),
                &[Do::LetGo],
            ),
            (
                Ending(Why::Insist),
                ended(CRASH, true),
                over(Interrupted),
                &[Do::LetGo],
            ),
            (
                Ending(Why::Insist),
                ended(CRASH, false),
                over(Interrupted),
                &[],
            ),
            (down(1), Insist, over(Interrupted), &[Do::LetGo]),
            // The kill button.
            (UP, Kill, Ending(Why::Kill), &[]),
            (Ending(Why::Stop), Kill, Ending(Why::Kill), &[]),
            (Ending(Why::Insist), Kill, Ending(Why::Insist), &[]),
            (down(1), Kill, over(KilledWhileDown), &[Do::LetGo]),
            (
                Ending(Why::Kill),
                ended(End::InOrder, true),
                over(Loop(End::InOrder)),
                &[],
            ),
            (
                Ending(Why::Kill),
                ended(CRASH, true),
                over(Loop(CRASH)),
                &[Do::LetGo],
            ),
            (Ending(Why::Kill), Deaf, Ending(Why::Deaf), &[Do::KillLoop]),
            (
                Ending(Why::Kill),
                LoopSilent,
                Ending(Why::Deaf),
                &[Do::KillLoop],
            ),
            (
                Ending(Why::Deaf),
                ended(CRASH, true),
                over(KilledWhileHung),
                &[Do::LetGo],
            ),
            (Ending(Why::Deaf), Insist, Ending(Why::Deaf), &[]),
            // Afterwards nothing happens any more.
            (over(Done), AgentReady, over(Done), &[]),
            (
                over(Interrupted),
                ended(CRASH, true),
                over(Interrupted),
                &[],
            ),
        ];
        for (state, event, then, todo) in table {
            assert_eq!(next(*state, *event), (*then, *todo), "{state:?}, {event:?}");
        }
    }

    /// Every sequence of events of a world in which a loop ends only when it runs: what must never happen does not.
    #[test]
    fn whatever_happens_servos_are_let_go_and_nothing_starts_after_a_kill_or_a_stop() {
        #[derive(Clone, Copy)]
        struct World {
            state: State,
            runs: bool,
            /// A loop that may have had torque is gone, did not end in order, and the servos were not let go since.
            held: bool,
            asked: bool,
        }
        let events = [
            Event::AgentReady,
            Event::AgentFailed(FAULT),
            ended(End::InOrder, true),
            ended(FAULT, true),
            ended(CRASH, true),
            Event::LoopSilent,
            Event::PauseOver,
            Event::TooLong,
            Event::Stop,
            Event::Insist,
            Event::Kill,
            Event::Deaf,
        ];
        let mut open = vec![(
            World {
                state: State::Waiting,
                runs: false,
                held: false,
                asked: false,
            },
            0,
        )];
        let mut seen = 0;
        while let Some((world, depth)) = open.pop() {
            seen += 1;
            if depth == 7 {
                continue;
            }
            for event in events {
                let ends = matches!(event, Event::LoopEnded { .. });
                let of_a_loop =
                    ends || matches!(event, Event::LoopSilent | Event::Deaf | Event::TooLong);
                if of_a_loop && !world.runs {
                    continue;
                }
                let mut after = world;
                after.asked |= matches!(event, Event::Stop | Event::Insist | Event::Kill);
                if ends {
                    after.runs = false;
                    after.held = event != ended(End::InOrder, true);
                }
                let (state, todo) = next(world.state, event);
                after.state = state;
                for todo in todo {
                    match todo {
                        Do::StartLoop => {
                            assert!(!after.asked, "{:?}, {event:?}", world.state);
                            assert!(!after.held && !after.runs);
                            after.runs = true;
                        }
                        Do::LetGo => after.held = false,
                        Do::AskLoop | Do::KillLoop => assert!(after.runs),
                    }
                }
                assert!(!after.held, "{:?}, {event:?}: torque is left", world.state);
                if matches!(state, State::Over(_)) {
                    assert!(!after.runs, "{:?}, {event:?}: a loop is left", world.state);
                    continue;
                }
                open.push((after, depth + 1));
            }
        }
        assert!(seen > 10_000, "{seen}");
    }
}
