//! The replay file with real processes: killed writers, concurrent readers, and resource limits.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use shoal_common::commit::{CommitReader, CommitRecord};
use shoal_common::transition::RowLayout;
use shoal_learner::process::checkpoint::{CheckpointError, Checkpoints, Counters};
use shoal_learner::replay::{ChunkId, Replay, ReplayError, ReplayLayout};
use tempfile::TempDir;

const ACTORS: usize = 2;
/// The environment variable with the file's path for child processes, which run an ignored test of this binary.
const PATH: &str = "SHOAL_TEST_PATH";

fn layout() -> ReplayLayout {
    ReplayLayout {
        row: RowLayout::new(1, 1),
        ring: 4096,
        actors: ACTORS,
        actor_snapshot_words: 0,
        fingerprint: 1,
    }
}

fn path_of_child() -> PathBuf {
    std::env::var_os(PATH).expect("the parent test starts this one").into()
}

fn rows_of(actor: usize, sequence: u64) -> u64 {
    1 + (sequence * 7 + actor as u64 * 3) % 40
}

fn append(replay: &mut Replay, actor: usize) {
    let sequence = replay.committed(actor).last_chunk.sequence + 1;
    let rows = rows_of(actor, sequence);
    let row = |i| [actor as f32, sequence as f32, i as f32, rows as f32, -1.0, 0.5];
    let numbers: Vec<f32> = (0..rows).flat_map(row).collect();
    replay
        .append_and_commit(
            actor,
            ChunkId {
                incarnation: 0,
                sequence,
            },
            &numbers,
        )
        .unwrap();
}

/// A child process that is killed when the test ends.
struct Writer(Child);

impl Writer {
    fn start(test: &str, path: &Path) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args([test, "--exact", "--ignored"])
            .env(PATH, path)
            .stdout(Stdio::null());
        Self(command.spawn().unwrap())
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
#[ignore = "a child of the tests below"]
fn child_appends_forever() {
    let path = path_of_child();
    let mut replay = match Replay::open(&path, &layout()) {
        Err(ReplayError::Missing(_)) => Replay::create(&path, &layout()).unwrap(),
        replay => replay.unwrap(),
    };
    assert_eq!(replay.warnings(), &[] as &[String]);
    for round in 1_u64.. {
        // The actors take turns, also after a kill between the two.
        let actor = usize::from(replay.committed(0).last_chunk > replay.committed(1).last_chunk);
        append(&mut replay, actor);
        if round.is_multiple_of(2000) {
            replay.flush().unwrap();
        }
    }
}

/// Asserts that a record is of one moment: the actors' rows add up to its head, and the actors took turns.
fn check_record(record: &CommitRecord) {
    let actors = (0..ACTORS).map(|actor| record.actor(actor));
    assert_eq!(actors.map(|actor| actor.rows).sum::<u64>(), record.head());
    assert!(record.actor(0).last_chunk.sequence - record.actor(1).last_chunk.sequence <= 1);
}

/// Asserts that the rows are those of each actor's chunks, from chunk 1 to the last, whole and in order, as far back as
/// the ring goes.
fn check_rows(replay: &Replay) {
    for actor in 0..ACTORS {
        let commit = replay.committed(actor);
        assert_eq!(
            commit.rows,
            (1..=commit.last_chunk.sequence)
                .map(|sequence| rows_of(actor, sequence))
                .sum::<u64>()
        );
    }
    // Backwards from the newest chunk: actor 1 wrote last if it has as many as actor 0.
    let (mut sequence, mut actor) = match [0, 1].map(|actor| replay.committed(actor).last_chunk.sequence) {
        [first, second] if first == second => (second, 1),
        [first, _] => (first, 0),
    };
    let mut left = rows_of(actor, sequence);
    for index in replay.rows().rev() {
        if left == 0 {
            (sequence, actor) = if actor == 1 { (sequence, 0) } else { (sequence - 1, 1) };
            left = rows_of(actor, sequence);
        }
        left -= 1;
        let rows = rows_of(actor, sequence) as f32;
        assert_eq!(
            replay.row(index),
            [actor as f32, sequence as f32, left as f32, rows, -1.0, 0.5],
            "row {index}"
        );
    }
}

#[test]
fn a_learner_killed_repeatedly_loses_nothing_that_was_committed() {
    let directory = TempDir::new().unwrap();
    let path = directory.path().join("replay.rows");
    let mut seen = 0;
    for kill in 0..40 {
        let writer = Writer::start("processes::child_appends_forever", &path);
        let start = Instant::now();
        let reader = loop {
            if let Some(reader) = CommitReader::open_if_ready(&path).unwrap() {
                break reader;
            }
            assert!(start.elapsed() < Duration::from_secs(20));
        };
        // Wait until it commits, and then up to 16 ms more: a different time before each kill.
        let before = seen;
        let mut until = None;
        while until.is_none_or(|until| Instant::now() < until) {
            let record = reader.snapshot().unwrap();
            check_record(&record);
            assert!(record.head() >= seen, "the number of committed rows never decreases");
            seen = record.head();
            if seen > before && until.is_none() {
                until = Some(Instant::now() + Duration::from_micros(kill * 397));
            }
            assert!(
                start.elapsed() < Duration::from_secs(20),
                "the writer makes no progress"
            );
        }
        drop(writer);
        let replay = Replay::open(&path, &layout()).unwrap();
        assert_eq!(replay.warnings(), &[] as &[String]);
        assert!(replay.head() >= seen);
        seen = replay.head();
        assert!(
            replay.rows().end - replay.rows().start >= 4096.min(seen) - 40,
            "{:?}",
            replay.rows()
        );
        check_rows(&replay);
    }
    assert!(seen > 2 * 4096, "the ring wrapped around: {seen}");
}

#[test]
fn readers_see_whole_records_that_only_grow() {
    let directory = TempDir::new().unwrap();
    let path = directory.path().join("replay.rows");
    let mut replay = Replay::create(&path, &layout()).unwrap();
    let check = |reader: &CommitReader, head: &mut u64, ids: &mut [ChunkId]| {
        let record = reader.snapshot().expect("a published record can always be read");
        check_record(&record);
        assert!(record.head() >= *head && reader.rows() >= record.head());
        *head = record.head();
        for (actor, id) in ids.iter_mut().enumerate() {
            let now = reader.actor(actor);
            assert!(now.last_chunk >= *id && now.last_chunk >= record.actor(actor).last_chunk);
            *id = now.last_chunk;
        }
    };
    let reader = CommitReader::open(&path).unwrap();
    std::thread::scope(|scope| {
        let writer = scope.spawn(|| {
            for _ in 0..200_000 {
                append(&mut replay, 0);
                append(&mut replay, 1);
            }
        });
        let (mut head, mut ids) = (0, [ChunkId::default(); ACTORS]);
        while !writer.is_finished() {
            check(&reader, &mut head, &mut ids);
        }
        assert!(head > 0);
    });
    assert_eq!(reader.rows(), 400_000 / 40 * (1..=40).sum::<u64>());
}

/// Runs an ignored test under a file-size limit of 8 KiB, after `set_up` in the shell.
fn under_limit(set_up: &str, test: &str, path: &Path) {
    let status = Command::new("sh")
        .args(["-c", &format!("{set_up} ulimit -f 16; exec \"$0\" \"$@\"")])
        .arg(std::env::current_exe().unwrap())
        .args([test, "--exact", "--ignored"])
        .env(PATH, path)
        .stdout(Stdio::null())
        .status()
        .unwrap();
    assert!(status.success(), "{status}");
}

#[test]
#[ignore = "a child of the test below"]
fn child_creates_a_replay_that_is_too_large() {
    let path = path_of_child();
    let error = Replay::create(&path, &layout()).unwrap_err();
    let bytes = layout().offsets().unwrap().end;
    assert!(matches!(error, ReplayError::NoSpace { .. }), "{error}");
    let line = error.to_string();
    assert!(
        line.contains("replay.rows") && line.contains(&format!("needs {bytes} bytes")),
        "{line}"
    );
    assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 0);
}

#[test]
fn a_replay_beyond_the_file_size_limit_is_an_error_and_leaves_no_file() {
    let directory = TempDir::new().unwrap();
    // SIGXFSZ would end the child, which does not ignore it.
    under_limit(
        "",
        "processes::child_creates_a_replay_that_is_too_large",
        &directory.path().join("replay.rows"),
    );
}

#[test]
#[ignore = "a child of the test below"]
fn child_writes_a_checkpoint_that_is_too_large() {
    let directory = path_of_child();
    let mut store = Checkpoints::new(&directory, 1);
    let error = store
        .save(
            &Counters {
                updates: 2,
                ..Counters::default()
            },
            &[("actor", &[1.0; 5000])],
        )
        .unwrap_err();
    assert!(matches!(error, CheckpointError::Write { .. }), "{error}");
    assert!(error.to_string().contains("latest.ckpt"), "{error}");
}

#[test]
fn a_checkpoint_without_space_leaves_the_last_one() {
    let directory = TempDir::new().unwrap();
    let mut store = Checkpoints::new(directory.path(), 1);
    store
        .save(
            &Counters {
                updates: 1,
                ..Counters::default()
            },
            &[("actor", &[1.0; 5000])],
        )
        .unwrap();
    under_limit(
        "trap '' XFSZ;",
        "processes::child_writes_a_checkpoint_that_is_too_large",
        directory.path(),
    );
    let loaded = store.load_newest().unwrap().unwrap();
    assert_eq!((loaded.checkpoint.counters.updates, loaded.warnings.len()), (1, 0));
    assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
}
