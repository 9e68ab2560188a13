//! Numbers as people read them.

/// With a comma after each three digits.
pub fn thousands(number: u64) -> String {
    indicatif::HumanCount(number).to_string()
}
