//! `REPORT.md`: the claims with their verdicts, and the figures.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Component, Path, PathBuf};

use anyhow::Context;
use shoal_common::durable::write_atomically;

use super::album::{Album, Figure, Section};
use super::claim::{Claim, Verdict};
use super::experiment::{Effort, Experiment, Stage};
use super::family::Entry;
use super::folder::Folder;
use super::order::{Job, Name, Order};

/// Writes the report from all results of the folder, and draws its figures.
pub(super) fn write(
    families: &[Entry],
    folder: &Folder,
    order: &Order,
    jobs: &[Job],
    failures: &BTreeMap<Name, String>,
) -> anyhow::Result<()> {
    let figures = folder.path().join("figures");
    let album = Album::in_directory(figures.clone(), order.png)?;
    let mut sections = Vec::new();
    for family in families {
        let stages = Stages {
            family,
            folder,
            jobs,
            failures,
            effort: order.effort,
        };
        if !stages.are_of_interest() {
            continue;
        }
        for section in (family.sections)(folder, &album)? {
            if let Some(seeds) = stages.seeds_of(&section) {
                let notes = notes(folder, &section.from)?;
                sections.push((section, seeds, notes));
            }
        }
    }
    let parent = parent_of(&order.report);
    std::fs::create_dir_all(parent).with_context(|| format!("cannot make {}", parent.display()))?;
    let parent = std::fs::canonicalize(parent).with_context(|| format!("cannot resolve {}", parent.display()))?;
    let text = compose(&sections, order.effort, &relative(&figures, &parent));
    write_atomically(&order.report, |file| file.write_all(text.as_bytes()))?;
    Ok(())
}

/// The stages of a family, and what is known of their seeds.
struct Stages<'a> {
    family: &'a Entry,
    folder: &'a Folder,
    jobs: &'a [Job],
    failures: &'a BTreeMap<Name, String>,
    effort: Effort,
}

/// What somebody has written on a section, in `notes` of the folder, in a file named after all that the section is about:
/// `point-mass-r2.md`, `point-mass-r2+point-mass-r2-longer.md`.
fn notes(folder: &Folder, from: &[(&str, &str)]) -> anyhow::Result<String> {
    let about: Vec<String> = from
        .iter()
        .map(|(experiment, suffix)| format!("{experiment}{suffix}"))
        .collect();
    let path = folder.path().join("notes").join(format!("{}.md", about.join("+")));
    match std::fs::read_to_string(&path) {
        Ok(text) => Ok(text),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(String::new()),
        Err(error) => Err(error).with_context(|| format!("cannot read {}", path.display())),
    }
}

impl Stages<'_> {
    /// Whether anything of the family was asked for or is there.
    fn are_of_interest(&self) -> bool {
        let mut experiments = self.family.experiments.iter();
        experiments.any(|experiment| experiment.stages.iter().any(|stage| self.line(experiment, stage).1))
    }

    /// Which seeds a section is made from, and which are missing; none where nobody asked for it and nothing is there.
    fn seeds_of(&self, section: &Section) -> Option<Vec<String>> {
        let (mut lines, mut of_interest) = (Vec::new(), false);
        for (name, suffix) in &section.from {
            let experiment = self
                .family
                .experiments
                .iter()
                .find(|experiment| experiment.name == *name);
            let found = experiment.and_then(|it| Some((it, it.stages.iter().find(|stage| stage.suffix == *suffix)?)));
            if let Some((experiment, stage)) = found {
                let (line, interesting) = self.line(experiment, stage);
                lines.push(line);
                of_interest |= interesting;
            }
        }
        of_interest.then_some(lines)
    }

    fn line(&self, experiment: &Experiment, stage: &Stage) -> (String, bool) {
        let there = self.folder.seeds(experiment, stage);
        let asked = self.jobs.iter().filter(|job| job.experiment.name == experiment.name);
        let missing: Vec<u64> = asked.map(|job| job.seed).filter(|seed| !there.contains(seed)).collect();
        let say = |seeds: &[u64]| seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(", ");
        let mut line = format!(
            "`{}`, {}: {}",
            experiment.name,
            stage.length(self.effort),
            if there.is_empty() {
                "no seed yet".into()
            } else {
                format!("seeds {}", say(&there))
            }
        );
        if !missing.is_empty() {
            line += &format!("; missing: {}", say(&missing));
        }
        for seed in &missing {
            if let Some(said) = self.failures.get(&(experiment.name, *seed)) {
                line += &format!("; seed {seed} failed: {said}");
            }
        }
        (line, !there.is_empty() || !missing.is_empty())
    }
}

fn compose(sections: &[(Section, Vec<String>, String)], effort: Effort, figures: &Path) -> String {
    let mut text = String::from("# The thesis's experiments, done again\n\n");
    let quick = if effort == Effort::Quick { " --quick" } else { "" };
    if effort == Effort::Quick {
        text += "> **A quick look.** A few seeds, tiny networks, hardly any steps: this shows that everything works, and \
            checks nothing.\n\n";
    }
    let _ = writeln!(
        text,
        "Made by `shoal reproduce{quick}`, version {}. Each seed is a run of the whole system in lockstep, so that the same \
        seed gives the same bits on the same kind of machine. The numbers are of each run's best policy by evaluation \
        unless something else is said: the median over the seeds, with the least and the greatest in brackets. A claim \
        about single runs holds when its criterion does for more than half of the seeds; one about the seeds together is \
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
            "\nOf {} claims {} hold, {} do not, {} are not checked.",
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
            text += "\n| the thesis | ours | holds for a seed when | verdict |\n| --- | --- | --- | --- |\n";
        }
        for claim in &section.claims {
            let Claim {
                thesis,
                criterion,
                ours,
                ..
            } = claim;
            let _ = writeln!(text, "| {thesis} | {ours} | {criterion} | {} |", claim.verdict(effort));
        }
        if !notes.is_empty() {
            let _ = write!(text, "\n{}\n", notes.trim_end());
        }
        for Figure { file, caption, png } in &section.figures {
            let place = figures.join(file);
            let place = place.display();
            let link = if *png {
                format!(" ([PNG]({place}.png))")
            } else {
                String::new()
            };
            let _ = write!(text, "\n![{caption}]({place}.svg)\n\n*{caption}*{link}\n");
        }
    }
    text
}

fn parent_of(path: &Path) -> &Path {
    path.parent()
        .filter(|parent| !parent.as_os_str().is_empty())
        .unwrap_or(Path::new("."))
}

/// The way to `path` from the directory `from`; both are whole and without detours.
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
    use super::super::claim::Scope;
    use super::*;
    use shoal_report::figure;

    #[test]
    fn links_are_relative_to_the_report() {
        let way = |path, from| relative(Path::new(path), Path::new(from)).display().to_string();
        assert_eq!(way("/a/b/figures", "/a/b"), "figures");
        assert_eq!(way("/a/runs/x/figures", "/a/docs"), "../runs/x/figures");
        assert_eq!(way("/x", "/a/docs"), "../../x");
    }

    #[test]
    fn a_report_says_what_holds_and_what_is_missing() {
        let section = |held: &[bool], png| Section {
            title: "Pendulum",
            from: vec![("pendulum", "")],
            remark: "Upright is 0.".into(),
            claims: vec![Claim {
                thesis: "it swings up",
                criterion: "it is up",
                ours: "0.01".into(),
                scope: Scope::EachSeed,
                held: held.into(),
            }],
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
            "Of 1 claims 1 hold, 0 do not, 0 are not checked.",
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
    fn notes_stand_in_the_one_section_that_is_about_the_same() {
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
    fn a_figure_is_rasterised_once_and_only_where_that_is_wanted() {
        let directory = tempfile::tempdir().unwrap();
        let path = |ending| directory.path().join(format!("a.{ending}"));
        let draw = |png: bool, value: f64| {
            let album = Album::in_directory(directory.path().into(), png).unwrap();
            let curve = vec![vec![(1_000, value), (2_000, 1.0)]];
            let figure = album.add("a", "A", |path| figure::learning_curves("A", &curve, None, path));
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
        assert_eq!(draw(false, 3.0), None, "none that shows something else");
        assert_eq!(first, draw(true, 1.0));
    }
}
