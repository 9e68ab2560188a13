//! The report, `REPORT.md`: claims with their verdicts, and figures.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Component, Path, PathBuf};

use anyhow::Context;
use shoal_common::durable::write_atomically;

use super::claim::{Claim, Verdict};
use super::experiment::{Effort, Experiment, Milestone};
use super::family::FamilyEntry;
use super::folder::Folder;
use super::report_section::{Figure, FigureWriter, ReportSection};
use super::request::{Job, JobName, Request};

/// Writes the report from all results of the folder, and draws its figures.
pub(super) fn write(
    families: &[FamilyEntry],
    folder: &Folder,
    request: &Request,
    jobs: &[Job],
    failures: &BTreeMap<JobName, String>,
) -> anyhow::Result<()> {
    let figures = folder.path().join("figures");
    let writer = FigureWriter::in_directory(figures.clone(), request.png)?;
    let mut sections = Vec::new();
    for family in families {
        let milestones = Milestones {
            family,
            folder,
            jobs,
            failures,
            effort: request.effort,
        };
        if !milestones.are_in_report() {
            continue;
        }
        for section in (family.sections)(folder, &writer)? {
            if let Some(seeds) = milestones.seeds_of(&section) {
                let notes = notes(folder, &section.from)?;
                sections.push((section, seeds, notes));
            }
        }
    }
    let parent = parent_of(&request.report);
    std::fs::create_dir_all(parent).with_context(|| format!("cannot create {}", parent.display()))?;
    let parent = std::fs::canonicalize(parent).with_context(|| format!("cannot resolve {}", parent.display()))?;
    let text = compose(&sections, request.effort, &relative(&figures, &parent));
    write_atomically(&request.report, |file| file.write_all(text.as_bytes()))?;
    Ok(())
}

/// The milestones of a family, with their results and failures.
struct Milestones<'a> {
    family: &'a FamilyEntry,
    folder: &'a Folder,
    jobs: &'a [Job],
    failures: &'a BTreeMap<JobName, String>,
    effort: Effort,
}

/// The user's notes on a section. Their file is in the folder's directory `notes` and is named after all results that
/// the section uses: `point-mass-r2.md`, `point-mass-r2+point-mass-r2-longer.md`.
fn notes(folder: &Folder, from: &[(&str, &str)]) -> anyhow::Result<String> {
    let names: Vec<String> = from
        .iter()
        .map(|(experiment, suffix)| format!("{experiment}{suffix}"))
        .collect();
    let path = folder.path().join("notes").join(format!("{}.md", names.join("+")));
    match std::fs::read_to_string(&path) {
        Ok(text) => Ok(text),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(String::new()),
        Err(error) => Err(error).with_context(|| format!("cannot read {}", path.display())),
    }
}

impl Milestones<'_> {
    /// Whether results of the family were requested or exist.
    fn are_in_report(&self) -> bool {
        let mut experiments = self.family.experiments.iter();
        experiments.any(|experiment| {
            experiment
                .milestones
                .iter()
                .any(|milestone| self.line(experiment, milestone).1)
        })
    }

    /// The seeds that a section uses and the seeds that are missing, a line for each milestone. `None` if none were
    /// requested and none exist.
    fn seeds_of(&self, section: &ReportSection) -> Option<Vec<String>> {
        let (mut lines, mut in_report) = (Vec::new(), false);
        for (name, suffix) in &section.from {
            let experiment = self
                .family
                .experiments
                .iter()
                .find(|experiment| experiment.name == *name);
            let found = experiment
                .and_then(|it| Some((it, it.milestones.iter().find(|milestone| milestone.suffix == *suffix)?)));
            if let Some((experiment, milestone)) = found {
                let (line, line_in_report) = self.line(experiment, milestone);
                lines.push(line);
                in_report |= line_in_report;
            }
        }
        in_report.then_some(lines)
    }

    /// The line of a milestone, and whether any of its seeds were requested or exist.
    fn line(&self, experiment: &Experiment, milestone: &Milestone) -> (String, bool) {
        let found = self.folder.seeds(experiment, milestone);
        let requested = self.jobs.iter().filter(|job| job.experiment.name == experiment.name);
        let missing: Vec<u64> = requested
            .map(|job| job.seed)
            .filter(|seed| !found.contains(seed))
            .collect();
        let list = |seeds: &[u64]| seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(", ");
        let mut line = format!(
            "`{}`, {}: {}",
            experiment.name,
            milestone.length(self.effort),
            if found.is_empty() {
                "no results yet".into()
            } else {
                format!("seeds {}", list(&found))
            }
        );
        if !missing.is_empty() {
            line += &format!("; missing: {}", list(&missing));
        }
        for seed in &missing {
            if let Some(message) = self.failures.get(&(experiment.name, *seed)) {
                line += &format!("; seed {seed} failed: {message}");
            }
        }
        (line, !found.is_empty() || !missing.is_empty())
    }
}

/// The start of the report of a quick look.
const QUICK_LOOK: &str = "\
> This is a quick look with few seeds, tiny networks and few environment steps. It shows that everything works; it
> checks no claim.

";

fn compose(sections: &[(ReportSection, Vec<String>, String)], effort: Effort, figures: &Path) -> String {
    let mut text = String::from("# Reproduction of the thesis's experiments\n\n");
    let quick = if effort == Effort::Quick { " --quick" } else { "" };
    if effort == Effort::Quick {
        text += QUICK_LOOK;
    }
    let _ = writeln!(
        text,
        "\
Made by `shoal reproduce{quick}`, version {}. Each seed is a run of the whole system in lockstep, so the same seed gives
the same bits on the same kind of machine. Unless stated otherwise, numbers are those of each run's best policy by
evaluation, as median over the seeds [minimum, maximum].

A claim about single runs holds if more than half of the seeds meet its criterion. A claim about all seeds together is
checked once.",
        env!("CARGO_PKG_VERSION")
    );
    if effort == Effort::Full {
        let verdicts: Vec<Verdict> = sections
            .iter()
            .flat_map(|(section, _, _)| &section.claims)
            .map(|claim| claim.verdict(effort))
            .collect();
        let count = |which: fn(&Verdict) -> bool| verdicts.iter().filter(|verdict| which(verdict)).count();
        let _ = writeln!(
            text,
            "\nOf {} claims, {} hold, {} do not, and {} were not checked.",
            verdicts.len(),
            count(|verdict| matches!(verdict, Verdict::Holds { .. } | Verdict::HoldsTogether)),
            count(|verdict| matches!(verdict, Verdict::Fails { .. } | Verdict::FailsTogether)),
            count(|verdict| *verdict == Verdict::NotChecked)
        );
    }
    for (section, seeds, notes) in sections {
        let _ = write!(text, "\n## {}\n\n", section.title);
        for line in seeds {
            let _ = writeln!(text, "- {line}");
        }
        if !section.remark.is_empty() {
            let _ = write!(text, "\n{}\n", section.remark);
        }
        if !section.claims.is_empty() {
            text += "\n| claim | our result | criterion | verdict |\n| --- | --- | --- | --- |\n";
        }
        for claim in &section.claims {
            let Claim {
                statement,
                criterion,
                measured,
                ..
            } = claim;
            let _ = writeln!(
                text,
                "| {statement} | {measured} | {criterion} | {} |",
                claim.verdict(effort)
            );
        }
        if !notes.is_empty() {
            let _ = write!(text, "\n{}\n", notes.trim_end());
        }
        for Figure { file, caption, png } in &section.figures {
            let path = figures.join(file);
            let path = path.display();
            let link = if *png {
                format!(" ([PNG]({path}.png))")
            } else {
                String::new()
            };
            let _ = write!(text, "\n![{caption}]({path}.svg)\n\n*{caption}*{link}\n");
        }
    }
    text
}

fn parent_of(path: &Path) -> &Path {
    path.parent()
        .filter(|parent| !parent.as_os_str().is_empty())
        .unwrap_or(Path::new("."))
}

/// The relative path from the directory `from` to `path`. Both are absolute, without `..` and symbolic links.
fn relative(path: &Path, from: &Path) -> PathBuf {
    let common = path
        .components()
        .zip(from.components())
        .take_while(|(a, b)| a == b)
        .count();
    let up = from.components().skip(common).map(|_| Component::ParentDir);
    up.chain(path.components().skip(common)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_report::figure;

    #[test]
    fn links_are_relative_to_the_report() {
        let link = |path, from| relative(Path::new(path), Path::new(from)).display().to_string();
        assert_eq!(link("/a/b/figures", "/a/b"), "figures");
        assert_eq!(link("/a/runs/x/figures", "/a/docs"), "../runs/x/figures");
        assert_eq!(link("/x", "/a/docs"), "../../x");
    }

    #[test]
    fn a_report_contains_verdicts_notes_figures_and_missing_seeds() {
        let section = |held: &[bool], png| ReportSection {
            title: "Pendulum",
            from: vec![("pendulum", "")],
            remark: "Upright is 0.".into(),
            claims: vec![Claim::each_seed(
                "it swings up",
                "it is up",
                "0.01".into(),
                held.iter().copied(),
            )],
            figures: vec![Figure {
                file: "swing".into(),
                caption: "Figure 4.9".into(),
                png,
            }],
        };
        let of = |held: &[bool], effort, png| {
            let seeds = vec!["`pendulum`: seeds 1; missing: 2".into()];
            let notes = "It leans a little.\n".into();
            compose(&[(section(held, png), seeds, notes)], effort, Path::new("figures"))
        };
        let full = of(&[true], Effort::Full, false);
        for part in [
            "Of 1 claims, 1 hold, 0 do not, and 0 were not checked.",
            "| it swings up | 0.01 | it is up | **holds** for the only seed |",
            "missing: 2",
            "It leans a little.",
            "![Figure 4.9](figures/swing.svg)\n\n*Figure 4.9*\n",
        ] {
            assert!(full.contains(part), "{part}: {full}");
        }
        let quick = of(&[true], Effort::Quick, true);
        assert!(quick.contains("quick look") && quick.contains("| not checked |") && !quick.contains("**holds**"));
        assert!(quick.contains("*Figure 4.9* ([PNG](figures/swing.png))"), "{quick}");
        assert!(of(&[false], Effort::Full, false).contains("**does not hold**"));
    }

    #[test]
    fn notes_appear_in_the_section_with_the_same_results() {
        let directory = tempfile::tempdir().unwrap();
        let folder = Folder::open(directory.path(), []).unwrap();
        std::fs::create_dir(directory.path().join("notes")).unwrap();
        for (name, text) in [("a.md", "of a"), ("a+a-longer.md", "of both")] {
            std::fs::write(directory.path().join("notes").join(name), text).unwrap();
        }
        let of = |from: &[(&str, &str)]| notes(&folder, from).unwrap();
        assert_eq!(of(&[("a", "")]), "of a");
        assert_eq!(of(&[("a", ""), ("a", "-longer")]), "of both");
        assert_eq!(of(&[("a", ""), ("b", "")]), "");
    }

    #[test]
    fn a_png_is_made_on_request_and_again_only_after_a_change() {
        let directory = tempfile::tempdir().unwrap();
        let path = |ending| directory.path().join(format!("a.{ending}"));
        let draw = |png: bool, value: f64| {
            let writer = FigureWriter::in_directory(directory.path().into(), png).unwrap();
            let curve = vec![vec![(1_000, value), (2_000, 1.0)]];
            let figure = writer.add("a", "A", |path| figure::learning_curves("A", &curve, None, path));
            assert_eq!(figure.unwrap().png, png);
            assert!(path("svg").exists());
            std::fs::read(path("png")).ok()
        };
        assert_eq!(draw(false, 1.0), None);
        let first = draw(true, 1.0);
        assert!(first.as_ref().is_some_and(|bytes| bytes.starts_with(b"\x89PNG")));
        std::fs::write(path("png"), "mine").unwrap();
        assert_eq!(draw(true, 1.0).unwrap(), b"mine", "nothing has changed");
        assert_eq!(draw(false, 1.0).unwrap(), b"mine", "nothing has changed");
        assert_ne!(draw(true, 2.0).unwrap(), b"mine");
        assert_eq!(draw(false, 3.0), None, "an outdated PNG is removed");
        assert_eq!(first, draw(true, 1.0));
    }
}
