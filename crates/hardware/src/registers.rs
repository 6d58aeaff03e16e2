//! Registers and scales of the LSM6DSOX (gyroscope, accelerometer), from ST's data sheet.

/// Standard gravity, m/s².
pub const G_MPS2: f32 = 9.806_65;

/// WHO_AM_I.
pub const WHO_AM_I: u8 = 0x0F;

/// Its 7-bit address with SA0 low.
pub const LSM6_ADDRESS: u8 = 0x6A;
/// Its answer at WHO_AM_I.
pub const LSM6_ID: u8 = 0x6C;
/// CTRL1_XL: rate and range of the accelerometer.
pub const LSM6_CTRL1_XL: u8 = 0x10;
/// 208 Hz, ±4 g, second low-pass filter on: a foot that strikes is a spike of a few milliseconds, of which
/// reading once per 20 ms would take a random part. Without the filter the direction of gravity was 18° off
/// on the emulated robot.
pub const LSM6_CTRL1_XL_VALUE: u8 = 0b0101_1010;
/// The bit of CTRL1_XL that switches that filter on.
pub const LSM6_LPF2: u8 = 0b10;
/// CTRL8_XL: where that filter ends.
pub const LSM6_CTRL8_XL: u8 = 0x17;
/// A tenth of the rate, 21 Hz.
pub const LSM6_CTRL8_XL_VALUE: u8 = 0b0010_0000;
/// CTRL2_G: rate and range of the gyroscope.
pub const LSM6_CTRL2_G: u8 = 0x11;
/// 208 Hz, ±500 °/s: the girdle of a walking robot turns at up to about 3 rad/s (170 °/s).
pub const LSM6_CTRL2_G_VALUE: u8 = 0b0101_0100;
/// CTRL3_C.
pub const LSM6_CTRL3_C: u8 = 0x12;
/// Both bytes of a value are of one sample; addresses count up by themselves.
pub const LSM6_CTRL3_C_VALUE: u8 = 0b0100_0100;
/// STATUS_REG: bit 0 new acceleration, bit 1 new rate.
pub const LSM6_STATUS: u8 = 0x1E;
/// OUTX_L_G: three rates, then three accelerations, 16 bits each, low byte first.
pub const LSM6_OUT: u8 = 0x22;
/// One unit of rate at ±500 °/s: 17.5 m°/s, rad/s.
pub const LSM6_RATE_LSB_RADPS: f32 = 0.0175 * std::f32::consts::PI / 180.0;
/// One unit of acceleration at ±4 g: 0.122 mg, m/s².
pub const LSM6_ACC_LSB_MPS2: f32 = 0.122e-3 * G_MPS2;
