//! The layout of the screen for the size of the terminal. On a small terminal the curves are left out first, then the
//! least important columns of the roles.

use ratatui::Frame;
use ratatui::layout::{Alignment, Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::{
    Axis, Block, Borders, Cell, Chart, Clear, Dataset, Gauge, GraphType, Paragraph, Row, Sparkline, Table,
};
use shoal_common::channel::control::{HostState, RoleState, RoleStatus};
use shoal_common::role::Role;
use shoal_run::numbers::thousands;

use super::{LauncherState, Overlay, Screen};
use crate::status_table::{HOST_COLUMNS, ROLE_COLUMNS, host_cells, progress, role_cells, waiting};

/// Number of rows above the roles, and of rows with keys at the bottom.
const HEAD: u16 = 4;
const FOOT: u16 = 1;

/// The least height and width in which the curves are readable.
const CURVES: u16 = 8;
const CURVES_WIDTH: u16 = 60;

/// The least width in which all columns of the roles fit.
const ALL_COLUMNS: u16 = 74;

/// Draws the whole screen.
pub(crate) fn draw(frame: &mut Frame<'_>, screen: &Screen) {
    let area = frame.area();
    let body = area.height.saturating_sub(HEAD + FOOT);
    let roles = screen.status.roles.len() as u16 + 1;
    // At most half of what is below the head: the roles come first.
    let hosts = match screen.status.hosts.len() as u16 {
        0 => 0,
        hosts => (hosts + 2).min(body / 2),
    };
    let curves = if area.width >= CURVES_WIDTH && body >= CURVES + 4 + hosts {
        CURVES.max(body.saturating_sub(roles + 1 + hosts))
    } else {
        0
    };
    let [head, table, of_hosts, curve, foot] = Layout::vertical([
        Constraint::Length(HEAD),
        Constraint::Min(0),
        Constraint::Length(hosts),
        Constraint::Length(curves),
        Constraint::Length(FOOT),
    ])
    .areas(area);
    draw_head(frame, screen, head);
    draw_roles(frame, screen, table);
    draw_hosts(frame, screen, of_hosts);
    if curves > 0 {
        let halves = [Constraint::Percentage(60), Constraint::Percentage(40)];
        let [left, right] = Layout::horizontal(halves).spacing(2).areas(curve);
        draw_learning_curve(frame, screen, left);
        draw_throughput(frame, screen, right);
    }
    draw_foot(frame, screen, foot);
    match screen.overlay {
        Overlay::Nothing => {}
        Overlay::Help => draw_box(frame, "keys", HELP),
        Overlay::Stop => draw_box(
            frame,
            "stop",
            &["Stop the run? Its state is saved.", "y  yes      any other key  no"],
        ),
    }
}

const HELP: &[&str] = &[
    "+  one actor more     -  one less",
    "s  stop the run (asks first)",
    "q  quit; the run continues",
    "any key closes this",
];

fn colour(screen: &Screen, colour: Color) -> Style {
    if screen.colours {
        Style::new().fg(colour)
    } else {
        Style::new()
    }
}

fn draw_head(frame: &mut Frame<'_>, screen: &Screen, area: Rect) {
    let [title, bar, rates, ratio] = Layout::vertical([Constraint::Length(1); 4]).areas(area);
    let status = &screen.status;
    let (state, style) = match &screen.launcher {
        LauncherState::Unknown => ("connecting".to_owned(), Style::new()),
        LauncherState::Running => ("running".to_owned(), colour(screen, Color::Green)),
        LauncherState::Silent(_) => ("no answer".to_owned(), colour(screen, Color::Red)),
        LauncherState::Ended if status.finished => ("has ended: finished".to_owned(), colour(screen, Color::Cyan)),
        LauncherState::Ended => ("has ended".to_owned(), colour(screen, Color::Yellow)),
    };
    let line = Line::from(vec![
        Span::styled(screen.run.clone(), Modifier::BOLD),
        Span::raw(" "),
        Span::styled(state, style.add_modifier(Modifier::BOLD)),
        Span::raw("  "),
        Span::raw(screen.task.clone()),
    ]);
    frame.render_widget(line, title);
    if screen.launcher == LauncherState::Unknown {
        return;
    }
    let (done, all) = match status.episodes_limit {
        Some(limit) => (status.episodes, limit),
        None => (status.env_steps, status.steps),
    };
    let gauge = Gauge::default()
        .ratio((done as f64 / all.max(1) as f64).clamp(0.0, 1.0))
        .label(progress(status))
        .gauge_style(if screen.colours {
            Style::new().fg(Color::Blue).bg(Color::Black)
        } else {
            Style::new().add_modifier(Modifier::REVERSED)
        });
    // Without colours the bar would reverse the text, which is hard to read at the bar's end: text alone instead.
    if screen.colours {
        frame.render_widget(gauge, bar);
    } else {
        let percent = 100.0 * done as f64 / all.max(1) as f64;
        frame.render_widget(Line::raw(format!("{} ({percent:.0} %)", progress(status))), bar);
    }
    let best = screen.evaluations.iter().map(|(_, mean)| *mean).reduce(f64::max);
    let mut text = format!(
        "{:.0} updates/s, {:.0} steps/s",
        status.updates_per_second, status.env_steps_per_second
    );
    if let Some((mean, best)) = status.eval_return_mean.zip(best) {
        text += &format!(", eval {mean:.2}, best {best:.2}");
    }
    frame.render_widget(Line::raw(text), rates);
    let line = Line::from(vec![
        Span::raw(format!("ratio {:.2} of {:.2}; ", status.ratio, status.updates_per_step)),
        Span::styled(waiting(status).to_owned(), colour(screen, Color::Yellow)),
    ]);
    frame.render_widget(line, ratio);
}

fn draw_roles(frame: &mut Frame<'_>, screen: &Screen, area: Rect) {
    let mut roles: Vec<&RoleStatus> = screen.status.roles.iter().collect();
    if roles.is_empty() || area.height < 2 {
        return;
    }
    let rank = |role: &RoleStatus| {
        let first = [Role::Learner, Role::Evaluator, Role::Actor];
        first.iter().position(|first| *first == role.role)
    };
    roles.sort_by_key(|role| (rank(role).unwrap_or(usize::MAX), role.index));
    let wide = area.width >= ALL_COLUMNS;
    let lines = area.height as usize - 1;
    let hidden = if roles.len() > lines {
        roles.len() + 1 - lines
    } else {
        0
    };
    let shown = roles.len() - hidden;
    let mut rows: Vec<Row<'_>> = roles[..shown]
        .iter()
        .map(|role| {
            let [name, pid, state, restarts, rate, policy, lag] = role_cells(role);
            let (name, state) = (Cell::from(name), Cell::from(state).style(style_of(screen, role.state)));
            if wide {
                let numbers = [restarts, rate, policy, lag].map(right);
                Row::new([name, right(pid), state].into_iter().chain(numbers))
            } else {
                Row::new([name, state, right(restarts), right(rate)])
            }
        })
        .collect();
    if hidden > 0 {
        rows.push(Row::new([Cell::from(format!("and {hidden} more"))]));
    }
    let (names, widths): (&[&str], &[u16]) = if wide {
        (&ROLE_COLUMNS, &[13, 8, 17, 8, 8, 8, 5])
    } else {
        (&["role", "state", "rs", "rate"], &[13, 13, 3, 8])
    };
    draw_table(frame, names, widths, rows, area);
}

/// The other hosts of the run.
fn draw_hosts(frame: &mut Frame<'_>, screen: &Screen, area: Rect) {
    if area.height < 2 {
        return;
    }
    let area = Rect {
        y: area.y + 1,
        height: area.height - 1,
        ..area
    };
    let rows = screen.status.hosts.iter().map(|host| {
        let [name, state, numbers @ ..] = host_cells(host);
        let style = colour(
            screen,
            match host.state {
                HostState::Connected => Color::Green,
                HostState::CutOff => Color::Red,
                HostState::Left => Color::Cyan,
            },
        );
        let cells = [Cell::from(name), Cell::from(state).style(style)];
        Row::new(cells.into_iter().chain(numbers.map(right)))
    });
    draw_table(frame, &HOST_COLUMNS, &[16, 16, 6, 8, 8, 10, 5], rows.collect(), area);
}

/// A table whose columns are aligned to the right, except names and states.
fn draw_table(frame: &mut Frame<'_>, names: &[&str], widths: &[u16], rows: Vec<Row<'_>>, area: Rect) {
    let header = names.iter().map(|name| match *name {
        "role" | "host" | "state" => Cell::from(*name),
        number => right(number.into()),
    });
    let table = Table::new(rows, widths.iter().map(|width| Constraint::Length(*width)))
        .header(Row::new(header).style(Modifier::BOLD));
    frame.render_widget(table, area);
}

fn right<'a>(text: String) -> Cell<'a> {
    Cell::from(Line::raw(text).alignment(Alignment::Right))
}

fn style_of(screen: &Screen, state: RoleState) -> Style {
    match state {
        RoleState::Working | RoleState::Done => colour(screen, Color::Green),
        RoleState::Starting | RoleState::WaitingForPeer | RoleState::WaitingForRatio => colour(screen, Color::Yellow),
        RoleState::Silent | RoleState::Restarting => colour(screen, Color::Red).add_modifier(Modifier::BOLD),
        RoleState::Retiring | RoleState::Ending => colour(screen, Color::Cyan),
    }
}

fn draw_learning_curve(frame: &mut Frame<'_>, screen: &Screen, area: Rect) {
    let block = Block::new().borders(Borders::TOP).title(" return over steps ");
    let points = &screen.evaluations;
    let Some((least, most)) = points
        .iter()
        .map(|(_, mean)| *mean)
        .fold(None::<(f64, f64)>, |range, mean| {
            let (least, most) = range.unwrap_or((mean, mean));
            Some((f64::min(least, mean), f64::max(most, mean)))
        })
    else {
        frame.render_widget(Paragraph::new("no evaluation yet").block(block), area);
        return;
    };
    let last = points.iter().map(|(steps, _)| *steps).fold(1.0, f64::max);
    let margin = if most > least { 0.05 * (most - least) } else { 1.0 };
    let curve = Dataset::default()
        .marker(Marker::Braille)
        .graph_type(GraphType::Line)
        .style(colour(screen, Color::Cyan))
        .data(points);
    let ends = |low: f64, high: f64, digits: usize| [format!("{low:.digits$}"), format!("{high:.digits$}")];
    let chart = Chart::new(vec![curve])
        .block(block)
        .x_axis(
            Axis::default()
                .bounds([0.0, last])
                .labels(["0".to_owned(), thousands(last as u64)]),
        )
        .y_axis(Axis::default().bounds([least - margin, most + margin]).labels(ends(
            least,
            most,
            if most - least < 10.0 { 2 } else { 0 },
        )));
    frame.render_widget(chart, area);
}

fn draw_throughput(frame: &mut Frame<'_>, screen: &Screen, area: Rect) {
    let skipped = screen.throughput.len().saturating_sub(area.width.into());
    let newest: Vec<u64> = screen.throughput.iter().skip(skipped).copied().collect();
    let most = newest.iter().max().copied().unwrap_or(0);
    let title = format!(" updates/s, at most {} ", thousands(most));
    let block = Block::new().borders(Borders::TOP).title(title);
    let line = Sparkline::default()
        .block(block)
        .data(newest)
        .style(colour(screen, Color::Green));
    frame.render_widget(line, area);
}

fn draw_foot(frame: &mut Frame<'_>, screen: &Screen, area: Rect) {
    let line = match (&screen.notice, &screen.launcher) {
        (_, LauncherState::Silent(why)) => Line::raw(why.clone()),
        (Some(notice), _) => Line::raw(notice.clone()),
        (None, LauncherState::Ended) => Line::raw(format!("the run has ended; q quits; shoal resume {}", screen.run)),
        (None, _) => Line::raw("+/- actors  s stop  ? help  q quit"),
    };
    frame.render_widget(line.style(Modifier::REVERSED), area);
}

/// Draws a box in the middle of the screen.
fn draw_box(frame: &mut Frame<'_>, title: &str, lines: &[&str]) {
    let wide = lines.iter().map(|line| line.chars().count()).max().unwrap_or(0) as u16;
    let area = frame
        .area()
        .centered(Constraint::Length(wide + 4), Constraint::Length(lines.len() as u16 + 2));
    let block = Block::bordered().title(format!(" {title} "));
    let text: Vec<Line<'_>> = lines.iter().map(|line| Line::raw(format!(" {line}"))).collect();
    frame.render_widget(Clear, area);
    frame.render_widget(Paragraph::new(text).block(block), area);
}

#[cfg(test)]
mod tests;
