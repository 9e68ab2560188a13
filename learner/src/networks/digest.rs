//! A hash that identifies a set of weights.

use std::fmt::Write;

use sha2::{Digest, Sha256};

/// SHA-256, in hexadecimal, over the numbers of `networks` in their order, each as little-endian `f32`.
pub fn sha256(networks: &[&[f32]]) -> String {
    let mut hasher = Sha256::new();
    for number in networks.iter().copied().flatten() {
        hasher.update(number.to_le_bytes());
    }
    hasher.finalize().iter().fold(String::new(), |mut hex, byte| {
        // Writing into a string cannot fail.
        let _ = write!(hex, "{byte:02x}");
        hex
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_digest_is_the_hash_of_the_bytes() {
        // printf '\x00\x00\x80\x3f\x00\x00\x00\xc0' | sha256sum
        let expected = "ee4ac73c2bd27756ab82780f27c73a7bc4d3f0bb6acb37e008bc27eccd7e588b";
        assert_eq!(sha256(&[&[1.0], &[-2.0]]), expected);
        assert_eq!(sha256(&[&[], &[1.0, -2.0]]), expected);
    }

    #[test]
    fn one_bit_changes_the_digest() {
        let weights = [0.5f32, -0.25, 3e-3];
        let mut changed = weights;
        changed[2] = f32::from_bits(changed[2].to_bits() ^ 1);
        assert_ne!(sha256(&[&weights]), sha256(&[&changed]));
    }
}
