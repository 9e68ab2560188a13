//! The results of `bench actors` as text for the user.

use super::super::one_core::{OneCore, TARGET};
use super::super::target::{Target, TargetRow};
use super::{ActorResults, Bottleneck, Count, Rate, Scaling, StageResults};

const THOUSAND: f64 = 1e3;

impl StageResults for ActorResults {
    fn entries(&self) -> Vec<(&'static str, String)> {
        let Self {
            counts, scaling, costs, ..
        } = self;
        vec![
            ("rows a second, no updates", lines(counts.iter().map(collecting))),
            ("rows and updates a second", lines(counts.iter().map(learning))),
            ("cores", self.cores()),
            ("one actor and its server on one core", self.share()),
            (
                "cost of each stage",
                format!(
                    "policy for 64 observations {:.0} µs, with noise {:.0};\n\
                     a step of 64 environments {:.1} µs, through the server process {:.1};\n\
                     a chunk of {} rows {:.1} µs to write, {:.1} to receive; an update {:.0} µs",
                    costs.inference_us,
                    costs.acting_us,
                    costs.environment_step_us,
                    costs.round_trip_us,
                    self.chunk_rows,
                    costs.writing_chunk_us,
                    costs.intake_of_chunk_us,
                    costs.update_us
                ),
            ),
            (
                "expected with a core for each process",
                lines(scaling.iter().map(expected)),
            ),
            (
                "first bottleneck",
                format!(
                    "here {}; with a core for each process {}, with updates {}",
                    saturated(&self.first_bottleneck_on_these_cores),
                    saturated(&self.first_bottleneck),
                    saturated(&self.first_bottleneck_with_updates)
                ),
            ),
        ]
    }

    fn target_rows(&self) -> Vec<TargetRow> {
        let OneCore {
            pair_rows_per_second,
            inference_rows_per_second,
            share,
            ..
        } = self.one_core;
        let rows = |rate: f64| format!("{:.0} thousand rows/s", rate / THOUSAND);
        let most = self
            .counts
            .iter()
            .map(|count| count.collecting.rows_per_second)
            .fold(0.0, f64::max);
        vec![
            TargetRow {
                stage: "actor and server, one core",
                ours: rows(pair_rows_per_second),
                limit: format!("{}, the policy alone", rows(inference_rows_per_second)),
                share: Some(share),
                target: Target::at_least(TARGET, share, "0.8 of the limit"),
            },
            TargetRow {
                stage: "actors, all cores",
                ours: rows(most),
                limit: format!(
                    "{}, the policy alone on {} cores",
                    rows(inference_rows_per_second * f64::from(self.cores)),
                    self.cores
                ),
                share: Some(most / (inference_rows_per_second * f64::from(self.cores))),
                target: Target::unchecked("10 times Gymnasium's vectors"),
            },
        ]
    }
}

impl ActorResults {
    fn cores(&self) -> String {
        let crowded = self.counts.iter().find(|count| count.more_processes_than_cores);
        match crowded {
            None => format!("{}: one for each process", self.cores),
            Some(Count { actors, processes, .. }) => format!(
                "{}: with {} or more ({processes} processes), processes share cores, so the efficiency depends on the \
                 machine",
                self.cores,
                of_actors(*actors)
            ),
        }
    }

    fn share(&self) -> String {
        let it = &self.one_core;
        let learner = if it.learner_apart {
            ""
        } else {
            "; the learner ran on the same core"
        };
        format!(
            "{:.2} ({:.2} to {:.2}) of the policy alone, target {TARGET}: \
             {:.0} of {:.0} thousand rows a second{learner}",
            it.share,
            it.share_least,
            it.share_greatest,
            it.pair_rows_per_second / THOUSAND,
            it.inference_rows_per_second / THOUSAND
        )
    }
}

fn collecting(count: &Count) -> String {
    rows_of(count.actors, &count.collecting)
}

fn learning(count: &Count) -> String {
    let rate = &count.learning;
    format!(
        "{}; {:.0} updates, expected {:.0}",
        rows_of(count.actors, rate),
        rate.updates_per_second,
        rate.expected_updates_per_second
    )
}

fn rows_of(actors: u32, rate: &Rate) -> String {
    format!(
        "{}: {} thousand, expected {:.0}, efficiency {:.2}",
        of_actors(actors),
        rate.results.show(THOUSAND, 0),
        rate.expected_rows_per_second / THOUSAND,
        rate.efficiency
    )
}

fn expected(scaling: &Scaling) -> String {
    format!(
        "{}: {:.0} thousand rows a second, efficiency {:.2}; with updates {:.0}, {:.2}, and {:.0} updates",
        of_actors(scaling.actors),
        scaling.rows_per_second / THOUSAND,
        scaling.efficiency,
        scaling.learning_rows_per_second / THOUSAND,
        scaling.learning_efficiency,
        scaling.learning_updates_per_second
    )
}

fn saturated(bottleneck: &Bottleneck) -> String {
    format!("{}, at {:.1} actors", bottleneck.resource, bottleneck.actors)
}

fn of_actors(actors: u32) -> String {
    format!("{actors} actor{}", if actors == 1 { "" } else { "s" })
}

fn lines(lines: impl Iterator<Item = String>) -> String {
    lines.collect::<Vec<_>>().join("\n")
}
