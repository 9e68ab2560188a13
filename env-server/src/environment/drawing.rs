//! What an environment looks like: shapes in its own units.

use serde::{Deserialize, Serialize};

/// A point (x, y); y grows upwards.
pub type Point = [f64; 2];

/// A picture of a state, as a list of shapes in the environment's units. Later shapes lie above earlier ones. A shape
/// with a number that is not finite is left out.
///
/// ```
/// use shoal_env_server::environment::{Class, Drawing};
///
/// let pendulum = Drawing::new([-1.6, -1.6], [1.6, 1.6])
///     .circle(Class::Guide, [0.0, 0.0], 1.0)
///     .line(Class::Rod, &[[0.0, 0.0], [0.6, 0.8]])
///     .circle(Class::Body, [0.6, 0.8], 0.11);
/// assert_eq!(pendulum.shapes.len(), 3);
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Drawing {
    /// What is seen: the least x and y, then the greatest. The scale of both axes is the same.
    pub view: [f64; 4],
    /// The shapes, from back to front.
    pub shapes: Vec<Shape>,
    /// A point whose path is drawn from the episode's beginning on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trail: Option<Point>,
}

/// A shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    /// What it is, which decides its colour.
    pub class: Class,
    /// Where it is.
    #[serde(flatten)]
    pub form: Form,
}

/// What a shape is. It decides colour and width, in light and in dark.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Class {
    /// An outline that helps to see: a grid, a circle of reference.
    Guide,
    /// The outline of what limits the movement: walls, a track.
    Wall,
    /// A thick line: a rod, a pole, a leg.
    Rod,
    /// An outline in the colour of actions.
    Force,
    /// An outline in the colour of success.
    Goal,
    /// Filled: what moves.
    Body,
    /// Filled, in the colour of text: joints, wheels.
    Joint,
    /// Filled, pale, with an outline: ground, vehicles.
    Ground,
    /// Filled: a place to avoid.
    Hazard,
    /// Filled: a place to reach.
    Target,
}

/// The geometry of a shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Form {
    /// Straight lines through these points.
    Line(Vec<Point>),
    /// Centre x, y, and radius.
    Circle([f64; 3]),
    /// The least x and y, then the greatest.
    Rectangle([f64; 4]),
    /// Tail x, y, then the tip. It is not drawn if it is too short to be seen.
    Arrow([f64; 4]),
    /// Words that begin at x, y. The report shows them, a film does not.
    Text(f64, f64, String),
}

impl Drawing {
    /// Nothing yet, in a view from its least to its greatest corner.
    pub fn new(least: Point, greatest: Point) -> Self {
        Self {
            view: [least[0], least[1], greatest[0], greatest[1]],
            shapes: Vec::new(),
            trail: None,
        }
    }

    /// With straight lines through these points.
    #[must_use]
    pub fn line(self, class: Class, points: &[Point]) -> Self {
        self.with(class, Form::Line(points.to_vec()))
    }

    /// With a circle.
    #[must_use]
    pub fn circle(self, class: Class, [x, y]: Point, radius: f64) -> Self {
        self.with(class, Form::Circle([x, y, radius]))
    }

    /// With a rectangle, from its least to its greatest corner.
    #[must_use]
    pub fn rectangle(self, class: Class, least: Point, greatest: Point) -> Self {
        let corners = [least[0], least[1], greatest[0], greatest[1]];
        self.with(class, Form::Rectangle(corners))
    }

    /// With an arrow.
    #[must_use]
    pub fn arrow(self, class: Class, tail: Point, tip: Point) -> Self {
        self.with(class, Form::Arrow([tail[0], tail[1], tip[0], tip[1]]))
    }

    /// With words that begin at a point.
    #[must_use]
    pub fn text(self, [x, y]: Point, words: &str) -> Self {
        self.with(Class::Guide, Form::Text(x, y, words.into()))
    }

    /// With the path of this point since the episode's beginning.
    #[must_use]
    pub fn trail(mut self, point: Point) -> Self {
        self.trail = Some(point).filter(|point| point.iter().all(|number| number.is_finite()));
        self
    }

    fn with(mut self, class: Class, form: Form) -> Self {
        if form.is_finite() {
            self.shapes.push(Shape { class, form });
        }
        self
    }
}

impl Form {
    fn is_finite(&self) -> bool {
        let all = |numbers: &[f64]| numbers.iter().all(|number| number.is_finite());
        match self {
            Self::Line(points) => points.iter().all(|point| all(point)),
            Self::Circle(numbers) => all(numbers),
            Self::Rectangle(numbers) | Self::Arrow(numbers) => all(numbers),
            Self::Text(x, y, _) => all(&[*x, *y]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drawing_is_short_json_that_reads_back_and_has_only_finite_numbers() {
        let drawing = Drawing::new([0.0, -1.0], [2.0, 1.0])
            .line(Class::Rod, &[[0.0, 0.5], [1.0, -0.5]])
            .circle(Class::Body, [f64::NAN, 0.0], 1.0)
            .circle(Class::Hazard, [1.0, 0.0], 0.25)
            .arrow(Class::Force, [0.0, 0.0], [1.0, 0.0])
            .text([0.0, 0.0], "goal")
            .trail([f64::INFINITY, 0.0]);
        let text = serde_json::to_string(&drawing).unwrap();
        assert_eq!(
            text,
            r#"{"view":[0.0,-1.0,2.0,1.0],"shapes":[{"class":"rod","line":[[0.0,0.5],[1.0,-0.5]]},"#.to_owned()
                + r#"{"class":"hazard","circle":[1.0,0.0,0.25]},{"class":"force","arrow":[0.0,0.0,1.0,0.0]},"#
                + r#"{"class":"guide","text":[0.0,0.0,"goal"]}]}"#
        );
        assert_eq!(serde_json::from_str::<Drawing>(&text).unwrap(), drawing);
    }
}
