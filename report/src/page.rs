//! A report that one can send: the numbers of one run or several, and a page that shows them without any network.

mod comparison;
mod numbers;
mod played;
mod run;
mod settings;
mod signals;

use std::time::SystemTime;

use serde::Serialize;
use shoal_common::run_dir::RunDir;

use self::comparison::Comparison;
use self::run::Run;

/// What a report begins with, and no other file.
pub const MARK: &str = "<!doctype html>\n<!-- made by shoal report -->\n";

const PAGE: &str = include_str!("page/page.html");
const STYLE: &str = include_str!("page/page.css");
/// In the order in which they need each other.
const SCRIPTS: [&str; 7] = [
    include_str!("page/dom.js"),
    include_str!("page/axis.js"),
    include_str!("page/chart.js"),
    include_str!("page/scenes.js"),
    include_str!("page/player.js"),
    include_str!("page/timeline.js"),
    include_str!("page/page.js"),
];

/// Points of a curve of a single run; several share them, so that the page stays small.
const POINTS: usize = 800;
const POINTS_TOGETHER: usize = 4_000;
const FEWEST_POINTS: usize = 60;

/// Episodes played of a single run; several share them.
const EPISODES: usize = 6;
const EPISODES_TOGETHER: usize = 24;

/// Everything the page shows.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    version: &'static str,
    /// Seconds since 1970.
    made: u64,
    runs: Vec<Run>,
    comparisons: Vec<Comparison>,
}

/// How much of each run there is room for.
#[derive(Clone, Copy, Debug)]
struct Room {
    points: usize,
    episodes: usize,
}

impl Room {
    /// For the run of this number among so many.
    fn of(number: usize, runs: usize) -> Self {
        Self {
            points: (POINTS_TOGETHER / runs).clamp(FEWEST_POINTS, POINTS),
            episodes: match EPISODES_TOGETHER / runs {
                0 => usize::from(number < EPISODES_TOGETHER),
                share => share.min(EPISODES),
            },
        }
    }
}

/// Reads what the runs, at least one, left behind so far. A run may be under way, or have hardly begun.
pub fn gather(runs: &[RunDir]) -> anyhow::Result<Report> {
    let names = run::names(runs);
    let mut gathered = Vec::new();
    for (number, (run, name)) in runs.iter().zip(names).enumerate() {
        let room = Room::of(number, runs.len());
        gathered.push(Run::read(run, name, room)?);
    }
    let since = SystemTime::UNIX_EPOCH.elapsed();
    Ok(Report {
        version: env!("CARGO_PKG_VERSION"),
        made: since.map_or(0, |since| since.as_secs()),
        comparisons: comparison::compare(&gathered),
        runs: gathered,
    })
}

impl Report {
    /// Why no episode is played, and of which runs.
    pub fn not_played(&self) -> Vec<(&str, Vec<&str>)> {
        let mut reasons: Vec<(&str, Vec<&str>)> = Vec::new();
        for run in &self.runs {
            let Some(reason) = run.played.why_not.as_deref() else {
                continue;
            };
            match reasons.iter_mut().find(|(known, _)| *known == reason) {
                Some((_, names)) => names.push(&run.name),
                None => reasons.push((reason, vec![&run.name])),
            }
        }
        reasons
    }

    /// The page, complete in itself.
    pub fn page(&self) -> anyhow::Result<String> {
        // Nothing in the data may look like markup, whatever a run is called.
        let data = serde_json::to_string(self)?.replace('<', "\\u003c");
        let names: Vec<&str> = self.runs.iter().map(|run| run.name.as_str()).collect();
        let title = match names[..] {
            [name] => format!("Shoal: {name}"),
            _ => format!("Shoal: {} runs", names.len()),
        };
        let parts = [
            ("title", escaped(&title)),
            ("style", STYLE.into()),
            ("data", data),
            ("script", SCRIPTS.concat()),
        ];
        Ok(filled(PAGE, &parts))
    }
}

/// The template with its `{{name}}`s replaced, once: what is put in is not looked at again.
fn filled(template: &str, parts: &[(&str, String)]) -> String {
    let mut page = String::from(MARK);
    let mut rest = template;
    while let Some((before, after)) = rest.split_once("{{") {
        page += before;
        let (name, after) = after.split_once("}}").unwrap_or((after, ""));
        let part = parts.iter().find(|(known, _)| *known == name);
        page += part.map_or("", |(_, text)| text);
        rest = after;
    }
    page + rest
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests;
