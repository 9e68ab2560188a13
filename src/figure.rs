//! The pictures of a run, as SVG files, and the same as PNG files.

mod canvas;
mod comparison;
mod lake;
mod learning_curve;
mod learning_curves;
mod lines;
mod panel;
mod pendulum;
mod point_mass;
mod raster;

pub(crate) use comparison::{Agent, actions_beside, paths_beside};
pub(crate) use lake::lake;
pub(crate) use learning_curve::learning_curve;
pub(crate) use learning_curves::{learning_curves, quantile};
pub(crate) use lines::{Frame, Setting, lines, lines_apart, pointwise};
pub(crate) use pendulum::swing_up;
pub(crate) use point_mass::{test_runs, trajectories};
pub(crate) use raster::rasterise;
