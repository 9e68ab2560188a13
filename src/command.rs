//! The commands of `shoal`, one file each, and what several of them share.

pub(crate) mod bench;
pub(crate) mod completions;
pub(crate) mod detach;
pub(crate) mod eval;
pub(crate) mod export;
pub(crate) mod film;
mod help_config;
pub(crate) mod join;
pub(crate) mod list;
mod listen;
pub(crate) mod man;
mod output_file;
pub(crate) mod plot;
pub(crate) mod report;
pub(crate) mod reproduce;
pub(crate) mod resume;
pub(crate) mod rm;
pub(crate) mod scale;
pub(crate) mod status;
pub(crate) mod stop;
mod suite;
pub(crate) mod top;
pub(crate) mod track;
pub(crate) mod train;
mod training;
