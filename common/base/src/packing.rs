//! Words of 64 bits among numbers of 32: how a `u64` travels in a payload of `f32`.

/// Numbers that carry the bits of a word.
pub const NUMBERS_OF_A_WORD: usize = 2;

/// Words as they travel.
pub fn numbers_of(words: &[u64]) -> &[f32] {
    bytemuck::cast_slice(words)
}

/// The words whose bits came, wherever in memory they lie.
pub fn words_of(numbers: &[f32]) -> Vec<u64> {
    let (words, _) = numbers.as_chunks::<NUMBERS_OF_A_WORD>();
    words.iter().map(|numbers| bytemuck::cast(*numbers)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_come_as_they_went() {
        let words = [0, u64::MAX, 0x7FA0_0001_FFA0_0001, f64::NAN.to_bits(), 1];
        assert_eq!(words_of(numbers_of(&words)), words);
        let mut shifted = vec![0.0];
        shifted.extend(numbers_of(&words));
        assert_eq!(words_of(&shifted[1..]), words, "f32 is aligned more loosely");
    }
}
