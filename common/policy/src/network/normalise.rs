//! Normalised inputs.

/// A normalised number is clipped to −`OBSERVATION_CLIP` … `OBSERVATION_CLIP`.
pub const OBSERVATION_CLIP: f32 = 10.0;

/// x ← (x − mean) · factor, clipped, for each of `inputs`, which are vectors of the same width one after the other.
pub fn normalise(inputs: &mut [f32], (mean, factor): (&[f32], &[f32])) {
    for x in inputs.chunks_exact_mut(mean.len()) {
        for ((x, mean), factor) in x.iter_mut().zip(mean).zip(factor) {
            *x = ((*x - mean) * factor).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_number_is_shifted_scaled_and_clipped() {
        let mut inputs = [3.0, 0.0, 1.0, 100.0];
        normalise(&mut inputs, (&[1.0, 10.0], &[2.0, 0.5]));
        assert_eq!(inputs, [4.0, -5.0, 0.0, OBSERVATION_CLIP]);
    }
}
