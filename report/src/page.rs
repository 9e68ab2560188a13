//! The HTML report: the numbers of one or more runs, and the page that shows them. It is one file and loads nothing
//! else.

mod comparison;
mod hosts;
mod numbers;
mod pictures;
mod played;
mod ranking;
mod run;
mod settings;
mod signals;

use std::time::SystemTime;

use serde::Serialize;
use shoal_common::run_dir::RunDir;
use shoal_run::records::start::StartRecord;

use self::comparison::Comparison;
use self::numbers::PageLimits;
use self::ranking::Ranking;
use self::run::Run;

/// The first bytes of every report. They distinguish a report from other files.
pub const MARK: &str = "<!doctype html>\n<!-- made by shoal report -->\n";

const PAGE: &str = include_str!("page/page.html");
const STYLE: &str = include_str!("page/page.css");
/// In dependency order: a script uses only earlier scripts.
const SCRIPTS: [&str; 10] = [
    include_str!("page/dom.js"),
    include_str!("page/axis.js"),
    include_str!("page/smoothing.js"),
    include_str!("page/chart.js"),
    include_str!("page/scenes.js"),
    include_str!("page/drawings.js"),
    include_str!("page/player.js"),
    include_str!("page/timeline.js"),
    include_str!("page/head.js"),
    include_str!("page/page.js"),
];

/// Everything the page shows.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    version: &'static str,
    /// Seconds since 1970.
    made: u64,
    /// The start of the suite whose runs these are; `None` if they are not exactly the runs of one suite.
    suite: Option<StartRecord>,
    runs: Vec<Run>,
    comparisons: Vec<Comparison>,
    rankings: Vec<Ranking>,
}

/// Reads what the runs have recorded so far. There must be at least one. A run may still be training, or have just
/// started. `suite` is the start of the suite whose runs these are.
///
/// # Errors
/// When a run cannot be read.
pub fn gather(runs: &[RunDir], suite: Option<StartRecord>) -> anyhow::Result<Report> {
    let names = run::names(runs);
    let mut gathered = Vec::new();
    for (number, (run, name)) in runs.iter().zip(names).enumerate() {
        let limits = PageLimits::of(number, runs.len());
        gathered.push(Run::read(run, name, limits)?);
    }
    let comparisons = comparison::compare(&gathered);
    let since = SystemTime::UNIX_EPOCH.elapsed();
    Ok(Report {
        version: env!("CARGO_PKG_VERSION"),
        made: since.map_or(0, |since| since.as_secs()),
        suite,
        rankings: rankings(&comparisons, &gathered),
        comparisons,
        runs: gathered,
    })
}

fn rankings(comparisons: &[Comparison], runs: &[Run]) -> Vec<Ranking> {
    let of = |it: &Comparison| ranking::rank(&it.environment, &it.sets, runs);
    comparisons.iter().filter_map(of).collect()
}

/// Ranks the settings of repeated runs: a line for each setting, the best first, and then how certain the first place
/// is. Empty if no setting was repeated.
///
/// # Errors
/// When a run cannot be read.
pub fn ranking(runs: &[RunDir]) -> anyhow::Result<Vec<String>> {
    let named = runs.iter().zip(run::names(runs));
    let read = named.map(|(run, name)| Run::read(run, name, PageLimits::NONE));
    let read = read.collect::<anyhow::Result<Vec<_>>>()?;
    let found = rankings(&comparison::compare(&read), &read);
    Ok(found
        .iter()
        .flat_map(|it| it.lines().chain(it.verdict.clone()))
        .collect())
}

impl Report {
    /// The reasons why runs have no playable episodes, each with the names of the runs concerned.
    pub fn runs_without_episodes(&self) -> Vec<(&str, Vec<&str>)> {
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

    /// The self-contained page.
    pub fn page(&self) -> anyhow::Result<String> {
        // Nothing in the data may look like markup, not even a run's name.
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

/// Replaces every `{{name}}` of the template. Inserted text is not searched for names.
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
