//! The check of a row: a hash that shows that a place of the ring holds exactly that row.

/// An odd constant with well-spread bits (the golden ratio's).
const SPREAD: u64 = 0x9E37_79B9_7F4A_7C15;

/// The check of an empty place, whose row was never written or was given up.
pub(super) const NONE: u32 = 0;

/// The check of row `index`; never `NONE`.
///
/// A multiply-and-fold over the row's 64-bit words. CRC-32 would take two to three times as long for rows this short.
#[inline]
pub(super) fn of_row(index: u64, row: &[f32]) -> u32 {
    let mut sum = fold(index ^ SPREAD, SPREAD);
    let (pairs, rest) = row.as_chunks::<2>();
    for [low, high] in pairs {
        let word = u64::from(low.to_bits()) | u64::from(high.to_bits()) << 32;
        sum = fold(sum ^ word, SPREAD);
    }
    for last in rest {
        sum = fold(sum ^ u64::from(last.to_bits()), SPREAD);
    }
    let sum = fold(sum, !SPREAD);
    ((sum >> 32) as u32 ^ sum as u32).max(1)
}

#[inline]
fn fold(a: u64, b: u64) -> u64 {
    let product = u128::from(a) * u128::from(b);
    (product >> 64) as u64 ^ product as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_check_depends_on_every_bit_of_a_row_and_its_number() {
        let row: Vec<f32> = (0..11).map(|i| i as f32 * 0.37 - 1.0).collect();
        let check = of_row(5, &row);
        assert_eq!(check, 0xEAF0_ED5F, "the check is part of the file's format");
        for bit in 0..64 {
            assert_ne!(check, of_row(5 ^ 1 << bit, &row));
        }
        for i in 0..row.len() {
            for bit in 0..32 {
                let mut other = row.clone();
                other[i] = f32::from_bits(other[i].to_bits() ^ 1 << bit);
                assert_ne!(check, of_row(5, &other));
            }
        }
        assert_ne!(of_row(0, &[0.0; 11]), NONE);
    }
}
