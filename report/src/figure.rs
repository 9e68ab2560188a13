//! The figures of a run as SVG files, which can be converted to PNG.

mod canvas;
mod comparison;
mod episode;
mod lake;
mod learning_curve;
mod learning_curves;
mod lines;
mod panel;
mod pendulum;
mod point_mass;
mod raster;

pub use comparison::{Agent, compare_actions, compare_paths};
pub use episode::episode;
pub use lake::lake;
pub use learning_curve::learning_curve;
pub use learning_curves::{learning_curves, quantile};
pub use lines::{CurvesOfSetting, DiagramAxes, lines, lines_by_setting, pointwise};
pub use pendulum::swing_up;
pub use point_mass::{test_runs, trajectories};
pub use raster::{CAN_RASTERISE, rasterise};
