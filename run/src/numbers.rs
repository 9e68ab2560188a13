//! Numbers as people read and write them.

/// The number with commas between thousands.
pub fn thousands(number: u64) -> String {
    indicatif::HumanCount(number).to_string()
}

/// An amount of memory in MiB, with one decimal.
pub fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20))
}

/// 2⁵³: a 64-bit float represents every whole number up to it.
const EXACT: f64 = 9_007_199_254_740_992.0;

/// A count as people write it: `120000`, `120_000`, `1e5`, `1.5e6`, `30k` or `1M`.
///
/// # Errors
/// When the text is not a whole number from 0 to 2^64 − 1.
pub fn parse_count(text: &str) -> Result<u64, String> {
    let refused = || format!("{text} is not a whole number, such as 1000, 1e5, 30k or 1M");
    let plain = text.replace('_', "");
    if let Ok(number) = plain.parse() {
        return Ok(number);
    }
    let (mantissa, exponent) = match plain.strip_suffix(['k', 'K']) {
        Some(thousands) => (thousands, "e3"),
        None => plain
            .strip_suffix('M')
            .map_or((plain.as_str(), ""), |millions| (millions, "e6")),
    };
    let is_number = |c: char| c.is_ascii_digit() || c == '.' || (exponent.is_empty() && "eE+-".contains(c));
    if !mantissa.starts_with(|c: char| c.is_ascii_digit()) || !mantissa.chars().all(is_number) {
        return Err(refused());
    }
    let number: f64 = format!("{mantissa}{exponent}").parse().map_err(|_| refused())?;
    if number.fract() != 0.0 || number > EXACT {
        return Err(refused());
    }
    Ok(number as u64)
}

/// A count that fits into 32 bits.
///
/// # Errors
/// When the text is not a whole number from 0 to 2^32 − 1.
pub fn parse_small_count(text: &str) -> Result<u32, String> {
    u32::try_from(parse_count(text)?).map_err(|_| format!("{text} is too large: at most {}", u32::MAX))
}

/// A count of 32 bits that is not 0.
///
/// # Errors
/// When the text is not a whole number from 1 to 2^32 − 1.
pub fn parse_positive_count(text: &str) -> Result<u32, String> {
    match parse_small_count(text)? {
        0 => Err("0 is too small: at least 1".into()),
        number => Ok(number),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_read_as_people_write_them() {
        for (text, number) in [
            ("0", 0),
            ("120000", 120_000),
            ("120_000", 120_000),
            ("1e5", 100_000),
            ("1E5", 100_000),
            ("1.5e6", 1_500_000),
            ("30k", 30_000),
            ("1.001K", 1_001),
            ("1M", 1_000_000),
            ("2.0", 2),
            ("18446744073709551615", u64::MAX),
        ] {
            assert_eq!(parse_count(text), Ok(number), "{text}");
        }
        for text in [
            "", "1.5", "1e-3", "-1", "1e3k", "k", "1e30", "1m", "inf", "nan", "0x10", "1 k", "e5",
        ] {
            let refused = parse_count(text).unwrap_err();
            assert!(
                refused.contains("not a whole number") && !refused.contains('\n'),
                "{refused}"
            );
        }
        assert_eq!(parse_small_count("5k"), Ok(5_000));
        assert!(parse_small_count("1e10").is_err());
    }
}
