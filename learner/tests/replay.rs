//! The replay file, crashed and damaged in every way that needs no second process.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use proptest::prelude::*;
use shoal_common::commit::{CommitReader, OpenError, Places};
use shoal_common::transition::RowLayout;
use shoal_learner::replay::{ActorCommit, Appended, ChunkError, ChunkMark, Replay, ReplayError, ReplayLayout, Step};
use tempfile::TempDir;

const ACTORS: usize = 3;
/// Numbers in a row for observations and actions of one number.
const WIDTH: usize = 6;

fn layout(ring: u64) -> ReplayLayout {
    ReplayLayout {
        row: RowLayout::new(1, 1),
        ring,
        actors: ACTORS,
        fingerprint: 0xF00D,
    }
}

fn places(ring: u64) -> Places {
    layout(ring).places().unwrap()
}

fn mark(incarnation: u64, sequence: u64) -> ChunkMark {
    ChunkMark { incarnation, sequence }
}

/// A chunk whose rows say who they are.
fn chunk(actor: usize, mark: ChunkMark, rows: u64) -> Vec<f32> {
    let row = |i| {
        [
            actor as f32,
            mark.incarnation as f32,
            mark.sequence as f32,
            i as f32,
            rows as f32,
            -1.0,
        ]
    };
    (0..rows).flat_map(row).collect()
}

/// What the replay should hold: every row ever committed, and the actors' marks.
#[derive(Clone, Default)]
struct Model {
    rows: Vec<Vec<f32>>,
    actors: [ActorCommit; ACTORS],
}

impl Model {
    /// The next chunk of an actor.
    fn next(&self, actor: usize) -> ChunkMark {
        let last = self.actors[actor].mark;
        mark(last.incarnation, last.sequence + 1)
    }

    fn add(&mut self, actor: usize, mark: ChunkMark, numbers: &[f32]) {
        self.rows.extend(numbers.chunks(WIDTH).map(<[f32]>::to_vec));
        self.actors[actor].mark = mark;
        self.actors[actor].rows += (numbers.len() / WIDTH) as u64;
    }

    fn head(&self) -> u64 {
        self.rows.len() as u64
    }

    /// The replay holds this, and of the rows those that `rows()` says.
    fn check(&self, replay: &Replay) {
        assert_eq!(replay.head(), self.head());
        for (actor, commit) in self.actors.iter().enumerate() {
            assert_eq!(replay.committed(actor), *commit);
        }
        for index in replay.rows() {
            assert_eq!(replay.row(index), self.rows[index as usize]);
        }
    }
}

struct Directory(TempDir);

impl Directory {
    fn new() -> Self {
        Self(TempDir::new().unwrap())
    }

    fn replay(&self) -> PathBuf {
        self.0.path().join("replay.rows")
    }

    fn names(&self) -> Vec<String> {
        fs::read_dir(&self.0)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect()
    }
}

fn reopen(path: &Path, bytes: &[u8], ring: u64) -> Result<Replay, ReplayError> {
    fs::write(path, bytes).unwrap();
    Replay::open(path, &layout(ring))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    /// The file as it stands after each step of each write, opened as a new learner would.
    #[test]
    fn a_learner_killed_after_any_step_leaves_the_last_committed_state(
        ring in 9_u64..60,
        writes in prop::collection::vec((0..ACTORS, 1_u64..9, any::<u32>()), 1..25),
    ) {
        let directory = Directory::new();
        let copy = directory.0.path().join("copy");
        let mut replay = Replay::create(&directory.replay(), &layout(ring)).unwrap();
        let images: Arc<Mutex<Vec<(Step, Vec<u8>)>>> = Arc::default();
        let (path, sink) = (directory.replay(), Arc::clone(&images));
        replay.on_step(move |step| sink.lock().unwrap().push((step, fs::read(&path).unwrap())));

        let mut before = Model::default();
        for (actor, rows, noise) in writes {
            let mark = before.next(actor);
            let numbers = chunk(actor, mark, rows);
            replay.append_and_commit(actor, mark, &numbers).unwrap();
            let mut after = before.clone();
            after.add(actor, mark, &numbers);
            after.check(&replay);
            if noise % 5 == 0 {
                replay.flush().unwrap();
            }

            let mut committed = false;
            for (step, mut image) in images.lock().unwrap().drain(..) {
                committed |= step == Step::Sealed;
                if step == Step::ReachSet {
                    // Killed within the copy: any part of the places about to be written may be anything.
                    for index in before.head()..after.head() {
                        let place = places(ring).rows.start + (index % ring) as usize * 4 * WIDTH;
                        if noise >> (index % 32) & 1 == 1 {
                            image[place + (noise % 24) as usize] ^= 0x55;
                        }
                    }
                }
                let model = if committed { &after } else { &before };
                let mut reopened = reopen(&copy, &image, ring).unwrap();
                prop_assert_eq!(reopened.warnings(), &[] as &[String], "after {:?}", step);
                model.check(&reopened);
                let intact = after.head().max(before.head()).saturating_sub(ring);
                prop_assert!(reopened.rows().start <= intact, "after {:?}: {:?}", step, reopened.rows());

                // The actor sends it again.
                let again = reopened.append_and_commit(actor, mark, &numbers).unwrap();
                prop_assert_eq!(again, if committed { Appended::Duplicate } else { Appended::Accepted });
                after.check(&reopened);
                drop(reopened);
                after.check(&Replay::open(&copy, &layout(ring)).unwrap());
            }
            before = after;
        }
        let rows = replay.rows();
        prop_assert_eq!(rows, before.head().saturating_sub(ring)..before.head());
    }

    /// After a power loss each block of the file is of any moment since the last sync.
    #[test]
    fn a_power_loss_leaves_at_least_what_was_synced(
        before in prop::collection::vec((0..ACTORS, 1_u64..300), 0..12),
        after in prop::collection::vec((0..ACTORS, 1_u64..300), 1..12),
        blocks in prop::collection::vec(any::<prop::sample::Index>(), 64),
    ) {
        let ring = 2000;
        let directory = Directory::new();
        let mut replay = Replay::create(&directory.replay(), &layout(ring)).unwrap();
        let mut model = Model::default();
        let mut states = BTreeMap::from([(0, model.clone())]);
        let mut images = vec![];
        for (number, &(actor, rows)) in before.iter().chain(&after).enumerate() {
            if number == before.len() {
                replay.flush().unwrap();
                images.push(fs::read(directory.replay()).unwrap());
            }
            let mark = model.next(actor);
            let numbers = chunk(actor, mark, rows);
            replay.append_and_commit(actor, mark, &numbers).unwrap();
            model.add(actor, mark, &numbers);
            states.insert(model.head(), model.clone());
            if number >= before.len() {
                images.push(fs::read(directory.replay()).unwrap());
            }
        }
        drop(replay);
        let synced: u64 = before.iter().map(|write| write.1).sum();

        let mut image = images[0].clone();
        for ((number, block), pick) in image.chunks_mut(4096).enumerate().zip(blocks.iter().cycle()) {
            block.copy_from_slice(&pick.get(&images)[number * 4096..][..block.len()]);
        }
        let copy = directory.0.path().join("copy");
        let reopened = reopen(&copy, &image, ring).unwrap();
        let head = reopened.head();
        prop_assert!(head >= synced, "{} of {} synced rows", head, synced);
        states[&head].check(&reopened);
        prop_assert!(reopened.rows().start <= model.head().saturating_sub(ring), "{:?}", reopened.rows());
        drop(reopened);
        states[&head].check(&Replay::open(&copy, &layout(ring)).unwrap());
    }

    #[test]
    fn a_file_of_any_bytes_is_refused(bytes in prop::collection::vec(any::<u8>(), 0..9000), magic in any::<bool>()) {
        let directory = Directory::new();
        let mut bytes = bytes;
        if magic && bytes.len() >= 16 {
            bytes[..8].copy_from_slice(b"SHOALRPL");
            bytes[8..16].copy_from_slice(&1_u64.to_le_bytes());
        }
        let opened = reopen(&directory.replay(), &bytes, 10);
        prop_assert!(matches!(opened, Err(ReplayError::Refused { .. })), "{:?}", opened);
        let reader = CommitReader::open(&directory.replay());
        prop_assert!(matches!(reader, Err(OpenError::Refused { .. })), "{:?}", reader);
        prop_assert_eq!(fs::read(directory.replay()).unwrap(), bytes);
    }

    /// Damage anywhere behind the identity: the rows that are given out are right all the same.
    #[test]
    fn no_damage_passes_for_a_row(
        writes in prop::collection::vec((0..ACTORS, 1_u64..9), 1..20),
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..20),
    ) {
        let ring = 40;
        let (directory, _) = filled(ring, &writes);
        let mut image = fs::read(directory.replay()).unwrap();
        let mut states = BTreeMap::new();
        let mut partial = Model::default();
        states.insert(0, partial.clone());
        for &(actor, rows) in &writes {
            let mark = partial.next(actor);
            partial.add(actor, mark, &chunk(actor, mark, rows));
            states.insert(partial.head(), partial.clone());
        }
        let places = places(ring);
        // The used parts of the file, so that the damage hits something.
        let used: Vec<usize> = (places.selector..places.selector + 16)
            .chain(places.slots.iter().flat_map(|&slot| slot..slot + 104))
            .chain(places.checks.clone())
            .chain(places.rows.clone())
            .collect();
        for (at, byte) in damage {
            image[*at.get(&used)] = byte;
        }
        match reopen(&directory.replay(), &image, ring) {
            Ok(replay) => states[&replay.head()].check(&replay),
            Err(error) => prop_assert!(error.to_string().contains("commit records are damaged"), "{}", error),
        }
    }
}

/// A closed replay into which `writes` (actor, rows) were written in order.
fn filled(ring: u64, writes: &[(usize, u64)]) -> (Directory, Model) {
    let directory = Directory::new();
    let mut replay = Replay::create(&directory.replay(), &layout(ring)).unwrap();
    let mut model = Model::default();
    for &(actor, rows) in writes {
        let mark = model.next(actor);
        let numbers = chunk(actor, mark, rows);
        replay.append_and_commit(actor, mark, &numbers).unwrap();
        model.add(actor, mark, &numbers);
    }
    (directory, model)
}

#[test]
fn a_chunk_is_committed_once_and_an_old_incarnation_no_more() {
    let (directory, mut model) = filled(100, &[(0, 3), (1, 2), (0, 4)]);
    let mut replay = Replay::open(&directory.replay(), &layout(100)).unwrap();
    let mut append = |mark| replay.append_and_commit(0, mark, &chunk(0, mark, 2)).unwrap();
    assert_eq!(append(mark(0, 1)), Appended::Duplicate);
    assert_eq!(append(mark(0, 2)), Appended::Duplicate);
    assert_eq!(append(mark(1, 1)), Appended::Accepted);
    assert_eq!(append(mark(0, 3)), Appended::Duplicate);
    assert_eq!(append(mark(1, 1)), Appended::Duplicate);
    model.add(0, mark(1, 1), &chunk(0, mark(1, 1), 2));
    model.check(&replay);
}

#[test]
fn what_cannot_be_a_chunk_is_refused_and_nothing_written() {
    let (directory, model) = filled(10, &[(0, 10)]);
    let mut replay = Replay::open(&directory.replay(), &layout(10)).unwrap();
    let mut append = |actor, rows: &[f32]| replay.append_and_commit(actor, mark(9, 9), rows).unwrap_err();
    assert_eq!(append(3, &[0.0; 6]), ChunkError::Actor { actor: 3, actors: 3 });
    assert_eq!(
        append(0, &[0.0; 7]),
        ChunkError::Ragged {
            actor: 0,
            numbers: 7,
            width: 6
        }
    );
    assert_eq!(
        append(0, &[0.0; 66]),
        ChunkError::TooLong {
            actor: 0,
            rows: 11,
            ring: 10
        }
    );
    model.check(&replay);
    assert_eq!(replay.rows(), 0..10);
}

#[test]
fn a_chunk_that_was_filled_and_dropped_is_not_committed_and_its_places_are_not_read() {
    let (directory, model) = filled(10, &[(0, 10)]);
    let mut replay = Replay::open(&directory.replay(), &layout(10)).unwrap();
    drop(
        replay
            .begin(1, mark(0, 1))
            .unwrap()
            .unwrap()
            .fill(&chunk(1, mark(0, 1), 3))
            .unwrap(),
    );
    model.check(&replay);
    assert_eq!(replay.rows(), 3..10);
    drop(replay);
    let replay = Replay::open(&directory.replay(), &layout(10)).unwrap();
    model.check(&replay);
    assert_eq!((replay.rows(), replay.warnings()), (3..10, &[] as &[String]));
}

#[test]
fn a_window_is_the_newest_rows_before_its_head() {
    let (directory, _) = filled(100, &[(0, 60), (1, 60)]);
    let replay = Replay::open(&directory.replay(), &layout(100)).unwrap();
    assert_eq!(replay.rows(), 20..120);
    assert_eq!(replay.window(120, 50), 70..120);
    assert_eq!(replay.window(90, 50), 40..90);
    assert_eq!(replay.window(60, 50), 20..60);
    assert_eq!(replay.window(200, 50), 70..120);
    assert!(replay.window(10, 50).is_empty());
}

#[test]
fn a_torn_newest_record_falls_back_to_the_one_before_and_says_so() {
    let (directory, _) = filled(100, &[(0, 3), (1, 2), (0, 4)]);
    let mut image = fs::read(directory.replay()).unwrap();
    let newest = u64::from_le_bytes(image[places(100).selector..][..8].try_into().unwrap());
    let slot = places(100).slots[newest as usize % 2];
    image[slot + 16] ^= 1;
    // An actor that comes first waits: the learner has to mend it.
    fs::write(directory.replay(), &image).unwrap();
    assert!(matches!(
        CommitReader::open(&directory.replay()),
        Err(OpenError::NotYet { .. })
    ));
    let mut replay = reopen(&directory.replay(), &image, 100).unwrap();
    assert_eq!(replay.head(), 5);
    assert_eq!(replay.warnings().len(), 1);
    assert!(
        replay.warnings()[0].contains("is damaged; going on from the newest that is not"),
        "{:?}",
        replay.warnings()
    );
    assert_eq!(
        replay
            .append_and_commit(0, mark(0, 2), &chunk(0, mark(0, 2), 4))
            .unwrap(),
        Appended::Accepted
    );
    assert_eq!(
        CommitReader::open(&directory.replay()).unwrap().committed(0),
        mark(0, 2)
    );

    for slot in places(100).slots {
        image[slot..slot + 104].fill(0);
    }
    drop(replay);
    let error = reopen(&directory.replay(), &image, 100).unwrap_err().to_string();
    assert!(error.contains("all of its commit records are damaged"), "{error}");
    assert_eq!(fs::read(directory.replay()).unwrap(), image);
}

#[test]
fn a_damaged_row_costs_the_rows_before_it() {
    let (directory, model) = filled(100, &[(0, 60), (1, 30)]);
    let mut image = fs::read(directory.replay()).unwrap();
    image[places(100).rows.start + 20 * 4 * WIDTH] ^= 1;
    let replay = reopen(&directory.replay(), &image, 100).unwrap();
    model.check(&replay);
    assert_eq!(replay.rows(), 21..90);
    assert_eq!(
        replay.warnings(),
        ["row 20 is damaged; going on with the 69 rows after it"]
    );
}

#[test]
fn a_file_that_is_not_the_one_meant_is_refused_by_name_and_left_alone() {
    let (directory, _) = filled(100, &[(0, 3)]);
    let path = directory.replay();
    let image = fs::read(&path).unwrap();
    let refused = |image: &[u8], layout: &ReplayLayout, says: &str| {
        fs::write(&path, image).unwrap();
        let error = Replay::open(&path, layout).unwrap_err();
        assert!(matches!(error, ReplayError::Refused { .. }), "{error}");
        let line = error.to_string();
        assert!(
            line.contains(says) && line.contains("replay.rows") && !line.contains('\n'),
            "{line}"
        );
        assert_eq!(fs::read(&path).unwrap(), image);
    };
    let patched = |at: usize, bytes: &[u8]| {
        let mut image = image.clone();
        image[at..at + bytes.len()].copy_from_slice(bytes);
        image
    };
    let right = layout(100);
    refused(&patched(0, b"X"), &right, "not a replay file");
    refused(
        &patched(8, &[9]),
        &right,
        "format version is 9, this program reads version 1",
    );
    refused(&patched(40, &[9]), &right, "header is damaged");
    refused(&[], &right, "cut short: 0 bytes");
    refused(&image[..image.len() / 2], &right, "cut short");
    refused(
        &image[..image.len() - 1],
        &right,
        "bytes, and by its header it should have",
    );
    refused(
        &[&image[..], &[0]].concat(),
        &right,
        "bytes, and by its header it should have",
    );
    refused(
        &image,
        &ReplayLayout {
            ring: 101,
            ..right.clone()
        },
        "its ring has 100 rows, this run's 101",
    );
    refused(
        &image,
        &ReplayLayout {
            actors: 4,
            ..right.clone()
        },
        "it has room for 3 actors, this run's 4",
    );
    refused(
        &image,
        &ReplayLayout {
            row: RowLayout::new(2, 1),
            ..right.clone()
        },
        "observations have 1 numbers",
    );
    refused(
        &image,
        &ReplayLayout {
            row: RowLayout::new(1, 2),
            ..right.clone()
        },
        "actions have 1 numbers",
    );
    refused(
        &image,
        &ReplayLayout {
            fingerprint: 1,
            ..right.clone()
        },
        "another configuration",
    );
    assert!(Replay::open(&path, &right).is_ok());

    let none = ReplayLayout {
        ring: 0,
        ..right.clone()
    };
    assert!(matches!(
        Replay::create(&path, &none),
        Err(ReplayError::Impossible { .. })
    ));
    let endless = ReplayLayout {
        ring: u64::MAX / 2,
        ..right
    };
    assert!(matches!(
        Replay::create(&path, &endless),
        Err(ReplayError::Impossible { .. })
    ));
}

#[test]
fn a_replay_is_made_once_and_written_by_one() {
    let directory = Directory::new();
    let path = directory.replay();
    assert!(matches!(Replay::open(&path, &layout(10)), Err(ReplayError::Missing(_))));
    assert!(matches!(CommitReader::open(&path), Err(OpenError::NotYet { .. })));
    // What a learner killed while it made the file has left.
    fs::write(path.with_extension("rows.new"), "half").unwrap();
    let replay = Replay::create(&path, &layout(10)).unwrap();
    assert_eq!(directory.names(), ["replay.rows"]);
    assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    assert_eq!(fs::metadata(&path).unwrap().len(), places(10).end as u64);
    assert!(matches!(Replay::open(&path, &layout(10)), Err(ReplayError::InUse(_))));
    assert!(matches!(
        Replay::create(&path, &layout(10)),
        Err(ReplayError::Exists(_))
    ));
    drop(replay);
    assert!(matches!(
        Replay::create(&path, &layout(10)),
        Err(ReplayError::Exists(_))
    ));
    assert_eq!(directory.names(), ["replay.rows"]);
    assert_eq!(Replay::open(&path, &layout(10)).unwrap().rows(), 0..0);
}

#[test]
fn a_sync_on_another_thread_counts_once_it_is_finished() {
    let (directory, mut model) = filled(100, &[(0, 30)]);
    let mut replay = Replay::open(&directory.replay(), &layout(100)).unwrap();
    let old = replay.start_sync().unwrap();
    let numbers = chunk(0, mark(0, 2), 5);
    replay.append_and_commit(0, mark(0, 2), &numbers).unwrap();
    let new = replay.start_sync().unwrap();
    let new = std::thread::spawn(|| new.run().unwrap()).join().unwrap();
    replay.finish_sync(new);
    // The slower of two counts for nothing.
    replay.finish_sync(old.run().unwrap());
    model.add(0, mark(0, 2), &numbers);
    drop(replay);
    let mut image = fs::read(directory.replay()).unwrap();
    for slot in &places(100).slots[..2] {
        image[*slot] ^= 1;
    }
    model.check(&reopen(&directory.replay(), &image, 100).unwrap());
}
