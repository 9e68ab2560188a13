//! What the thesis claims, and whether it holds here.

use std::fmt::{self, Display};

use super::experiment::Effort;

/// A claim, checked seed by seed.
#[derive(Clone, Debug)]
pub(super) struct Claim {
    /// In the thesis's words, or close to them.
    pub(super) thesis: &'static str,
    /// When it counts as holding for a seed.
    pub(super) criterion: &'static str,
    /// What was measured.
    pub(super) ours: String,
    pub(super) scope: Scope,
    /// For each seed that could be checked, or once for all of them, whether it holds.
    pub(super) held: Vec<bool>,
}

/// What a claim is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scope {
    /// Every seed by itself; it holds when it does for more than half of them.
    EachSeed,
    /// The seeds together, by a mean, a median or a count.
    Together,
}

/// Whether a claim holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// A quick look checks nothing, and neither do results that are not there.
    NotChecked,
    /// For more than half of the seeds.
    Holds {
        of: usize,
        held: usize,
    },
    Fails {
        of: usize,
        held: usize,
    },
    /// For the seeds together.
    HoldsTogether,
    FailsTogether,
}

impl Claim {
    pub(super) fn verdict(&self, effort: Effort) -> Verdict {
        let (of, held) = (self.held.len(), self.held.iter().filter(|held| **held).count());
        match effort {
            Effort::Quick => Verdict::NotChecked,
            Effort::Full if of == 0 => Verdict::NotChecked,
            Effort::Full if self.scope == Scope::Together && held == of => Verdict::HoldsTogether,
            Effort::Full if self.scope == Scope::Together => Verdict::FailsTogether,
            Effort::Full if 2 * held > of => Verdict::Holds { of, held },
            Effort::Full => Verdict::Fails { of, held },
        }
    }
}

impl Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotChecked => write!(f, "not checked"),
            Self::HoldsTogether => write!(f, "**holds**"),
            Self::FailsTogether => write!(f, "**does not hold**"),
            Self::Holds { of: 1, .. } => write!(f, "**holds** for the only seed"),
            Self::Fails { of: 1, .. } => write!(f, "**does not hold** for the only seed"),
            Self::Holds { of, held } if of == held => write!(f, "**holds** for all {of} seeds"),
            Self::Holds { of, held } => write!(f, "**holds** for {held} of {of} seeds"),
            Self::Fails { of, held } => write!(f, "**does not hold**: for {held} of {of} seeds"),
        }
    }
}

/// Numbers of several seeds as "median [least, greatest]"; of one seed just that one.
pub(super) fn spread(values: impl IntoIterator<Item = f64>, decimals: usize) -> String {
    let mut values: Vec<f64> = values.into_iter().collect();
    values.sort_by(f64::total_cmp);
    let (Some(least), Some(greatest)) = (values.first(), values.last()) else {
        return "—".into();
    };
    let say = |value: f64| {
        let text = format!("{value:.decimals$}");
        match text.strip_prefix('-') {
            Some(zero) if zero.chars().all(|c| matches!(c, '0' | '.')) => zero.to_owned(),
            Some(size) => format!("\u{2212}{size}"),
            None => text,
        }
    };
    if values.len() == 1 {
        return say(*least);
    }
    format!("{} [{}, {}]", say(median(&values)), say(*least), say(*greatest))
}

/// Of sorted values, at least one.
pub(super) fn median(sorted: &[f64]) -> f64 {
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 {
        sorted[middle]
    } else {
        (sorted[middle - 1] + sorted[middle]) / 2.0
    }
}

/// A share as "97 %".
pub(super) fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn claim(held: &[bool]) -> Claim {
        Claim {
            thesis: "it works",
            criterion: "it does",
            ours: String::new(),
            scope: Scope::EachSeed,
            held: held.into(),
        }
    }

    #[test]
    fn more_than_half_of_the_seeds_decide() {
        let verdict = |held: &[bool]| claim(held).verdict(Effort::Full);
        assert_eq!(verdict(&[true, true, false]), Verdict::Holds { of: 3, held: 2 });
        assert_eq!(verdict(&[true, false]), Verdict::Fails { of: 2, held: 1 });
        assert_eq!(verdict(&[]), Verdict::NotChecked);
        let together = |held| Claim {
            scope: Scope::Together,
            ..claim(&[held])
        };
        assert_eq!(together(true).verdict(Effort::Full).to_string(), "**holds**");
        assert_eq!(together(false).verdict(Effort::Full), Verdict::FailsTogether);
        assert_eq!(together(true).verdict(Effort::Quick), Verdict::NotChecked);
        assert_eq!(claim(&[true]).verdict(Effort::Quick), Verdict::NotChecked);
        assert_eq!(verdict(&[true; 5]).to_string(), "**holds** for all 5 seeds");
        assert_eq!(verdict(&[false]).to_string(), "**does not hold** for the only seed");
        assert_eq!(
            verdict(&[false, false, true]).to_string(),
            "**does not hold**: for 1 of 3 seeds"
        );
    }

    #[test]
    fn a_spread_is_median_least_and_greatest() {
        assert_eq!(
            spread([-150.0, -140.04, -160.0], 1),
            "\u{2212}150.0 [\u{2212}160.0, \u{2212}140.0]"
        );
        assert_eq!(spread([1.0, 2.0], 2), "1.50 [1.00, 2.00]");
        assert_eq!(spread([-0.001], 1), "0.0");
        assert_eq!(spread([], 1), "—");
    }
}
