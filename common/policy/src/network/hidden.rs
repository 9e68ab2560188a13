//! The hidden layers of a network: their number, their units, and their activation function.

use std::ops::{Deref, DerefMut};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::section::{Bounded, Bounds, OutOfRange};

/// Units of each hidden layer, from the first to the last: a list of 1 to 8 numbers, written as `[400, 300]`.
///
/// The numbers can be changed in place, but not the length of the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "Vec<usize>", into = "Vec<usize>")]
#[schemars(with = "Vec<usize>")]
pub struct Layers {
    /// Unused entries are 0.
    units: [usize; Layers::MAX],
    count: usize,
}

/// A list of layers is empty or too long.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("must be a list of 1 to {} numbers, one for each layer", Layers::MAX)]
pub struct LayersError;

impl Layers {
    /// The most hidden layers of a network.
    pub const MAX: usize = 8;
}

impl Deref for Layers {
    type Target = [usize];

    fn deref(&self) -> &[usize] {
        &self.units[..self.count]
    }
}

impl DerefMut for Layers {
    fn deref_mut(&mut self) -> &mut [usize] {
        &mut self.units[..self.count]
    }
}

/// An invalid length is a compile error.
impl<const N: usize> From<[usize; N]> for Layers {
    fn from(list: [usize; N]) -> Self {
        const { assert!(1 <= N && N <= Layers::MAX, "1 to 8 layers") };
        let mut units = [0; Self::MAX];
        units[..N].copy_from_slice(&list);
        Self { units, count: N }
    }
}

impl TryFrom<Vec<usize>> for Layers {
    type Error = LayersError;

    fn try_from(list: Vec<usize>) -> Result<Self, LayersError> {
        if list.is_empty() || list.len() > Self::MAX {
            return Err(LayersError);
        }
        let mut units = [0; Self::MAX];
        units[..list.len()].copy_from_slice(&list);
        let count = list.len();
        Ok(Self { units, count })
    }
}

impl From<Layers> for Vec<usize> {
    fn from(layers: Layers) -> Self {
        layers.to_vec()
    }
}

impl Bounded for Layers {
    type Number = usize;

    fn check(&self, section: &str, key: &str, bounds: &Bounds<usize>) -> Result<(), OutOfRange> {
        (**self).check(section, key, bounds)
    }
}

/// The activation function of a hidden unit with weighted sum z.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// max(z, 0).
    Relu,
    /// tanh z.
    Tanh,
}

/// The hidden layers of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Hidden {
    /// Units of each layer.
    pub layers: Layers,
    /// The activation function of all units.
    pub activation: Activation,
}

impl Hidden {
    /// Layers whose units all have this activation function.
    pub fn new(layers: Layers, activation: Activation) -> Self {
        Self { layers, activation }
    }

    /// Layers of ReLU units, as in the thesis.
    pub fn relu(layers: impl Into<Layers>) -> Self {
        Self::new(layers.into(), Activation::Relu)
    }

    /// Layers of tanh units.
    pub fn tanh(layers: impl Into<Layers>) -> Self {
        Self::new(layers.into(), Activation::Tanh)
    }
}

#[cfg(test)]
mod tests {
    use shoal_base::section::from;

    use super::*;

    #[test]
    fn a_list_has_1_to_8_layers() {
        assert_eq!(*Layers::try_from(vec![3]).unwrap(), [3]);
        let longest: Vec<usize> = (1..=8).collect();
        assert_eq!(*Layers::try_from(longest.clone()).unwrap(), *longest);
        assert_eq!(Layers::try_from(vec![4, 5]).unwrap(), Layers::from([4, 5]));
        assert_ne!(Layers::from([4]), Layers::from([4, 5]));
        for wrong in [vec![], vec![2; 9]] {
            let error = Layers::try_from(wrong).unwrap_err().to_string();
            assert_eq!(error, "must be a list of 1 to 8 numbers, one for each layer");
        }
    }

    #[test]
    fn each_number_is_checked_against_the_bounds() {
        let error = Layers::from([1, 2, 9]).check("a", "b", &from(1, 8)).unwrap_err();
        assert_eq!(error.to_string(), "a.b[2] = 9: must be from 1 to 8");
    }
}
