//! `shoal bench all`: every stage in turn, and one table of the results.

use comfy_table::Table;
use comfy_table::presets::UTF8_BORDERS_ONLY;
use serde_json::{Map, Value};

use super::measurement::{StageResults, TimeBudget, print_table};
use super::target::TargetRow;
use super::{actors, learner, policy, step, transitions, whole_run};

/// The results of the stages by name, and the rows of the table.
struct All {
    stages: Map<String, Value>,
    rows: Vec<TargetRow>,
}

impl All {
    fn add(&mut self, stage: &str, results: &impl StageResults) -> anyhow::Result<()> {
        self.stages.insert(stage.into(), serde_json::to_value(results)?);
        self.rows.extend(results.target_rows());
        Ok(())
    }
}

/// Measures every stage that needs no other program, each for the full length, and prints the results.
pub(super) fn measure_all(json: bool, budget: &TimeBudget) -> anyhow::Result<()> {
    let mut all = All {
        stages: Map::new(),
        rows: Vec::new(),
    };
    all.add("learner", &learner::measure(None, budget)?)?;
    all.add("transitions", &transitions::measure(budget)?)?;
    all.add("step", &step::measure(budget)?)?;
    all.add("policy", &policy::measure(None, budget)?)?;
    all.add("actors", &actors::measure(None, budget)?)?;
    all.add("run", &whole_run::measure(budget)?)?;
    let All { mut stages, rows } = all;

    let mut table = Table::new();
    table.load_style(UTF8_BORDERS_ONLY);
    table.set_header(["stage", "ours", "limit", "share", "target"]);
    for row in &rows {
        let share = row.share.map_or_else(String::new, |share| format!("{share:.2}"));
        table.add_row([row.stage, &row.ours, &row.limit, &share, &row.target.show()]);
    }
    let json = if json {
        stages.insert("table".into(), serde_json::to_value(&rows)?);
        Some(Value::Object(stages).to_string())
    } else {
        None
    };
    print_table(&table, json)
}
