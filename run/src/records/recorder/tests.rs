use std::io::Write;

use proptest::prelude::*;

use super::*;

fn run() -> (tempfile::TempDir, RunDir) {
    let parent = tempfile::tempdir().unwrap();
    let run = RunDir::create(&parent.path().join("run")).unwrap();
    (parent, run)
}

fn without_warmup() -> ReplayConfig {
    ReplayConfig {
        warmup: 0,
        ..ReplayConfig::default()
    }
}

fn episode(env_steps: u64) -> EpisodeReport {
    EpisodeReport {
        actor: 1,
        environment: 0,
        steps: 200,
        terminated: 0,
        episode_return: -1234.5,
        policy_version: 7,
        env_steps,
    }
}

fn evaluation(env_steps: u64, return_mean: f64) -> EvaluationReport {
    EvaluationReport {
        policy_version: 9,
        env_steps,
        updates: 1_000,
        return_mean,
        return_std: 90.0,
        episodes: 10,
        best: 1,
    }
}

fn learner(env_steps: u64, updates: u64, averaged: u64) -> LearnerReport {
    let policy_version = updates / 10;
    LearnerReport {
        env_steps,
        episodes: 0,
        updates,
        policy_version,
        critic_loss: 0.5,
        actor_loss: 20.0,
        q_mean: -20.0,
        temperature: 0.25,
        averaged,
    }
}

fn seconds(n: f64) -> Duration {
    Duration::from_secs_f64(n)
}

fn text(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn every_report_becomes_a_row() {
    let (_parent, run) = run();
    let mut recorder = Recorder::open(&run, &ReplayConfig::default()).unwrap();
    recorder.episode(&episode(200), seconds(0.25)).unwrap();
    recorder
        .evaluation(&evaluation(2_000, -1_500.25), seconds(1.0))
        .unwrap();
    recorder.learner(&learner(1_000, 0, 0), seconds(1.5)).unwrap();
    recorder.learner(&learner(2_000, 500, 500), seconds(2.0)).unwrap();

    assert_eq!(
        text(&run.episodes()),
        "wall_seconds,env_steps,actor,environment,steps,terminated,return,policy_version\n\
         0.25,200,1,0,200,0,-1234.5,7\n"
    );
    assert_eq!(
        text(&run.evaluations()),
        "wall_seconds,env_steps,updates,policy_version,return_mean,return_std,episodes,best\n\
         1.0,2000,1000,9,-1500.25,90.0,10,1\n"
    );
    assert_eq!(
        text(&run.learner_records()),
        "wall_seconds,env_steps,episodes,updates,policy_version,critic_loss,actor_loss,q_mean,updates_per_second,\
         env_steps_per_second,ratio,temperature\n\
         1.5,1000,0,0,0,,,,,,,\n\
         2.0,2000,0,500,50,0.5,20.0,-20.0,1000.0,2000.0,0.5,0.25\n"
    );
    let events = std::fs::read_dir(run.tensorboard()).unwrap().next().unwrap().unwrap();
    assert!(events.metadata().unwrap().len() > 200);
}

#[test]
fn a_resumed_run_continues_the_same_tables() {
    let (_parent, run) = run();
    for session in 0..3 {
        let mut recorder = Recorder::open(&run, &without_warmup()).unwrap();
        recorder
            .evaluation(&evaluation(1_000 * session, -100.0), seconds(1.0))
            .unwrap();
        recorder
            .learner(&learner(1_000 * session, 10, 1), seconds(10.0))
            .unwrap();
    }
    let evaluations = read_evaluations(&run.evaluations()).unwrap();
    assert_eq!(
        evaluations.iter().map(|e| e.env_steps).collect::<Vec<_>>(),
        [0, 1_000, 2_000]
    );
    assert_eq!(
        evaluations.iter().map(|e| e.wall_seconds).collect::<Vec<_>>(),
        [1.0, 11.0, 21.0]
    );
    assert_eq!(
        text(&run.evaluations()).matches("wall_seconds").count(),
        1,
        "one header"
    );
    assert_eq!(std::fs::read_dir(run.tensorboard()).unwrap().count(), 3);
}

#[test]
fn a_line_cut_short_by_a_crash_is_removed() {
    let (_parent, run) = run();
    let mut recorder = Recorder::open(&run, &without_warmup()).unwrap();
    recorder.evaluation(&evaluation(1_000, -100.0), seconds(1.0)).unwrap();
    drop(recorder);
    let mut file = std::fs::OpenOptions::new()
        .append(true)
        .open(run.evaluations())
        .unwrap();
    file.write_all(b"2.0,2000,10").unwrap();
    assert_eq!(read_evaluations(&run.evaluations()).unwrap().len(), 1);
    let mut recorder = Recorder::open(&run, &without_warmup()).unwrap();
    recorder.evaluation(&evaluation(3_000, -90.0), seconds(3.0)).unwrap();
    let evaluations = read_evaluations(&run.evaluations()).unwrap();
    assert_eq!(
        evaluations.iter().map(|e| e.env_steps).collect::<Vec<_>>(),
        [1_000, 3_000]
    );
}

#[test]
fn incidents_are_written_at_once_with_their_time_and_steps() {
    let (_parent, run) = run();
    assert_eq!(
        read_incidents(&run.incidents()).unwrap(),
        None,
        "as in a run of an earlier version"
    );
    let killed = Incident {
        role: "actor",
        index: 3,
        what: IncidentKind::Killed,
        detail: "killed by signal 9".into(),
    };
    let mut recorder = Recorder::open(&run, &without_warmup()).unwrap();
    recorder.learner(&learner(2_000, 500, 1), seconds(1.0)).unwrap();
    recorder.incident(&killed, seconds(1.5)).unwrap();
    let first = "wall_seconds,env_steps,role,index,what,detail\n1.5,2000,actor,3,killed,killed by signal 9\n";
    assert_eq!(text(&run.incidents()), first);
    drop(recorder);

    let mut recorder = Recorder::open(&run, &without_warmup()).unwrap();
    recorder.incident(&killed, seconds(0.5)).unwrap();
    let second = "1.0,2000,launcher,0,resumed,\n1.5,2000,actor,3,killed,killed by signal 9\n";
    assert_eq!(text(&run.incidents()), format!("{first}{second}"));
    assert_eq!(read_incidents(&run.incidents()).unwrap().unwrap().len(), 3);
}

#[test]
fn a_learner_that_fell_back_to_a_checkpoint_has_no_update_rate() {
    let (_parent, run) = run();
    let mut recorder = Recorder::open(&run, &without_warmup()).unwrap();
    recorder.learner(&learner(2_000, 500, 1), seconds(1.0)).unwrap();
    recorder.learner(&learner(2_500, 400, 1), seconds(2.0)).unwrap();
    let rows: Vec<LearnerRecord> = table::rows(&run.learner_records()).unwrap();
    assert_eq!(
        (rows[1].updates_per_second, rows[1].env_steps_per_second),
        (None, Some(500.0))
    );
}

#[test]
fn recorded_steps_never_fall_after_a_learners_restart_or_a_resume() {
    let (_parent, run) = run();
    let mut recorder = Recorder::open(&run, &without_warmup()).unwrap();
    for steps in [1_000, 2_000, 1_200, 1_900, 2_000, 2_300] {
        recorder
            .learner(&learner(steps, steps / 2, 1), seconds(steps as f64 / 1e3))
            .unwrap();
        recorder.episode(&episode(steps), seconds(steps as f64 / 1e3)).unwrap();
    }
    drop(recorder);
    // A new launcher, whose learner begins at an older checkpoint.
    let mut recorder = Recorder::open(&run, &without_warmup()).unwrap();
    for steps in [1_500, 2_299, 2_600] {
        recorder.learner(&learner(steps, steps / 2, 1), seconds(1.0)).unwrap();
        recorder.episode(&episode(steps), seconds(1.0)).unwrap();
    }
    drop(recorder);
    let learned = read_learner(&run.learner_records()).unwrap();
    let learned: Vec<u64> = learned.iter().map(|row| row.env_steps).collect();
    assert_eq!(learned, [1_000, 2_000, 2_000, 2_300, 2_600]);
    let explored = read_episodes(&run.episodes()).unwrap();
    let explored: Vec<u64> = explored.iter().map(|row| row.env_steps).collect();
    assert_eq!(
        explored,
        [1_000, 2_000, 2_000, 2_000, 2_000, 2_300, 2_300, 2_300, 2_600],
        "no episode is left out"
    );
    let incidents = read_incidents(&run.incidents()).unwrap().unwrap();
    assert_eq!(incidents.last().unwrap().env_steps, 2_300);
}

#[test]
fn every_table_has_its_header_from_the_start() {
    let (_parent, run) = run();
    let header = "wall_seconds,env_steps,role,index,what,detail\n";
    for _ in 0..2 {
        let recorder = Recorder::open(&run, &without_warmup()).unwrap();
        assert_eq!(text(&run.incidents()), header);
        drop(recorder);
    }
    for table in [run.episodes(), run.evaluations(), run.learner_records()] {
        assert_eq!(text(&table).lines().count(), 1);
    }
    assert_eq!(read_incidents(&run.incidents()).unwrap(), Some(Vec::new()));
}

#[test]
fn a_table_of_an_earlier_version_gets_the_columns_that_it_lacks() {
    let (_parent, run) = run();
    let old = "wall_seconds,env_steps,updates,policy_version,critic_loss,actor_loss,q_mean,updates_per_second,\
               env_steps_per_second,ratio\n1.5,300,20,3,0.25,,-1.0,10.0,20.0,\n";
    // The last line was cut short.
    std::fs::write(run.learner_records(), format!("{old}2.5,4")).unwrap();
    drop(Recorder::open(&run, &without_warmup()).unwrap());
    let new = text(&run.learner_records());
    assert_eq!(
        new.lines().collect::<Vec<_>>(),
        [
            "wall_seconds,env_steps,episodes,updates,policy_version,critic_loss,actor_loss,q_mean,updates_per_second,\
             env_steps_per_second,ratio,temperature",
            "1.5,300,0,20,3,0.25,,-1.0,10.0,20.0,,"
        ]
    );
    drop(Recorder::open(&run, &without_warmup()).unwrap());
    assert_eq!(text(&run.learner_records()), new);
    // A column that no version lacked.
    let foreign = old.replace("env_steps,updates", "updates").replace("300,", "");
    std::fs::write(run.learner_records(), &foreign).unwrap();
    assert!(Recorder::open(&run, &without_warmup()).is_err());
    assert_eq!(text(&run.learner_records()), foreign);
}

#[test]
fn a_foreign_file_and_a_full_disk_are_one_line_errors() {
    let (_parent, run) = run();
    std::fs::write(run.evaluations(), "a,b\n1,2\n").unwrap();
    let message = Recorder::open(&run, &without_warmup()).unwrap_err().to_string();
    assert!(
        message.contains("its first line is \"a,b\", not \"wall_seconds,") && !message.contains('\n'),
        "{message}"
    );
    assert_eq!(text(&run.evaluations()), "a,b\n1,2\n", "left unchanged");

    // Also if the last line has no newline: it is not taken for a line that was cut short.
    for foreign in [
        "a,b",
        "a,b\n1,2",
        "wall_seconds,env_steps,a",
        "wall_seconds,env_steps\n1",
    ] {
        std::fs::write(run.evaluations(), foreign).unwrap();
        assert!(Recorder::open(&run, &without_warmup()).is_err(), "{foreign:?}");
        assert_eq!(text(&run.evaluations()), foreign);
    }
    // A header that was cut short is replaced.
    std::fs::write(run.evaluations(), "wall_seconds,env_").unwrap();
    Recorder::open(&run, &without_warmup()).unwrap();

    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut full = Table::onto(Path::new("/dev/full"), full);
    let error = full
        .write(&EvaluationRecord::default())
        .and_then(|()| full.flush())
        .unwrap_err();
    assert!(
        error.to_string().starts_with("cannot write /dev/full: No space left"),
        "{error}"
    );
}

#[test]
fn a_run_without_evaluations_is_valid() {
    let (_parent, run) = run();
    assert_eq!(read_evaluations(&run.evaluations()).unwrap(), []);
    Recorder::open(&run, &without_warmup()).unwrap();
    assert_eq!(read_evaluations(&run.evaluations()).unwrap(), []);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    /// Any content is read or gives an error. A refused file is left unchanged; an accepted one loses at most an
    /// incomplete last line.
    #[test]
    fn any_file_is_continued_or_refused(
        header in any::<bool>(),
        lines in prop::collection::vec("[-0-9.,eENainf\"]{0,40}\n", 0..5),
        numbers in prop::collection::vec((any::<f64>(), any::<u64>(), any::<f64>()), 0..5),
        end in prop::collection::vec(any::<u8>(), 0..50),
    ) {
        let (_parent, run) = run();
        let mut bytes = vec![];
        if header {
            bytes.extend(b"wall_seconds,env_steps,updates,policy_version,return_mean,return_std,episodes,best\n");
        }
        bytes.extend(lines.concat().bytes());
        for (seconds, steps, mean) in numbers {
            bytes.extend(format!("{seconds:e},{steps},1,1,{mean},0.0,10,1\n").bytes());
        }
        bytes.extend(&end);
        std::fs::write(run.evaluations(), &bytes).unwrap();
        if let Err(error) = read_evaluations(&run.evaluations()) {
            prop_assert!(!error.to_string().contains('\n'), "{}", error);
        }
        prop_assert_eq!(&std::fs::read(run.evaluations()).unwrap(), &bytes);
        let opened = Table::open::<EvaluationRecord>(&run.evaluations());
        let after = std::fs::read(run.evaluations()).unwrap();
        match opened {
            Ok(_) => {
                let is_new = !bytes.contains(&b'\n');
                let cut = bytes.strip_prefix(&after[..]).or(is_new.then_some(&bytes[..]));
                prop_assert!(cut.is_some_and(|cut| !cut.contains(&b'\n')));
            }
            Err(_) => prop_assert_eq!(after, bytes),
        }
    }
}
