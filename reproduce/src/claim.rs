//! Claims of the thesis, and whether they hold here.

use std::fmt::{self, Display};

use super::experiment::Effort;

/// A claim of the thesis, checked against results.
#[derive(Clone, Debug)]
pub(super) struct Claim {
    /// In the thesis's words, or close to them.
    pub(super) statement: &'static str,
    /// The condition under which the claim holds.
    pub(super) criterion: &'static str,
    /// What was measured.
    pub(super) measured: String,
    check: Check,
}

/// Whether a claim holds.
#[derive(Clone, Debug)]
enum Check {
    /// For each seed that could be checked. The claim holds if it holds for more than half of them.
    EachSeed(Vec<bool>),
    /// For all seeds together, by a mean, a median or a count; `None` if results are missing.
    Together(Option<bool>),
}

/// What the report says of a claim.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// It was a quick look, or results are missing.
    NotChecked,
    /// It holds for more than half of the seeds.
    Holds {
        seeds: usize,
        held: usize,
    },
    Fails {
        seeds: usize,
        held: usize,
    },
    /// It holds for the seeds together.
    HoldsTogether,
    FailsTogether,
}

impl Claim {
    /// A claim that is checked for each seed separately. `held` has a value for each seed that could be checked.
    pub(super) fn each_seed(
        statement: &'static str,
        criterion: &'static str,
        measured: String,
        held: impl IntoIterator<Item = bool>,
    ) -> Self {
        Self {
            statement,
            criterion,
            measured,
            check: Check::EachSeed(held.into_iter().collect()),
        }
    }

    /// A claim that is checked for all seeds together; `held` is `None` if results are missing.
    pub(super) fn together(
        statement: &'static str,
        criterion: &'static str,
        measured: String,
        held: Option<bool>,
    ) -> Self {
        Self {
            statement,
            criterion,
            measured,
            check: Check::Together(held),
        }
    }

    pub(super) fn verdict(&self, effort: Effort) -> Verdict {
        if effort == Effort::Quick {
            return Verdict::NotChecked;
        }
        match &self.check {
            Check::Together(None) => Verdict::NotChecked,
            Check::Together(Some(true)) => Verdict::HoldsTogether,
            Check::Together(Some(false)) => Verdict::FailsTogether,
            Check::EachSeed(each) => {
                let (seeds, held) = (each.len(), each.iter().filter(|held| **held).count());
                if seeds == 0 {
                    Verdict::NotChecked
                } else if 2 * held > seeds {
                    Verdict::Holds { seeds, held }
                } else {
                    Verdict::Fails { seeds, held }
                }
            }
        }
    }

    /// Whether the claim holds: for each seed that could be checked, or once for all seeds together.
    #[cfg(test)]
    pub(super) fn held(&self) -> Vec<bool> {
        match &self.check {
            Check::EachSeed(held) => held.clone(),
            Check::Together(held) => held.iter().copied().collect(),
        }
    }
}

impl Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotChecked => write!(f, "not checked"),
            Self::HoldsTogether => write!(f, "**holds**"),
            Self::FailsTogether => write!(f, "**does not hold**"),
            Self::Holds { seeds: 1, .. } => write!(f, "**holds** for the only seed"),
            Self::Fails { seeds: 1, .. } => write!(f, "**does not hold** for the only seed"),
            Self::Holds { seeds, held } if seeds == held => write!(f, "**holds** for all {seeds} seeds"),
            Self::Holds { seeds, held } => write!(f, "**holds** for {held} of {seeds} seeds"),
            Self::Fails { seeds, held } => write!(f, "**does not hold**; true for {held} of {seeds} seeds"),
        }
    }
}

/// Formats the values of several seeds as "median [minimum, maximum]", and a single value alone.
pub(super) fn spread(values: impl IntoIterator<Item = f64>, decimals: usize) -> String {
    let mut values: Vec<f64> = values.into_iter().collect();
    values.sort_by(f64::total_cmp);
    let (Some(minimum), Some(maximum)) = (values.first(), values.last()) else {
        return "—".into();
    };
    let format = |value: f64| {
        let text = format!("{value:.decimals$}");
        match text.strip_prefix('-') {
            Some(zero) if zero.chars().all(|c| matches!(c, '0' | '.')) => zero.to_owned(),
            Some(size) => format!("\u{2212}{size}"),
            None => text,
        }
    };
    if values.len() == 1 {
        return format(*minimum);
    }
    format!(
        "{} [{}, {}]",
        format(median(&values)),
        format(*minimum),
        format(*maximum)
    )
}

/// The median of sorted values. There must be at least one. Unlike `shoal_report::figure::quantile`, this computes no
/// difference, which would be NaN for two infinite values.
pub(super) fn median(sorted: &[f64]) -> f64 {
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 {
        sorted[middle]
    } else {
        (sorted[middle - 1] + sorted[middle]) / 2.0
    }
}

/// Formats a share, such as 0.97, as "97 %".
pub(super) fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn claim(held: &[bool]) -> Claim {
        Claim::each_seed("it works", "it does", String::new(), held.iter().copied())
    }

    #[test]
    fn a_claim_holds_if_it_holds_for_more_than_half_of_the_seeds() {
        let verdict = |held: &[bool]| claim(held).verdict(Effort::Full);
        assert_eq!(verdict(&[true, true, false]), Verdict::Holds { seeds: 3, held: 2 });
        assert_eq!(verdict(&[true, false]), Verdict::Fails { seeds: 2, held: 1 });
        assert_eq!(verdict(&[]), Verdict::NotChecked);
        let together = |held| Claim::together("it works", "it does", String::new(), Some(held));
        assert_eq!(together(true).verdict(Effort::Full).to_string(), "**holds**");
        assert_eq!(together(false).verdict(Effort::Full), Verdict::FailsTogether);
        assert_eq!(together(true).verdict(Effort::Quick), Verdict::NotChecked);
        assert_eq!(claim(&[true]).verdict(Effort::Quick), Verdict::NotChecked);
        assert_eq!(verdict(&[true; 5]).to_string(), "**holds** for all 5 seeds");
        assert_eq!(verdict(&[false]).to_string(), "**does not hold** for the only seed");
        assert_eq!(
            verdict(&[false, false, true]).to_string(),
            "**does not hold**; true for 1 of 3 seeds"
        );
    }

    #[test]
    fn a_spread_is_median_minimum_and_maximum() {
        assert_eq!(
            spread([-150.0, -140.04, -160.0], 1),
            "\u{2212}150.0 [\u{2212}160.0, \u{2212}140.0]"
        );
        assert_eq!(spread([1.0, 2.0], 2), "1.50 [1.00, 2.00]");
        assert_eq!(spread([-0.001], 1), "0.0");
        assert_eq!(spread([], 1), "—");
    }
}
