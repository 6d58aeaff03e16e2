//! Letting servos go, and whether they did: the order goes to all at once and nobody answers it, so that each
//! is asked afterwards.

use std::fmt;
use std::time::Duration;

use crate::bus::{Bus, BusFault};
use crate::group::{Answer, GroupRead};
use crate::port::Port;
use crate::setup::TRIES;
use crate::xm430;

/// How often the order is repeated for a servo that says that its torque is still on.
pub const ORDERS_MAX: u32 = 6;

/// What became of the order. Empty lists: all torque is off, and each servo said so.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LetGo {
    /// Ids of servos whose torque is still on.
    pub hold: Vec<u8>,
    /// Ids of servos that did not say.
    pub silent: Vec<u8>,
}

impl LetGo {
    /// Whether every servo said that its torque is off.
    pub fn is_proved(&self) -> bool {
        self.hold.is_empty() && self.silent.is_empty()
    }
}

impl fmt::Display for LetGo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let list = |ids: &[u8]| ids.iter().map(u8::to_string).collect::<Vec<_>>().join(", ");
        match (self.hold.as_slice(), self.silent.as_slice()) {
            ([], []) => f.write_str("every servo says that its torque is off"),
            (hold, []) => write!(f, "the torque is still on of servos {}", list(hold)),
            ([], silent) => {
                write!(f, "servos {} do not say whether their torque is off", list(silent))
            }
            (hold, silent) => write!(
                f,
                "the torque is still on of servos {}; servos {} do not say",
                list(hold),
                list(silent)
            ),
        }
    }
}

/// Lets all servos of the bus go, those of other ids too, and asks `ids` whether they did, each question for
/// at most `patience`. The order is repeated: [`ORDERS_MAX`] times for one that holds, [`TRIES`] times for
/// one that is silent.
///
/// # Errors
/// [`BusFault::Port`] where no order left and no answer came: nobody knows then.
pub fn let_go<P: Port>(
    bus: &mut Bus<P>,
    ids: &[u8],
    patience: Duration,
) -> Result<LetGo, BusFault> {
    let register = &xm430::TORQUE_ENABLE;
    let mut group = GroupRead::new(ids, register.address, register.size, false);
    // What each said last: whether its torque is on.
    let mut on: Vec<Option<bool>> = vec![None; ids.len()];
    let mut fault = None;
    for order in 1..=ORDERS_MAX {
        // A port that refuses now may not in a moment: the next order is tried all the same.
        match ask(bus, &mut group, patience) {
            Ok(()) => fault = None,
            Err(error) => {
                fault = Some(error);
                continue;
            }
        }
        for (index, on) in on.iter_mut().enumerate() {
            if let Answer::Data(_) = group.answer(index) {
                *on = Some(group.data(index) != [0]);
            }
        }
        let holds = on.contains(&Some(true));
        let silent = on.contains(&None);
        if !holds && (!silent || order >= TRIES) {
            break;
        }
    }
    if let Some(fault) = fault {
        return Err(fault);
    }
    let those = |wanted: Option<bool>| {
        let of = ids.iter().zip(&on).filter(|(_, on)| **on == wanted);
        of.map(|(id, _)| *id).collect()
    };
    Ok(LetGo { hold: those(Some(true)), silent: those(None) })
}

fn ask<P: Port>(
    bus: &mut Bus<P>,
    group: &mut GroupRead,
    patience: Duration,
) -> Result<(), BusFault> {
    bus.broadcast(&xm430::TORQUE_ENABLE, 0)?;
    bus.read_group(group, patience)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::emulator::{EmulatedBus, EmulatedPort, EmulatedServo, WireFaults};

    const PATIENCE: Duration = Duration::from_millis(50);
    const IDS: [u8; 4] = [1, 2, 3, 4];

    /// Servos with their torque on.
    fn bus(faults: WireFaults) -> Bus<EmulatedPort> {
        let servo = |id: &u8| {
            let mut servo = EmulatedServo::new(*id, xm430::MODEL_W210);
            servo.put(&xm430::BAUD_RATE, 3);
            servo.put(&xm430::TORQUE_ENABLE, 1);
            servo
        };
        let mut bus = EmulatedBus::new(IDS.iter().map(servo).collect(), 7);
        bus.faults = faults;
        Bus::new(EmulatedPort::new(bus), 1_000_000)
    }

    fn torque(bus: &mut Bus<EmulatedPort>) -> Vec<bool> {
        let servos = bus.port_mut().bus.servos.iter();
        servos.map(EmulatedServo::torque_on).collect()
    }

    #[test]
    fn all_let_go_and_say_so_on_a_bad_wire_too() {
        for flipped_bit in [0.0, 0.2] {
            let mut bus = bus(WireFaults { flipped_bit, ..WireFaults::default() });
            let done = let_go(&mut bus, &IDS, PATIENCE).unwrap();
            assert!(done.is_proved(), "{done}");
            assert_eq!(torque(&mut bus), [false; 4]);
        }
    }

    #[test]
    fn one_that_holds_and_one_that_is_silent_are_told_by_id() {
        let mut bus = bus(WireFaults::default());
        bus.port_mut().bus.servos[1].jammed = true;
        bus.port_mut().bus.servos[3].unplugged = true;
        let done = let_go(&mut bus, &IDS, PATIENCE).unwrap();
        assert_eq!((done.hold.as_slice(), done.silent.as_slice()), (&[2][..], &[4][..]));
        assert!(!done.is_proved());
        assert_eq!(done.to_string(), "the torque is still on of servos 2; servos 4 do not say");
        // The others were let go all the same.
        assert_eq!(torque(&mut bus), [false, true, false, true]);
    }

    #[test]
    fn what_is_not_asked_is_let_go_as_well() {
        let mut bus = bus(WireFaults::default());
        assert!(let_go(&mut bus, &[1], PATIENCE).unwrap().is_proved());
        assert_eq!(torque(&mut bus), [false; 4]);
    }
}
