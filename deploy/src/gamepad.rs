//! A gamepad as Linux shows it (`/dev/input/js0`): eight bytes per event, of which the newest of each axis
//! and button counts.
//!
//! The form of an event (time in ms, value, type, number) is that of the kernel's joystick interface,
//! `Documentation/input/joydev/joystick-api.rst`; numbers of axes and buttons are those of its driver for
//! common pads (`xpad`): left stick 0 and 1, right stick 3, left shoulder 4.

/// Bytes of one event.
pub const EVENT_BYTES: usize = 8;
/// Axes and buttons that are looked at; further ones are left out.
const MANY: usize = 32;
/// How far a stick must be from its middle to count, as a share of its way: sticks do not come back to
/// exactly 0.
const DEAD_ZONE: f32 = 0.1;
/// Full deflection.
const FULL: f32 = 32_767.0;
const BUTTON: u8 = 1;
const AXIS: u8 = 2;
/// Set in events that tell how things stand when the device is opened, and after the kernel's queue ran over.
const INITIAL: u8 = 0x80;

/// How far sticks lie and which buttons are down.
#[derive(Clone, Debug, Default)]
pub struct Gamepad {
    axes: [f32; MANY],
    buttons: [bool; MANY],
}

/// What a full stick means.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Speeds {
    /// Forward and sideways, m/s.
    pub linear_mps: f32,
    /// Turning, rad/s.
    pub yaw_radps: f32,
}

impl Gamepad {
    /// Takes an event. What a button does on its own when the device is opened does not count as pressed: it
    /// must be pressed once more.
    pub fn take(&mut self, event: [u8; EVENT_BYTES]) {
        let [_, _, _, _, low, high, kind, number] = event;
        let (value, number) = (i16::from_le_bytes([low, high]), usize::from(number));
        if number >= MANY {
            return;
        }
        match kind {
            AXIS => self.axes[number] = deflection(value),
            _ if kind == AXIS | INITIAL => self.axes[number] = deflection(value),
            BUTTON => self.buttons[number] = value != 0,
            // The kernel tells how things stand anew after its queue ran over: a button that is up was let go
            // of.
            _ if kind == BUTTON | INITIAL && value == 0 => self.buttons[number] = false,
            _ => {}
        }
    }

    /// Whether button `number` is down.
    pub fn is_down(&self, number: u8) -> bool {
        self.buttons.get(usize::from(number)) == Some(&true)
    }

    /// Velocity forward and to the left, m/s, and yaw rate, rad/s. Sticks count to the right and downwards,
    /// the robot to the left and forwards.
    pub fn command(&self, full: Speeds) -> [f32; 3] {
        let along = |axis: usize, speed: f32| match self.axes[axis] {
            0.0 => 0.0,
            way => -way * speed,
        };
        [along(1, full.linear_mps), along(0, full.linear_mps), along(3, full.yaw_radps)]
    }
}

/// −1 to 1; 0 within the dead zone.
fn deflection(value: i16) -> f32 {
    let way = (f32::from(value) / FULL).max(-1.0);
    if way.abs() < DEAD_ZONE { 0.0 } else { way }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(kind: u8, number: u8, value: i16) -> [u8; EVENT_BYTES] {
        let [low, high] = value.to_le_bytes();
        [1, 2, 3, 4, low, high, kind, number]
    }

    #[test]
    fn sticks_are_speeds_and_buttons_are_held() {
        let full = Speeds { linear_mps: 0.4, yaw_radps: 0.8 };
        let mut pad = Gamepad::default();
        assert_eq!(pad.command(full), [0.0; 3]);
        // Left stick all the way up and a little to the left, right stick half to the right.
        pad.take(event(AXIS, 1, -32_767));
        pad.take(event(AXIS, 0, -1_000));
        pad.take(event(AXIS, 3, 16_384));
        let [vx, vy, yaw] = pad.command(full);
        assert!((vx - 0.4).abs() < 1e-6 && vy == 0.0 && (yaw + 0.4).abs() < 1e-3);
        // i16's least value is one step beyond full.
        pad.take(event(AXIS, 1, i16::MIN));
        assert_eq!(pad.command(full)[0], 0.4);
        pad.take(event(BUTTON, 4, 1));
        assert!(pad.is_down(4) && !pad.is_down(5));
        pad.take(event(BUTTON, 4, 0));
        assert!(!pad.is_down(4));
    }

    #[test]
    fn a_button_that_was_down_before_the_device_was_opened_is_not_held() {
        let mut pad = Gamepad::default();
        pad.take(event(BUTTON | INITIAL, 4, 1));
        assert!(!pad.is_down(4));
        // Let go of while the kernel's queue ran over: only how things stand afterwards says so.
        pad.take(event(BUTTON, 4, 1));
        assert!(pad.is_down(4));
        pad.take(event(BUTTON | INITIAL, 4, 0));
        assert!(!pad.is_down(4));
        // Sticks that lie somewhere do lie there.
        pad.take(event(AXIS | INITIAL, 1, 32_767));
        let full = Speeds { linear_mps: 1.0, yaw_radps: 1.0 };
        assert_eq!(pad.command(full)[0], -1.0);
    }

    #[test]
    fn whatever_a_device_says_nothing_panics_and_speeds_stay_in_range() {
        let full = Speeds { linear_mps: 0.3, yaw_radps: 0.6 };
        let mut pad = Gamepad::default();
        for kind in 0..=255 {
            for number in [0, 1, 3, 31, 32, 255] {
                for value in [i16::MIN, -1, 0, 1, i16::MAX] {
                    pad.take(event(kind, number, value));
                    assert!(pad.command(full).iter().all(|v| v.abs() <= 0.6));
                }
            }
        }
        assert!(!pad.is_down(255));
    }
}
