//! `[remote]`.

use shoal_base::section;
use shoal_base::section::{Change, above, from};

section! {
    /// Actors on other hosts.
    pub struct RemoteConfig {
        /// Bytes of policies that are sent in a second, to all hosts together. Smaller values leave more of the network
        /// to transitions; actors then use older policies.
        policy_bandwidth: f64 = 30e6, bounds: above(0.0, 1e12), unit: "bytes/s", source: "ours",
            change: Change::Anytime;
        /// How long a host may be silent before its actors are free for other hosts. If it comes back later, it
        /// continues if no other host has used them, and otherwise joins again.
        lost_seconds: f64 = 60.0, bounds: from(5.0, 86_400.0), unit: "s", source: "ours", change: Change::Anytime;
    }
}
