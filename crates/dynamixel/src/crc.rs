//! CRC-16 of protocol 2.0: polynomial x¹⁶ + x¹⁵ + x² + 1 (0x8005), start 0, bits not reflected (CRC-16/UMTS).

const TABLE: [u16; 256] = table();

const fn table() -> [u16; 256] {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let mut crc = (byte as u16) << 8;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc & 0x8000 == 0 { crc << 1 } else { (crc << 1) ^ 0x8005 };
            bit += 1;
        }
        table[byte] = crc;
        byte += 1;
    }
    table
}

/// The CRC of `bytes`.
pub fn crc16(bytes: &[u8]) -> u16 {
    crc16_more(0, bytes)
}

/// The CRC of what `crc` is the CRC of, followed by `bytes`.
pub fn crc16_more(crc: u16, bytes: &[u8]) -> u16 {
    bytes.iter().fold(crc, |crc, byte| (crc << 8) ^ TABLE[usize::from((crc >> 8) as u8 ^ byte)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_check_value_of_crc_16_umts() {
        // The catalogue of parametrised CRC algorithms: CRC-16/UMTS of "123456789" is 0xFEE8.
        assert_eq!(crc16(b"123456789"), 0xFEE8);
        assert_eq!(crc16_more(crc16(b"1234"), b"56789"), 0xFEE8);
    }

    #[test]
    fn one_byte_by_hand() {
        // 0x01: the bit reaches the top after 15 shifts, so one division: 0x8005.
        assert_eq!(crc16(&[0x01]), 0x8005);
        // 0x02 is that shifted once, and the top bit divides once more: 0x000A ^ 0x8005.
        assert_eq!(crc16(&[0x02]), 0x800F);
    }
}
