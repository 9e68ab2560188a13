//! Numbers formatted for reading.

/// The number with commas between thousands.
pub fn thousands(number: u64) -> String {
    indicatif::HumanCount(number).to_string()
}
