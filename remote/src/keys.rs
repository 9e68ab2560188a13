//! The keys of a run: a certificate for its gate and one for all hosts that join, both signed by an authority that
//! exists only while they are made. A host trusts nobody but the gate, and the gate nobody but hosts with the run's
//! key.

use std::time::{Duration, SystemTime};

use rcgen::{
    BasicConstraints, CertificateParams, CertifiedIssuer, DnType, ExtendedKeyUsagePurpose, IsCa, KeyPair,
    KeyUsagePurpose, date_time_ymd,
};

use crate::files::KeyFile;

/// The common name in the certificate of the hosts. The gate's access rules name it.
pub(crate) const HOST: &str = "shoal host";

/// How long keys are valid.
pub const VALIDITY: Duration = Duration::from_secs(366 * 24 * 3600);

/// Keys cannot be made.
#[derive(Debug, thiserror::Error)]
#[error("cannot make keys: {0}")]
pub struct KeyError(#[from] rcgen::Error);

/// The keys of a run.
#[derive(Clone, Debug)]
pub struct Keys {
    /// For the gate alone.
    pub gate: KeyFile,
    /// For the hosts that join.
    pub join: KeyFile,
}

/// Makes the keys of run `run_id`. They are valid at least until `end`, and at most a day longer.
///
/// # Errors
/// When the system gives no random numbers.
pub fn make(run_id: &str, end: SystemTime) -> Result<Keys, KeyError> {
    let (year, month, day) = date(end + Duration::from_secs(24 * 3600));
    let valid_until = date_time_ymd(year, month, day);
    let mut authority = CertificateParams::default();
    authority.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    authority.key_usages = vec![KeyUsagePurpose::KeyCertSign];
    authority
        .distinguished_name
        .push(DnType::CommonName, format!("shoal run {run_id}"));
    authority.not_after = valid_until;
    let authority = CertifiedIssuer::self_signed(authority, KeyPair::generate()?)?;
    let signed = |name: &str, purpose| -> Result<KeyFile, KeyError> {
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, name);
        // So a host cannot pass for the gate.
        params.extended_key_usages = vec![purpose];
        params.not_after = valid_until;
        let key = KeyPair::generate()?;
        let certificate = params.signed_by(&key, &authority)?;
        Ok(KeyFile::new(
            run_id.into(),
            authority.pem(),
            certificate.pem(),
            key.serialize_pem(),
        ))
    };
    Ok(Keys {
        gate: signed("shoal gate", ExtendedKeyUsagePurpose::ServerAuth)?,
        join: signed(HOST, ExtendedKeyUsagePurpose::ClientAuth)?,
    })
}

/// Year, month and day of a time, in UTC.
fn date(time: SystemTime) -> (i32, u8, u8) {
    let since = time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let mut days = since.as_secs() / (24 * 3600);
    let mut year = 1970;
    let is_leap = |year: i32| (year % 4 == 0 && year % 100 != 0) || year % 400 == 0;
    let length = |year| if is_leap(year) { 366 } else { 365 };
    while days >= length(year) {
        days -= length(year);
        year += 1;
    }
    let february = if is_leap(year) { 29 } else { 28 };
    let mut month = 1;
    for length in [31, february, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31] {
        if days < length {
            break;
        }
        days -= length;
        month += 1;
    }
    (year, month, days as u8 + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_becomes_a_date() {
        let day = |days: u64| date(SystemTime::UNIX_EPOCH + Duration::from_secs(days * 24 * 3600));
        assert_eq!(day(0), (1970, 1, 1));
        assert_eq!(day(59), (1970, 3, 1));
        assert_eq!(day(19_782), (2024, 2, 29));
        assert_eq!(day(19_783), (2024, 3, 1));
        assert_eq!(day(20_820), (2027, 1, 2));
    }
}
