//! Paints an environment's drawings into pixels. Words are left out.

use shoal_env_server::environment::{Class, Drawing, Form, Point};
use shoal_env_server::frame::Image;
use tiny_skia::{Color, FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, Transform};

/// A picture is at most this many times as wide as high, or as high as wide.
const MAX_ASPECT_RATIO: f64 = 4.0;

/// The colours of the report's light page.
const PAPER: [u8; 3] = [255, 255, 255];
const INK: [u8; 3] = [29, 33, 37];
const SOFT: [u8; 3] = [84, 93, 102];
const GRID: [u8; 3] = [217, 221, 225];
const SHEET: [u8; 3] = [245, 246, 247];
const ACCENT: [u8; 3] = [0, 103, 163];
const BAD: [u8; 3] = [184, 72, 0];
const GOOD: [u8; 3] = [0, 115, 79];
const TRAIL: [u8; 3] = [143, 187, 213];
const HAZARD: [u8; 3] = [189, 195, 200];
const TARGET: [u8; 3] = [196, 227, 213];

/// How a class is painted: filled, and with an outline of this width.
struct Style {
    fill: Option<[u8; 3]>,
    stroke: Option<([u8; 3], f32)>,
}

/// Widths are parts of the picture's shorter side.
fn style(class: Class) -> Style {
    let outline = |colour, width| Style {
        fill: None,
        stroke: Some((colour, width)),
    };
    let filled = |colour| Style {
        fill: Some(colour),
        stroke: None,
    };
    let both = |fill| Style {
        fill: Some(fill),
        stroke: Some((SOFT, 0.005)),
    };
    match class {
        Class::Guide => outline(GRID, 0.005),
        Class::Wall => outline(SOFT, 0.01),
        Class::Rod => outline(INK, 0.022),
        Class::Force => outline(BAD, 0.012),
        Class::Goal => outline(GOOD, 0.014),
        Class::Body => filled(ACCENT),
        Class::Joint => filled(INK),
        Class::Ground => both(SHEET),
        Class::Hazard => both(HAZARD),
        Class::Target => both(TARGET),
    }
}

/// Paints the drawings of an episode, in their order.
pub(crate) struct Painter {
    height: u32,
    trail: Vec<Point>,
}

impl Painter {
    /// Pictures at most this many pixels high, and twice as wide.
    pub(crate) fn new(height: u32) -> Self {
        Self {
            height,
            trail: Vec::new(),
        }
    }

    /// Takes note of the next state without painting it.
    pub(crate) fn leave_out(&mut self, drawing: &Drawing) {
        self.trail.extend(drawing.trail);
    }

    /// Paints the next state. `None` if the drawing's view is empty.
    pub(crate) fn paint(&mut self, drawing: &Drawing) -> Option<Image> {
        self.trail.extend(drawing.trail);
        let [x0, y0, x1, y1] = drawing.view;
        let (wide, high) = (x1 - x0, y1 - y0);
        if !(wide.is_finite() && high.is_finite() && wide > 0.0 && high > 0.0) {
            return None;
        }
        let (wide, high) = (wide.max(high / MAX_ASPECT_RATIO), high.max(wide / MAX_ASPECT_RATIO));
        let most = f64::from(self.height);
        let scale = (most / high).min(2.0 * most / wide);
        let pixels = |length: f64| ((length * scale).round() as u32).max(1);
        let mut canvas = Pixmap::new(pixels(wide), pixels(high))?;
        canvas.fill(colour(PAPER));
        // A view that was too long is centred.
        let (left, top) = ((x0 + x1 - wide) / 2.0, (y0 + y1 + high) / 2.0);
        let place = |[x, y]: Point| [((x - left) * scale) as f32, ((top - y) * scale) as f32];
        let unit = canvas.width().min(canvas.height()) as f32;
        let mut trail = path(self.trail.iter().copied().map(place));
        for shape in &drawing.shapes {
            // The body is painted above its trail.
            if shape.class == Class::Body {
                draw(&mut canvas, trail.take().as_ref(), &stroked(TRAIL, 0.009), unit);
            }
            let outline = match &shape.form {
                Form::Line(points) => path(points.iter().copied().map(place)),
                Form::Circle([x, y, radius]) => {
                    let [x, y] = place([*x, *y]);
                    PathBuilder::from_circle(x, y, (radius * scale) as f32)
                }
                Form::Rectangle([x0, y0, x1, y1]) => {
                    let ([left, bottom], [right, top]) = (place([*x0, *y0]), place([*x1, *y1]));
                    Rect::from_ltrb(left, top, right, bottom).map(PathBuilder::from_rect)
                }
                Form::Arrow([x0, y0, x1, y1]) => arrow(place([*x0, *y0]), place([*x1, *y1]), unit),
                Form::Text(..) => None,
            };
            draw(&mut canvas, outline.as_ref(), &style(shape.class), unit);
        }
        draw(&mut canvas, trail.as_ref(), &stroked(TRAIL, 0.009), unit);
        Some(Image {
            width: canvas.width() as usize,
            height: canvas.height() as usize,
            rgb: canvas
                .pixels()
                .iter()
                .flat_map(|p| [p.red(), p.green(), p.blue()])
                .collect(),
        })
    }
}

fn stroked(colour: [u8; 3], width: f32) -> Style {
    Style {
        fill: None,
        stroke: Some((colour, width)),
    }
}

fn colour([red, green, blue]: [u8; 3]) -> Color {
    Color::from_rgba8(red, green, blue, 255)
}

fn draw(canvas: &mut Pixmap, path: Option<&Path>, style: &Style, unit: f32) {
    let Some(path) = path else { return };
    let mut paint = Paint::default();
    if let Some(fill) = style.fill {
        paint.set_color(colour(fill));
        canvas.fill_path(path, &paint, FillRule::Winding, Transform::identity(), None);
    }
    if let Some((outline, width)) = style.stroke {
        paint.set_color(colour(outline));
        let stroke = Stroke {
            width: (width * unit).max(1.0),
            line_cap: LineCap::Round,
            line_join: LineJoin::Round,
            ..Stroke::default()
        };
        canvas.stroke_path(path, &paint, &stroke, Transform::identity(), None);
    }
}

/// `None` for a single point.
fn path(points: impl Iterator<Item = [f32; 2]>) -> Option<Path> {
    let mut builder = PathBuilder::new();
    for (i, [x, y]) in points.enumerate() {
        if i == 0 {
            builder.move_to(x, y);
        } else {
            builder.line_to(x, y);
        }
    }
    builder.finish()
}

fn arrow([x0, y0]: [f32; 2], [x1, y1]: [f32; 2], unit: f32) -> Option<Path> {
    let (dx, dy) = (x1 - x0, y1 - y0);
    let length = dx.hypot(dy);
    let head = 0.035 * unit;
    if length < 0.2 * head {
        return None;
    }
    let (ux, uy) = (dx / length, dy / length);
    let wing = |side: f32| [x1 - head * (ux + 0.6 * side * uy), y1 - head * (uy - 0.6 * side * ux)];
    let mut builder = PathBuilder::new();
    builder.move_to(x0, y0);
    builder.line_to(x1, y1);
    for [x, y] in [wing(1.0), wing(-1.0)] {
        builder.move_to(x, y);
        builder.line_to(x1, y1);
    }
    builder.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixel(image: &Image, x: usize, y: usize) -> [u8; 3] {
        image.rgb[3 * (y * image.width + x)..][..3].try_into().unwrap()
    }

    #[test]
    fn shapes_are_where_their_units_say_and_in_front_of_earlier_ones() {
        let drawing = Drawing::new([-2.0, -1.0], [2.0, 1.0])
            .rectangle(Class::Target, [-2.0, 0.0], [0.0, 1.0])
            .circle(Class::Body, [1.0, -0.5], 0.25)
            .circle(Class::Joint, [1.0, -0.5], 0.1)
            .text([0.0, 0.0], "words are left out");
        let image = Painter::new(100).paint(&drawing).unwrap();
        assert_eq!((image.width, image.height), (200, 100));
        assert_eq!(pixel(&image, 50, 25), TARGET, "y grows upwards");
        assert_eq!(pixel(&image, 150, 75), INK);
        assert_eq!(pixel(&image, 141, 75), ACCENT);
        assert_eq!(pixel(&image, 150, 25), PAPER);
    }

    #[test]
    fn a_path_follows_its_point_below_the_body() {
        let at = |x: f64| {
            Drawing::new([0.0, 0.0], [4.0, 4.0])
                .trail([x, 2.0])
                .circle(Class::Body, [x, 2.0], 0.2)
        };
        let mut painter = Painter::new(400);
        painter.paint(&at(1.0)).unwrap();
        let image = painter.paint(&at(3.0)).unwrap();
        assert_eq!(pixel(&image, 200, 200), TRAIL);
        assert_eq!(pixel(&image, 300, 200), ACCENT);
        assert_eq!(pixel(&image, 350, 200), PAPER);
    }

    #[test]
    fn an_arrow_has_a_head_and_long_or_empty_views_do_no_harm() {
        let view = Drawing::new([0.0, 0.0], [1.0, 1.0]).arrow(Class::Force, [0.1, 0.5], [0.9, 0.5]);
        let image = Painter::new(200).paint(&view).unwrap();
        assert_eq!(pixel(&image, 100, 100), BAD);
        let thickness = |x| (0..200).filter(|y| pixel(&image, x, *y) != PAPER).count();
        assert!(
            thickness(100) <= 4 && thickness(175) >= 6,
            "{} {}",
            thickness(100),
            thickness(175)
        );
        let long = Painter::new(100).paint(&Drawing::new([0.0, 0.0], [1e9, 1.0])).unwrap();
        assert_eq!((long.width, long.height), (200, 50));
        assert_eq!(Painter::new(100).paint(&Drawing::new([0.0, 0.0], [0.0, 1.0])), None);
        assert_eq!(
            Painter::new(100).paint(&Drawing::new([0.0, 0.0], [f64::NAN, 1.0])),
            None
        );
    }
}
