//! The range of an action space, to which tanh outputs are scaled.

use shoal_base::space::Space;

/// The bounds of each action element, their middle and half their distance. It converts tanh outputs to actions in
/// environment units.
#[derive(Clone, Debug, PartialEq)]
pub struct ActionRange {
    low: Vec<f32>,
    high: Vec<f32>,
    centre: Vec<f32>,
    half: Vec<f32>,
}

/// Why a policy with tanh outputs cannot act in a space.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ActionRangeError {
    /// The actions are discrete.
    #[error("the action space is discrete ({n} actions), but this algorithm needs real-valued actions (a box)")]
    Discrete {
        /// Number of actions.
        n: u32,
    },
    /// The box has no elements.
    #[error("the action space is a box without elements")]
    Empty,
    /// The bounds are infinite or NaN, or the lower is not below the upper.
    #[error(
        "action element {element} ranges from {low} to {high}, but a policy needs finite bounds, the lower below the upper"
    )]
    Bounds {
        /// Index of the element.
        element: usize,
        /// Its lower bound.
        low: f32,
        /// Its upper bound.
        high: f32,
    },
}

impl ActionRange {
    /// The range of `space`, which must be a box with finite bounds.
    pub fn new(space: &Space) -> Result<Self, ActionRangeError> {
        let (low, high) = match space {
            Space::Box { low, high } => (low, high),
            Space::Discrete { n, .. } => return Err(ActionRangeError::Discrete { n: *n }),
        };
        if low.is_empty() {
            return Err(ActionRangeError::Empty);
        }
        for (element, (&low, &high)) in low.iter().zip(high).enumerate() {
            let half = high / 2.0 - low / 2.0;
            if !(half.is_finite() && half > 0.0) {
                return Err(ActionRangeError::Bounds { element, low, high });
            }
        }
        let pairs = || low.iter().zip(high);
        Ok(Self {
            low: low.clone(),
            high: high.clone(),
            centre: pairs().map(|(low, high)| low / 2.0 + high / 2.0).collect(),
            half: pairs().map(|(low, high)| high / 2.0 - low / 2.0).collect(),
        })
    }

    /// The lowest value of each element.
    pub fn low(&self) -> &[f32] {
        &self.low
    }

    /// The highest value of each element.
    pub fn high(&self) -> &[f32] {
        &self.high
    }

    /// Number of elements of an action.
    pub fn width(&self) -> usize {
        self.centre.len()
    }

    /// Half the width of each element's range: the scale of exploration noise, and ∂action/∂tanh.
    pub fn half(&self) -> &[f32] {
        &self.half
    }

    /// Clips `a` to the range of element `element`.
    pub fn clip(&self, element: usize, a: f32) -> f32 {
        a.clamp(self.action(element, -1.0), self.action(element, 1.0))
    }

    /// The inverse of [`action`](Self::action): element `element` of an action in units of half its range, from the
    /// middle.
    pub fn unscaled(&self, element: usize, a: f32) -> f32 {
        (a - self.centre[element]) / self.half[element]
    }

    /// The value of element `element` of an action for the tanh output `t`. It is within the space's bounds,
    /// whatever the rounding.
    pub fn action(&self, element: usize, t: f32) -> f32 {
        (self.centre[element] + self.half[element] * t).clamp(self.low[element], self.high[element])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_does_not_take_an_action_out_of_its_bounds() {
        let ranges = [(0.05, 0.45), (0.1, 1.0), (-0.3, 0.7), (1e-3, 3.3), (-0.1, 1.1)];
        let range = ActionRange::new(&Space::boxed(&ranges)).unwrap();
        for (element, (low, high)) in ranges.into_iter().enumerate() {
            for t in [-1.0, -0.999_999_94, 0.999_999_94, 1.0] {
                let (action, clipped) = (range.action(element, t), range.clip(element, t * f32::MAX));
                assert!((low..=high).contains(&action), "{action} in {low} ..= {high}");
                assert!((low..=high).contains(&clipped), "{clipped} in {low} ..= {high}");
            }
        }
        assert!(range.action(0, f32::NAN).is_nan(), "what diverges is not hidden");
        assert!((range.unscaled(1, range.action(1, 0.25)) - 0.25).abs() < 1e-6);
    }

    #[test]
    fn spaces_without_a_finite_range_are_refused() {
        assert_eq!(
            ActionRange::new(&Space::discrete(4)),
            Err(ActionRangeError::Discrete { n: 4 })
        );
        assert_eq!(ActionRange::new(&Space::boxed(&[])), Err(ActionRangeError::Empty));
        for (low, high) in [
            (0.0, f32::INFINITY),
            (f32::NEG_INFINITY, 0.0),
            (f32::NAN, 1.0),
            (1.0, 1.0),
            (2.0, 1.0),
        ] {
            let space = Space::boxed(&[(-1.0, 1.0), (low, high)]);
            assert!(matches!(
                ActionRange::new(&space),
                Err(ActionRangeError::Bounds { element: 1, .. })
            ));
        }
    }
}
