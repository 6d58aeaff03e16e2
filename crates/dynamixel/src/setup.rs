//! What every servo must hold before its torque goes on: found, compared, and set right where that is asked
//! for.

use std::fmt;
use std::time::Duration;

use crate::bus::{Bus, BusFault};
use crate::port::Port;
use crate::status::HardwareError;
use crate::units::{register_of_baud, wire_us};
use crate::xm430::{self, Register};

/// Tries for each question during set-up.
pub const TRIES: u32 = 3;
/// Speeds at which a servo is looked for, likely ones first.
pub const BAUDS: [u32; 6] = [1_000_000, 57_600, 3_000_000, 2_000_000, 115_200, 4_000_000];
/// How long setting a servo's speed takes to have an effect.
const BAUD_PAUSE: Duration = Duration::from_millis(5);

/// One register and what it must hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Want {
    /// Which.
    pub register: &'static Register,
    /// Its value.
    pub value: i32,
}

/// What was found in a register.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Finding {
    /// Which servo.
    pub id: u8,
    /// What it should hold.
    pub want: Want,
    /// What it held.
    pub found: i32,
    /// Whether it holds the right value now.
    pub right: bool,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { id, want, found, .. } = self;
        write!(f, "servo {id}: {} is {found}, must be {}", want.register.name, want.value)
    }
}

/// Repeats a question that nobody answered; an answer of whatever kind ends it.
///
/// # Errors
/// The last one.
pub fn persistently<T>(mut ask: impl FnMut() -> Result<T, BusFault>) -> Result<T, BusFault> {
    let mut left = TRIES;
    loop {
        left -= 1;
        match ask() {
            Err(BusFault::Silent { .. }) if left > 0 => {}
            other => return other,
        }
    }
}

/// Compares registers of one servo, and writes those that differ where `fix` is set. The torque must be off
/// for that.
///
/// # Errors
/// [`BusFault`]; a refusal too, since nothing can be said about the servo then.
pub fn compare<P: Port>(
    bus: &mut Bus<P>,
    id: u8,
    wants: &[Want],
    fix: bool,
) -> Result<Vec<Finding>, BusFault> {
    let deadline = bus.setup_deadline;
    let mut findings = Vec::new();
    for want in wants {
        let register = want.register;
        let (found, _) = persistently(|| bus.read(id, register, deadline))?;
        if found == want.value {
            continue;
        }
        let mut right = false;
        if fix {
            persistently(|| bus.write(id, register, want.value, deadline))?;
            // What counts is what the servo holds, not that it took the order.
            let (now, _) = persistently(|| bus.read(id, register, deadline))?;
            right = now == want.value;
        }
        findings.push(Finding { id, want: *want, found, right });
    }
    Ok(findings)
}

/// Looks for servo `id` at all usual speeds, the present one first; the speed it answers at, which the bus
/// then has. The bus is as before where it does not answer.
///
/// # Errors
/// [`BusFault`] of the present speed where none works, so that it says what matters.
pub fn find_baud<P: Port>(bus: &mut Bus<P>, id: u8) -> Result<u32, BusFault> {
    let (present, deadline) = (bus.baud(), bus.setup_deadline);
    let first = match persistently(|| bus.ping(id, deadline)) {
        Ok(_) => return Ok(present),
        Err(error) => error,
    };
    for baud in BAUDS.into_iter().filter(|b| *b != present) {
        // A port may not be able to go at every speed.
        if bus.set_baud(baud).is_err() {
            continue;
        }
        if bus.ping(id, deadline).is_ok() {
            return Ok(baud);
        }
    }
    bus.set_baud(present)?;
    Err(first)
}

/// Moves servo `id`, which answers at the bus's present speed, to `baud`, and the bus with it.
///
/// # Errors
/// [`BusFault`]; a speed that servos do not know is `InvalidInput` of the port.
pub fn move_to_baud<P: Port>(bus: &mut Bus<P>, id: u8, baud: u32) -> Result<(), BusFault> {
    let Some(code) = register_of_baud(baud) else {
        let what = format!("servos have no speed of {baud} baud");
        return Err(std::io::Error::new(std::io::ErrorKind::InvalidInput, what).into());
    };
    let deadline = bus.setup_deadline;
    bus.write(id, &xm430::TORQUE_ENABLE, 0, deadline)?;
    // Its answer may come at either speed.
    match bus.write(id, &xm430::BAUD_RATE, i32::from(code), deadline) {
        Ok(_) | Err(BusFault::Silent { .. }) => {}
        Err(error) => return Err(error),
    }
    std::thread::sleep(BAUD_PAUSE);
    bus.set_baud(baud)?;
    persistently(|| bus.ping(id, deadline)).map(|_| ())
}

/// What a servo's latched hardware errors are.
pub fn hardware_error<P: Port>(bus: &mut Bus<P>, id: u8) -> Result<HardwareError, BusFault> {
    let deadline = bus.setup_deadline;
    let (bits, _) = persistently(|| bus.read(id, &xm430::HARDWARE_ERROR_STATUS, deadline))?;
    Ok(HardwareError(bits as u8))
}

/// How long a tick's reading and writing takes on the wire, µs: `servos` answers of `bytes`, then goals of 4
/// bytes each.
pub fn tick_us(servos: usize, bytes: usize, fast: bool, return_delay_us: u64, baud: u32) -> u64 {
    let frame = |parameters: usize| crate::frame::PREFIX + 1 + parameters + 2;
    let request = wire_us(frame(4 + servos), baud);
    let answers = match fast {
        true => return_delay_us + wire_us(frame(servos * (bytes + 4) - 2), baud),
        false => servos as u64 * (return_delay_us + wire_us(frame(1 + bytes), baud)),
    };
    request + answers + wire_us(frame(4 + 5 * servos), baud)
}
