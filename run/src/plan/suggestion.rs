//! "Did you mean": the known word nearest to a mistyped one.

use strsim::damerau_levenshtein;

/// The candidate that differs from `word` by the fewest letters, if these are few.
pub(super) fn nearest<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let word = word.to_lowercase();
    let most = (word.chars().count() / 3).max(1);
    let distance = |candidate: &'a str| (damerau_levenshtein(&word, &candidate.to_lowercase()), candidate);
    let (least, nearest) = candidates
        .into_iter()
        .map(distance)
        .min_by_key(|(distance, _)| *distance)?;
    (least <= most).then_some(nearest)
}

/// The message with a suggestion, if it is serde's about an unknown word. Such a message names the word and the known
/// words between backticks.
pub(super) fn with_suggestion(message: String) -> String {
    let unknown = ["unknown field `", "unknown variant `"];
    let Some(start) = unknown.iter().find_map(|words| message.find(words)) else {
        return message;
    };
    let mut words = message[start..].split('`').skip(1).step_by(2);
    let known = words.next().and_then(|word| nearest(word, words));
    match known.map(str::to_owned) {
        Some(known) => format!("{message}; did you mean `{known}`?"),
        None => message,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_word_is_suggested_if_it_is_near() {
        let presets = ["pendulum", "point-mass-r1", "cart-pole"];
        assert_eq!(nearest("pendulums", presets), Some("pendulum"));
        assert_eq!(nearest("Pendulum", presets), Some("pendulum"));
        assert_eq!(nearest("cartpole", presets), Some("cart-pole"));
        assert_eq!(nearest("pnedulum", presets), Some("pendulum"));
        assert_eq!(nearest("walker", presets), None);
        assert_eq!(nearest("x", []), None);
    }

    #[test]
    fn an_unknown_field_is_compared_with_the_expected_ones() {
        let message = "ddpg.gama = 0.9: unknown field `gama`, expected one of `hidden`, `gamma`";
        assert_eq!(
            with_suggestion(message.into()),
            format!("{message}; did you mean `gamma`?")
        );
        let far = "unknown variant `sigmoid`, expected `relu` or `tanh`";
        assert_eq!(with_suggestion(far.into()), far);
        assert_eq!(
            with_suggestion("ddpg.gamma = 2: must be from 0 to 1".into()),
            "ddpg.gamma = 2: must be from 0 to 1"
        );
    }
}
