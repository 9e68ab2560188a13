//! FrozenLake as a grid: a policy's actions in each cell, and their values (figure 4.4).

use std::path::Path;

use plotters::element::PathElement;
use plotters::prelude::{Polygon, RGBColor, Rectangle, WHITE};
use plotters::style::Color;
use plotters::style::text_anchor::HPos;
use shoal_env_server::environment::frozen_lake::MAP;

use super::canvas::{Area, BLUE, FAINT, INK, bold, px, save, stroke, text};

const SIDE: usize = 4;
const CELL: f64 = 120.0;
const MARGIN: f64 = 30.0;
const TITLE: f64 = 34.0;

/// The directions of the actions 0 to 3: left, down, right, up; y points down.
const DIRECTIONS: [(f64, f64); 4] = [(-1.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, -1.0)];

/// Draws two grids side by side: the policy's actions in each cell (several if they are equally good), and the value of
/// each action, darker for higher values.
pub fn lake(policy: &[Vec<usize>], values: &[[f64; 4]], path: &Path) -> anyhow::Result<()> {
    let side = SIDE as f64 * CELL;
    let width = 2.0 * side + 3.0 * MARGIN;
    save(path, (width as u32, (side + TITLE + MARGIN) as u32), |sheet| {
        sheet.draw_text("Policy", &bold(15.0, HPos::Left), (px(MARGIN), px(TITLE / 2.0)))?;
        let right = 2.0 * MARGIN + side;
        sheet.draw_text("Action-values", &bold(15.0, HPos::Left), (px(right), px(TITLE / 2.0)))?;
        for (state, kind) in MAP.iter().enumerate() {
            let (row, column) = (state / SIDE, state % SIDE);
            let (x, y) = (column as f64 * CELL, TITLE + row as f64 * CELL);
            draw_cell(sheet, MARGIN + x, y, state)?;
            draw_cell(sheet, right + x, y, state)?;
            if matches!(kind, b'H' | b'G') {
                continue;
            }
            for action in policy.get(state).into_iter().flatten() {
                draw_arrow(sheet, MARGIN + x + CELL / 2.0, y + CELL / 2.0, DIRECTIONS[*action])?;
            }
            if let Some(values) = values.get(state) {
                draw_values(sheet, right + x, y, values)?;
            }
        }
        Ok(())
    })
}

fn draw_cell(sheet: &Area<'_>, x: f64, y: f64, state: usize) -> anyhow::Result<()> {
    let corners = [(px(x), px(y)), (px(x + CELL), px(y + CELL))];
    let fill = match MAP[state] {
        b'H' => RGBColor(90, 90, 90),
        b'G' => RGBColor(190, 225, 205),
        _ => WHITE,
    };
    sheet.draw(&Rectangle::new(corners, fill.filled()))?;
    sheet.draw(&Rectangle::new(corners, stroke(INK, 0.6, 1.0)))?;
    let number = format!("{state}");
    let ink = if MAP[state] == b'H' { FAINT } else { INK };
    sheet.draw_text(
        &number,
        &text(10.0, HPos::Left).color(&ink),
        (px(x + 5.0), px(y + 10.0)),
    )?;
    let name = match MAP[state] {
        b'H' => "hole",
        b'G' => "goal",
        _ => return Ok(()),
    };
    let middle = (px(x + CELL / 2.0), px(y + CELL / 2.0));
    Ok(sheet.draw_text(name, &text(14.0, HPos::Center).color(&ink), middle)?)
}

fn draw_arrow(sheet: &Area<'_>, x: f64, y: f64, (dx, dy): (f64, f64)) -> anyhow::Result<()> {
    let at = |along: f64, across: f64| (px(x + along * dx - across * dy), px(y + along * dy + across * dx));
    sheet.draw(&PathElement::new([at(6.0, 0.0), at(38.0, 0.0)], stroke(BLUE, 1.0, 2.6)))?;
    Ok(sheet.draw(&Polygon::new(
        [at(48.0, 0.0), at(35.0, 6.5), at(35.0, -6.5)],
        BLUE.filled(),
    ))?)
}

/// Draws the values of the four actions as four triangles of the cell.
fn draw_values(sheet: &Area<'_>, x: f64, y: f64, values: &[f64; 4]) -> anyhow::Result<()> {
    let (cx, cy, half) = (x + CELL / 2.0, y + CELL / 2.0, CELL / 2.0);
    for ((dx, dy), value) in DIRECTIONS.iter().zip(values) {
        let corner = |side: f64| (px(cx + half * (dx - side * dy)), px(cy + half * (dy + side * dx)));
        let outline = [(px(cx), px(cy)), corner(1.0), corner(-1.0)];
        sheet.draw(&Polygon::new(outline, BLUE.mix(0.55 * value.clamp(0.0, 1.0)).filled()))?;
        sheet.draw(&PathElement::new(outline, stroke(INK, 0.3, 0.6)))?;
        let place = (px(cx + 0.6 * half * dx), px(cy + 0.6 * half * dy));
        sheet.draw_text(&format!("{value:.2}"), &text(12.0, HPos::Center), place)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frozen_cells_show_values_and_holes_and_goal_do_not() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lake.svg");
        lake(&vec![vec![0, 2]; 16], &[[0.25, 0.5, 0.75, 1.0]; 16], &path).unwrap();
        let svg = std::fs::read_to_string(path).unwrap();
        let count = |text: &str| svg.lines().filter(|line| line.trim() == text).count();
        assert_eq!((count("0.25"), count("1.00")), (11, 11));
        assert_eq!((count("hole"), count("goal")), (8, 2));
    }
}
