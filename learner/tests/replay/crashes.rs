//! Kills after any step, power losses and damaged bytes, without a second process.

use std::collections::BTreeMap;
use std::fs;
use std::sync::{Arc, Mutex};

use proptest::prelude::*;
use shoal_common::commit::{CommitReader, OpenError};
use shoal_learner::replay::{Appended, Replay, WriteStep};

use crate::model::{ACTORS, Directory, Model, WIDTH, chunk, filled, id, layout, offsets, reopen};

/// The content of the file after each step.
type Images = Vec<(WriteStep, Vec<u8>)>;

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    /// Opens the file as it was after each step of each write, as a new learner would.
    #[test]
    fn a_learner_killed_after_any_step_leaves_the_last_committed_state(
        ring in 9_u64..60,
        writes in prop::collection::vec((0..ACTORS, 1_u64..9, any::<u32>()), 1..25),
    ) {
        let directory = Directory::new();
        let copy = directory.0.path().join("copy");
        let mut replay = Replay::create(&directory.replay(), &layout(ring)).unwrap();
        let images: Arc<Mutex<Images>> = Arc::default();
        let (path, sink) = (directory.replay(), Arc::clone(&images));
        replay.on_step(move |step| sink.lock().unwrap().push((step, fs::read(&path).unwrap())));

        let mut before = Model::default();
        for (actor, rows, noise) in writes {
            let id = before.next(actor);
            let numbers = chunk(actor, id, rows);
            replay.append_and_commit(actor, id, &numbers).unwrap();
            let mut after = before.clone();
            after.add(actor, id, &numbers);
            after.check(&replay);
            if noise % 5 == 0 {
                replay.flush().unwrap();
            }

            let mut committed = false;
            for (step, mut image) in images.lock().unwrap().drain(..) {
                committed |= step == WriteStep::Sealed;
                if step == WriteStep::WriteHorizonSet {
                    // If the kill comes while rows are copied, their places may hold anything.
                    for index in before.head()..after.head() {
                        let place = offsets(ring).rows.start + (index % ring) as usize * 4 * WIDTH;
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
                let again = reopened.append_and_commit(actor, id, &numbers).unwrap();
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

    /// After a power loss each block of the file may be from any moment since the last sync.
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
            let id = model.next(actor);
            let numbers = chunk(actor, id, rows);
            replay.append_and_commit(actor, id, &numbers).unwrap();
            model.add(actor, id, &numbers);
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
        // Later rows may have replaced all synced ones. Then nothing is left to prove.
        let replaced = model.head().saturating_sub(ring);
        prop_assert!(head >= synced || replaced >= synced, "{} of {} synced rows", head, synced);
        states[&head].check(&reopened);
        let all = reopened.rows().start <= replaced || replaced >= synced;
        prop_assert!(all, "{:?} of {} synced rows", reopened.rows(), synced);
        drop(reopened);
        states[&head].check(&Replay::open(&copy, &layout(ring)).unwrap());
    }

    /// After damage anywhere behind the preamble, the readable rows are still right.
    #[test]
    fn a_damaged_row_is_never_readable(
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
            let id = partial.next(actor);
            partial.add(actor, id, &chunk(actor, id, rows));
            states.insert(partial.head(), partial.clone());
        }
        let offsets = offsets(ring);
        // The used parts of the file, so that the damage hits something.
        let used: Vec<usize> = (offsets.published..offsets.published + 16)
            .chain(offsets.slots.iter().flat_map(|&slot| slot..slot + 104))
            .chain(offsets.checks.clone())
            .chain(offsets.rows.clone())
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

#[test]
fn a_torn_newest_record_falls_back_to_the_previous_one_with_a_warning() {
    let (directory, _) = filled(100, &[(0, 3), (1, 2), (0, 4)]);
    let mut image = fs::read(directory.replay()).unwrap();
    let newest = u64::from_le_bytes(image[offsets(100).published..][..8].try_into().unwrap());
    let slot = offsets(100).slots[newest as usize % 2];
    image[slot + 16] ^= 1;
    // An actor that opens it first waits until the learner has repaired it.
    fs::write(directory.replay(), &image).unwrap();
    assert!(matches!(
        CommitReader::open(&directory.replay()),
        Err(OpenError::NotYet { .. })
    ));
    let mut replay = reopen(&directory.replay(), &image, 100).unwrap();
    assert_eq!(replay.head(), 5);
    assert_eq!(replay.warnings().len(), 1);
    assert!(
        replay.warnings()[0].contains("is damaged; continuing from the newest intact one"),
        "{:?}",
        replay.warnings()
    );
    assert_eq!(
        replay.append_and_commit(0, id(0, 2), &chunk(0, id(0, 2), 4)).unwrap(),
        Appended::Accepted
    );
    assert_eq!(CommitReader::open(&directory.replay()).unwrap().committed(0), id(0, 2));

    for slot in offsets(100).slots {
        image[slot..slot + 104].fill(0);
    }
    drop(replay);
    let error = reopen(&directory.replay(), &image, 100).unwrap_err().to_string();
    assert!(error.contains("all of its commit records are damaged"), "{error}");
    assert_eq!(fs::read(directory.replay()).unwrap(), image);
}

#[test]
fn a_damaged_row_also_loses_the_rows_before_it() {
    let (directory, model) = filled(100, &[(0, 60), (1, 30)]);
    let mut image = fs::read(directory.replay()).unwrap();
    image[offsets(100).rows.start + 20 * 4 * WIDTH] ^= 1;
    let replay = reopen(&directory.replay(), &image, 100).unwrap();
    model.check(&replay);
    assert_eq!(replay.rows(), 21..90);
    assert_eq!(
        replay.warnings(),
        ["row 20 is damaged; continuing with the 69 rows after it"]
    );
}

#[test]
fn a_sync_on_another_thread_counts_once_it_is_finished() {
    let (directory, mut model) = filled(100, &[(0, 30)]);
    let mut replay = Replay::open(&directory.replay(), &layout(100)).unwrap();
    let old = replay.start_sync().unwrap();
    let numbers = chunk(0, id(0, 2), 5);
    replay.append_and_commit(0, id(0, 2), &numbers).unwrap();
    let new = replay.start_sync().unwrap();
    let new = std::thread::spawn(|| new.run().unwrap()).join().unwrap();
    replay.finish_sync(new);
    // The older of two syncs has no effect if it ends last.
    let before = fs::read(directory.replay()).unwrap();
    replay.finish_sync(old.run().unwrap());
    assert_eq!(fs::read(directory.replay()).unwrap(), before);
    model.add(0, id(0, 2), &numbers);
    drop(replay);
    let mut image = fs::read(directory.replay()).unwrap();
    for slot in &offsets(100).slots[..2] {
        image[*slot] ^= 1;
    }
    model.check(&reopen(&directory.replay(), &image, 100).unwrap());
}

/// The content of the file after each step of committing a second chunk.
fn images_of_a_commit() -> (Directory, Images) {
    let (directory, model) = filled(100, &[(0, 30)]);
    let path = directory.replay();
    let mut replay = Replay::open(&path, &layout(100)).unwrap();
    let images: Arc<Mutex<Images>> = Arc::default();
    let sink = Arc::clone(&images);
    replay.on_step(move |step| sink.lock().unwrap().push((step, fs::read(&path).unwrap())));
    replay
        .append_and_commit(0, model.next(0), &chunk(0, model.next(0), 60))
        .unwrap();
    drop(replay);
    (directory, Arc::into_inner(images).unwrap().into_inner().unwrap())
}

fn word(image: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(image[at..at + 8].try_into().unwrap())
}

#[test]
fn a_record_that_is_being_written_has_no_seal() {
    let (_directory, images) = images_of_a_commit();
    for (step, image) in images {
        let other = offsets(100).slots[1 - (word(&image, offsets(100).published) % 2) as usize];
        let cleared = word(&image, other) == 0;
        assert_eq!(
            cleared,
            matches!(step, WriteStep::SealCleared | WriteStep::RecordWritten),
            "after {step:?}"
        );
    }
}

#[test]
fn opening_leaves_the_record_that_it_continues_from() {
    let (directory, images) = images_of_a_commit();
    for (step, image) in images {
        let slots = offsets(100).slots;
        let newest = slots[..2]
            .iter()
            .max_by_key(|&&slot| (word(&image, slot) != 0, word(&image, slot + 8)));
        let newest = *newest.unwrap();
        drop(reopen(&directory.replay(), &image, 100).unwrap());
        let opened = fs::read(directory.replay()).unwrap();
        assert_eq!(
            opened[newest..newest + 104],
            image[newest..newest + 104],
            "after {step:?}"
        );
    }
}

#[test]
fn a_power_loss_among_unsynced_rows_goes_back_to_the_synced_ones() {
    let (directory, mut model) = filled(100, &[(0, 30)]);
    let mut replay = Replay::open(&directory.replay(), &layout(100)).unwrap();
    replay.flush().unwrap();
    replay.append_and_commit(1, id(0, 1), &chunk(1, id(0, 1), 60)).unwrap();
    drop(replay);
    let mut image = fs::read(directory.replay()).unwrap();
    let row = |index| offsets(100).rows.start + 4 * WIDTH * index;
    image[row(30)..row(40)].fill(0);
    let mut replay = reopen(&directory.replay(), &image, 100).unwrap();
    model.check(&replay);
    assert_eq!(replay.rows(), 0..30);
    assert_eq!(
        replay.warnings(),
        ["the newest 60 rows did not reach the disk; continuing from the 30 rows that did"]
    );
    // The lost rows do not come back under the numbers of the next rows.
    let numbers = chunk(2, id(0, 1), 5);
    replay.append_and_commit(2, id(0, 1), &numbers).unwrap();
    model.add(2, id(0, 1), &numbers);
    drop(replay);
    let replay = Replay::open(&directory.replay(), &layout(100)).unwrap();
    model.check(&replay);
    assert_eq!(replay.rows(), 0..35);
    drop(replay);
    let image = fs::read(directory.replay()).unwrap();
    let checks = &image[offsets(100).checks.start..][..400];
    assert!(checks[35 * 4..].iter().all(|&byte| byte == 0));
}
