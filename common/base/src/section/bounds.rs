//! Bounds of the numbers in a configuration.

use std::fmt::{self, Display, Formatter};

/// The least and the greatest value of a number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds<T> {
    low: T,
    high: T,
    /// Whether `low` itself is excluded.
    open: bool,
}

/// A value outside its bounds.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{key} = {value}: must be {expected}")]
pub struct OutOfRange {
    /// The key, with its section.
    pub key: String,
    /// The value found.
    pub value: String,
    /// The accepted values, in words.
    pub expected: String,
}

/// From `low` to `high`, both included.
pub const fn from<T>(low: T, high: T) -> Bounds<T> {
    Bounds { low, high, open: false }
}

/// Above `low` and at most `high`.
pub const fn above<T>(low: T, high: T) -> Bounds<T> {
    Bounds { low, high, open: true }
}

impl<T: Display> Display for Bounds<T> {
    fn fmt(&self, to: &mut Formatter<'_>) -> fmt::Result {
        let Self { low, high, open } = self;
        if *open {
            write!(to, "above {low} and at most {high}")
        } else {
            write!(to, "from {low} to {high}")
        }
    }
}

impl<T: PartialOrd + Display> Bounds<T> {
    /// Checks that `value`, the value of `key`, is within the bounds.
    ///
    /// # Errors
    /// When it is outside or NaN.
    pub fn check(&self, key: impl Into<String>, value: &T) -> Result<(), OutOfRange> {
        let enough = if self.open {
            self.low < *value
        } else {
            self.low <= *value
        };
        if enough && *value <= self.high {
            return Ok(());
        }
        Err(OutOfRange {
            key: key.into(),
            value: value.to_string(),
            expected: self.to_string(),
        })
    }
}

/// A value that can have bounds: a number, a list of numbers, or an optional number.
pub trait Bounded {
    /// The type of the numbers.
    type Number;

    /// Checks that every number is within the bounds.
    ///
    /// # Errors
    /// For the first number that is not.
    fn check(&self, section: &str, key: &str, bounds: &Bounds<Self::Number>) -> Result<(), OutOfRange>;
}

/// The bounds of a value of type `T` in words: `from 0 to 1`.
pub fn in_words<T: Bounded<Number: Display>>(bounds: &Bounds<T::Number>) -> String {
    bounds.to_string()
}

macro_rules! bounded_numbers {
    ($($number:ty)*) => {$(
        impl Bounded for $number {
            type Number = Self;

            fn check(&self, section: &str, key: &str, bounds: &Bounds<Self>) -> Result<(), OutOfRange> {
                bounds.check(format!("{section}.{key}"), self)
            }
        }
    )*};
}
bounded_numbers!(f64 u32 u64 usize);

impl<T: Bounded> Bounded for [T] {
    type Number = T::Number;

    fn check(&self, section: &str, key: &str, bounds: &Bounds<T::Number>) -> Result<(), OutOfRange> {
        let mut all = self.iter().enumerate();
        all.try_for_each(|(index, number)| number.check(section, &format!("{key}[{index}]"), bounds))
    }
}

impl<T: Bounded> Bounded for Option<T> {
    type Number = T::Number;

    fn check(&self, section: &str, key: &str, bounds: &Bounds<T::Number>) -> Result<(), OutOfRange> {
        self.iter().try_for_each(|number| number.check(section, key, bounds))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_out_of_bounds_is_refused_with_its_key_and_bounds() {
        let line = |checked: Result<(), OutOfRange>| checked.unwrap_err().to_string();
        assert_eq!(line(from(1, 8_u32).check("a.b", &9)), "a.b = 9: must be from 1 to 8");
        let rate = above(0.0, 1.0);
        assert_eq!(line(rate.check("a.b", &0.0)), "a.b = 0: must be above 0 and at most 1");
        assert!(line(rate.check("a.b", &f64::NAN)).starts_with("a.b = NaN"));
        assert!(rate.check("a.b", &5e-324).is_ok() && rate.check("a.b", &1.0).is_ok());
        assert_eq!(
            line([1_usize, 0].check("a", "b", &from(1, 4))),
            "a.b[1] = 0: must be from 1 to 4"
        );
        assert!(None::<u64>.check("a", "b", &from(1, 4)).is_ok());
    }
}
