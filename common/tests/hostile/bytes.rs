//! Random damage to bytes.

use proptest::prelude::*;
use proptest::sample::Index;

/// One damage to a file.
#[derive(Clone, Debug)]
pub(crate) enum Damage {
    Flip(Index, u8),
    Cut(Index),
    Insert(Index, Vec<u8>),
    Zero(Index),
}

impl Damage {
    pub(crate) fn apply(self, bytes: &mut Vec<u8>) {
        // One more place than there are bytes: the end of the file.
        let place = |at: Index| at.index(bytes.len() + 1);
        match self {
            Self::Flip(at, bits) => {
                let at = place(at);
                bytes.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= bits);
            }
            Self::Cut(at) => bytes.truncate(place(at)),
            Self::Insert(at, new) => {
                let at = place(at);
                bytes.splice(at..at, new);
            }
            Self::Zero(at) => {
                let at = place(at);
                bytes[at..].fill(0);
            }
        }
    }
}

pub(crate) fn damage() -> impl Strategy<Value = Damage> {
    prop_oneof![
        4 => (any::<Index>(), 1_u8..).prop_map(|(at, bits)| Damage::Flip(at, bits)),
        1 => any::<Index>().prop_map(Damage::Cut),
        1 => (any::<Index>(), prop::collection::vec(any::<u8>(), 1..20)).prop_map(|(at, new)| Damage::Insert(at, new)),
        1 => any::<Index>().prop_map(Damage::Zero),
    ]
}

/// Extreme numbers, mixed with arbitrary ones.
pub(crate) fn extreme() -> impl Strategy<Value = u64> {
    prop_oneof![
        0..5_u64,
        (0..64_u32).prop_map(|bit| 1 << bit),
        (0..64_u32).prop_map(|bit| (1_u64 << bit).wrapping_sub(1)),
        (0..40_u64).prop_map(|below| u64::MAX - below),
        any::<u64>(),
    ]
}
