//! What there is to see and to take along of runs: figures, the page that can be sent, and policies for other programs.

pub mod export;
pub mod figure;
pub mod page;
pub mod plots;
