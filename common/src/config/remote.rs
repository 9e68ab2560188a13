//! `[remote]`.

use shoal_base::section;
use shoal_base::section::{Change, above};

section! {
    /// Actors on other hosts.
    pub struct RemoteConfig {
        /// Bytes of policies that are sent in a second, to all hosts together. Smaller values leave more of the network
        /// to transitions; actors then use older policies.
        policy_bandwidth: f64 = 30e6, bounds: above(0.0, 1e12), unit: "bytes/s", source: "ours",
            change: Change::Anytime;
    }
}
