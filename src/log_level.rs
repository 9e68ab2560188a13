//! How much the processes of a run log.

use tracing_subscriber::filter::LevelFilter;

/// The level in the environment variable `SHOAL_LOG`, by default `info`; `debug` logs every chunk that is sent.
pub(crate) fn log_level() -> LevelFilter {
    let level = std::env::var("SHOAL_LOG").ok().and_then(|level| level.parse().ok());
    level.unwrap_or(LevelFilter::INFO)
}
