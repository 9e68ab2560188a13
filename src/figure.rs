//! The pictures of a run, as SVG files.

mod canvas;
mod learning_curve;
mod panel;
mod pendulum;
mod point_mass;

pub(crate) use learning_curve::learning_curve;
pub(crate) use pendulum::swing_up;
pub(crate) use point_mass::{TestRun, test_runs, trajectories};
