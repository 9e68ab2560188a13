//! `shoal bench all`: every stage after the other, and one table of them.

use std::io::Write;

use comfy_table::Table;
use comfy_table::presets::UTF8_BORDERS_ONLY;
use serde_json::{Map, Value};

use super::measurement::{Figures, Patience};
use super::target::Line;
use super::{actors, learner, policy, step, transitions, whole_run};

/// What the stages gave, by name, and the lines of the table.
struct All {
    stages: Map<String, Value>,
    lines: Vec<Line>,
}

impl All {
    fn add(&mut self, stage: &str, figures: &impl Figures) -> anyhow::Result<()> {
        self.stages.insert(stage.into(), serde_json::to_value(figures)?);
        self.lines.extend(figures.table());
        Ok(())
    }
}

/// Measures every stage but those that need other programs, each as long as alone, and prints them.
pub(super) fn measure_all(json: bool, patience: &Patience) -> anyhow::Result<()> {
    let mut all = All {
        stages: Map::new(),
        lines: Vec::new(),
    };
    all.add("learner", &learner::measure(patience)?)?;
    all.add("transitions", &transitions::measure(patience)?)?;
    all.add("step", &step::measure(patience)?)?;
    all.add("policy", &policy::measure(patience)?)?;
    all.add("actors", &actors::measure(None, patience)?)?;
    all.add("run", &whole_run::measure(patience)?)?;
    let All { mut stages, lines } = all;

    let mut table = Table::new();
    table.load_style(UTF8_BORDERS_ONLY);
    table.set_header(["stage", "ours", "limit", "share", "target"]);
    for line in &lines {
        let share = line.share.map_or_else(String::new, |share| format!("{share:.2}"));
        table.add_row([line.stage, &line.ours, &line.limit, &share, &line.target.show()]);
    }
    if json {
        stages.insert("table".into(), serde_json::to_value(&lines)?);
        writeln!(std::io::stderr().lock(), "{table}")?;
        writeln!(std::io::stdout().lock(), "{}", Value::Object(stages))?;
    } else {
        writeln!(std::io::stdout().lock(), "{table}")?;
    }
    Ok(())
}
