//! Packing of `u64` words into a payload of `f32` numbers.

/// `f32` numbers that hold the bits of one word.
pub const NUMBERS_PER_WORD: usize = 2;

/// The words as numbers.
pub fn numbers_of(words: &[u64]) -> &[f32] {
    bytemuck::cast_slice(words)
}

/// The words in these numbers, whatever the alignment of the slice.
pub fn words_of(numbers: &[f32]) -> Vec<u64> {
    let (words, _) = numbers.as_chunks::<NUMBERS_PER_WORD>();
    words.iter().map(|numbers| bytemuck::cast(*numbers)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_survive_packing_bit_for_bit() {
        let words = [0, u64::MAX, 0x7FA0_0001_FFA0_0001, f64::NAN.to_bits(), 1];
        assert_eq!(words_of(numbers_of(&words)), words);
        let mut shifted = vec![0.0];
        shifted.extend(numbers_of(&words));
        assert_eq!(
            words_of(&shifted[1..]),
            words,
            "an odd offset, which is not aligned for u64"
        );
    }
}
