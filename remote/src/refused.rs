//! Connections that Zenoh refuses. Zenoh logs each attempt in its own words. The gate logs them in Shoal's, and not
//! more often than other warnings.

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

/// The layer of a program's log that takes Zenoh's warnings.
pub fn layer<S: Subscriber + for<'a> LookupSpan<'a>>() -> impl Layer<S> {
    let of_zenoh = Targets::new().with_target("zenoh_link_tls", LevelFilter::WARN);
    Refused.with_filter(of_zenoh)
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
        // Zenoh adds a hint about file descriptors to every refusal, which does not apply here.
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
