//! Output made from runs: figures, the self-contained HTML report, and policies exported for other programs.

pub mod export;
pub mod figure;
pub mod film;
pub mod page;
pub mod plots;
