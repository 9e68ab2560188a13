//! The newest policy, for the hosts that ask for it.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use shoal_common::channel::policy::{PolicyReader, PublishedPolicy};
use zenoh::Wait;
use zenoh::query::Query;

use super::GateError;
use super::host::Host;
use crate::rate_limiter::RateLimiter;
use crate::wire::{PolicyId, WirePolicy};

/// How long a query for a policy is kept before the host has to ask again.
const TIMEOUT: Duration = Duration::from_secs(8);

/// The learner's policies on their way to the hosts.
pub(super) struct Policies {
    reader: PolicyReader,
    /// The policy that was sent last, as bytes.
    encoded: Option<(PolicyId, Arc<Vec<u8>>)>,
    limiter: RateLimiter,
    /// Version of the newest policy that was read.
    version: u64,
}

impl Policies {
    /// Sends at most `bandwidth` bytes a second.
    pub(super) fn new(reader: PolicyReader, bandwidth: f64) -> Self {
        Self {
            reader,
            encoded: None,
            limiter: RateLimiter::new(bandwidth, Instant::now()),
            version: 0,
        }
    }

    /// Version of the newest policy that was read from the learner.
    pub(super) fn version(&self) -> u64 {
        self.version
    }

    /// Takes the newest policy, as often as an actor does, so that none is held long after its learner has died.
    pub(super) fn refresh(&mut self) -> Result<(), GateError> {
        if let Some(newest) = self.reader.latest()? {
            self.version = newest.header().version;
        }
        Ok(())
    }

    /// Sends the newest policy to the hosts that ask for one and do not have it.
    pub(super) fn send(&mut self, hosts: &mut HashMap<u64, Host>) -> Result<(), GateError> {
        for host in hosts.values_mut() {
            drop(host.policy_query.take_if(|(.., since)| since.elapsed() >= TIMEOUT));
        }
        if hosts.values().all(|host| host.policy_query.is_none()) {
            return Ok(());
        }
        let Some(newest) = self.reader.latest()? else {
            return Ok(());
        };
        self.version = newest.header().version;
        let id = PolicyId::from(newest.header());
        // The host that has waited longest comes first. Otherwise a host that asks again at once could keep the others
        // waiting.
        let waiting = hosts.values_mut().filter_map(|host| {
            let (_, have, since) = host.policy_query.as_ref()?;
            (Some(id) != *have).then_some((*since, host))
        });
        let mut waiting: Vec<_> = waiting.collect();
        waiting.sort_by_key(|(since, _)| *since);
        for (_, host) in waiting {
            let bytes = encoded(&mut self.encoded, &newest);
            if !self.limiter.take(bytes.len() as f64, Instant::now()) {
                break;
            }
            if let Some((query, ..)) = host.policy_query.take() {
                answer(query, bytes)?;
            }
        }
        Ok(())
    }
}

/// Sends a policy from a thread of its own: a host with a slow connection must not delay the others. A host has one
/// query at a time, so there is at most one thread for each.
fn answer(query: Query, bytes: Arc<Vec<u8>>) -> Result<(), GateError> {
    let send = move || {
        let key = query.key_expr().clone();
        let sent = query.reply(key, bytes.as_slice()).wait();
        if let Err(cause) = sent {
            tracing::debug!("a policy did not arrive: {cause}");
        }
    };
    std::thread::Builder::new().name("policy".into()).spawn(send)?;
    Ok(())
}

fn encoded(cache: &mut Option<(PolicyId, Arc<Vec<u8>>)>, newest: &PublishedPolicy) -> Arc<Vec<u8>> {
    let id = PolicyId::from(newest.header());
    if let Some((_, bytes)) = cache.as_ref().filter(|(cached, _)| *cached == id) {
        return bytes.clone();
    }
    let bytes = Arc::new(WirePolicy::encode(newest.header(), newest.parameters()));
    *cache = Some((id, bytes.clone()));
    bytes
}
