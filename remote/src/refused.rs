//! What the network engine notes about connections that it refuses. It does so in its own words, and once for each
//! attempt. The gate logs it in ours, and not more often than it logs other warnings.

use std::fmt::{Debug, Write};
use std::sync::{Mutex, PoisonError};

use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::{Event, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

/// Why the last connection was refused, since [`take`] was last called.
static LAST: Mutex<Option<String>> = Mutex::new(None);

/// The part of a program's log that listens to the network engine.
pub fn layer<S: Subscriber + for<'a> LookupSpan<'a>>() -> impl Layer<S> {
    let of_engine = Targets::new().with_target("zenoh_link_tls", LevelFilter::WARN);
    Refused.with_filter(of_engine)
}

/// Why a connection was refused, if one was since the last call.
pub(crate) fn take() -> Option<String> {
    LAST.lock().unwrap_or_else(PoisonError::into_inner).take()
}

struct Refused;

impl<S: Subscriber> Layer<S> for Refused {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut message = Message::default();
        event.record(&mut message);
        // The engine suspects a lack of descriptors behind every refusal.
        let why = message.0.split(". Hint").next().unwrap_or_default().to_owned();
        *LAST.lock().unwrap_or_else(PoisonError::into_inner) = Some(why);
    }
}

#[derive(Default)]
struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" {
            // Writing to a string does not fail.
            let _ = write!(self.0, "{value:?}");
        }
    }
}
