//! Records on a disk that is full for a while. The limit on the size of files holds for a whole process, so this test
//! has a process of its own.

use std::time::Duration;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use shoal_common::config::ReplayConfig;
use shoal_common::report::EvaluationReport;
use shoal_common::run_dir::RunDir;
use shoal_run::records::recorder::{RecordError, Recorder, read_evaluations};
use signal_hook::consts::SIGXFSZ;

fn limit_file_size(most: Option<u64>) -> rustix::io::Result<()> {
    let limits = getrlimit(Resource::Fsize);
    let limits = Rlimit {
        current: most.or(limits.maximum),
        ..limits
    };
    setrlimit(Resource::Fsize, limits)
}

#[test]
fn a_record_has_each_row_once_after_a_write_that_was_cut_short() {
    // Without a handler, the signal would end the process.
    signal_hook::flag::register(SIGXFSZ, std::sync::Arc::default()).unwrap();
    let parent = tempfile::tempdir().unwrap();
    let run = RunDir::create(&parent.path().join("run")).unwrap();
    let mut recorder = Recorder::open(&run, &ReplayConfig::default()).unwrap();
    let mut record = |env_steps: u64| {
        let report = EvaluationReport {
            policy_version: 9,
            env_steps,
            updates: 1_000,
            return_mean: -1234.5,
            return_std: 90.0,
            episodes: 10,
            best: 1,
        };
        recorder.evaluation(&report, Duration::from_secs(env_steps))
    };
    record(1).unwrap();
    let size = run.evaluations().metadata().unwrap().len();
    limit_file_size(Some(size + 10)).unwrap();
    let refused = record(2);
    assert!(matches!(refused, Err(RecordError::Write { .. })), "{refused:?}");
    let cut = run.evaluations().metadata().unwrap().len();
    assert_eq!(cut, size + 10, "a part of the row is in the file");
    limit_file_size(None).unwrap();
    record(3).unwrap();
    drop(recorder);

    let rows = read_evaluations(&run.evaluations()).unwrap();
    let steps: Vec<u64> = rows.iter().map(|row| row.env_steps).collect();
    assert_eq!(steps, [1, 2, 3]);
}
