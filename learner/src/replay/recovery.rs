//! Chooses one of the file's commit records. After a `kill -9` it is the newest, and nothing is lost. After a power
//! loss any block of the file may be older than any other, so records are compared by the rows that are intact under
//! them.

use shoal_common::commit::{CommitRecord, FileOffsets, ReplayLayout, SLOTS, SYNCED, Words};

use super::ring::Ring;

/// The result of the recovery.
pub(super) struct RecoveredRecord {
    pub(super) record: CommitRecord,
    /// The generation to publish first. Its slot is left as it is.
    pub(super) first_generation: u64,
    /// The generation to publish next, with `record`. It is newer than all others and belongs to the other slot.
    pub(super) next_generation: u64,
    pub(super) next_synced: usize,
    pub(super) synced_generation: u64,
    pub(super) warnings: Vec<String>,
}

const NONE_LEFT: &str = "all of its commit records are damaged";

/// If the published generation is further than this beyond all records, that word is damaged.
const MAX_DISTANCE: u64 = 1 << 48;

/// A sealed record. The rows from `tail` to its head are intact.
struct Candidate<'a> {
    slot: usize,
    record: &'a CommitRecord,
    tail: u64,
}

impl Candidate<'_> {
    /// Greater is better. Synced rows count first, because a power loss must not lose any of them. Rows before
    /// `replaced` do not count.
    fn rank(&self, replaced: u64, synced: u64, layout: &ReplayLayout) -> (u64, u64, bool, u64) {
        let (head, tail) = (self.record.head(), self.tail.max(replaced));
        let of_synced = head.min(synced).saturating_sub(tail);
        let of_all = head.saturating_sub(tail);
        (
            of_synced,
            of_all,
            self.whole(replaced, layout),
            self.record.generation(),
        )
    }

    fn whole(&self, replaced: u64, layout: &ReplayLayout) -> bool {
        self.tail <= oldest(self.record, layout).max(replaced)
    }
}

/// Chooses the newest record if all its rows are intact, except rows that were being overwritten. Otherwise, the record
/// under which most of the synced rows are intact, then the one with most rows.
pub(super) fn recover(
    words: &Words,
    offsets: &FileOffsets,
    layout: &ReplayLayout,
    ring: &Ring,
) -> Result<RecoveredRecord, String> {
    let slots: [Option<CommitRecord>; SLOTS] = offsets.slots.map(|slot| CommitRecord::load(words, slot, layout));
    let newest_of = |from: usize| {
        let records = slots
            .iter()
            .enumerate()
            .skip(from)
            .filter_map(|(slot, record)| Some((slot, record.as_ref()?)));
        records.max_by_key(|(_, record)| record.generation())
    };
    let (newest_slot, newest) = newest_of(0).ok_or(NONE_LEFT)?;

    // Rows before this number may be missing: an interrupted append was overwriting them.
    let replaced = words
        .load(offsets.write_horizon)
        .min(newest.head() + layout.ring)
        .saturating_sub(layout.ring);
    let synced = newest_of(SYNCED).map_or(0, |(_, record)| record.head());

    let candidate = |slot, record| Candidate {
        slot,
        record,
        tail: intact_from(record, layout, ring),
    };
    let mut best = candidate(newest_slot, newest);
    if !best.whole(replaced, layout) {
        let records = slots
            .iter()
            .enumerate()
            .filter_map(|(slot, record)| Some(candidate(slot, record.as_ref()?)));
        best = records
            .chain([best])
            .max_by_key(|each| each.rank(replaced, synced, layout))
            .ok_or(NONE_LEFT)?;
    }

    let published = words.load(offsets.published);
    let warnings = warnings(&best, newest, published, replaced.max(oldest(best.record, layout)));
    // Readers may be reading the published slot. So publish the chosen record first, if it is in slot 0 or 1, and then
    // write the other slot.
    let first_generation = if best.slot < SYNCED {
        best.record.generation()
    } else {
        published
    };
    let last = newest
        .generation()
        .max(if published < newest.generation() + MAX_DISTANCE {
            published
        } else {
            0
        });
    let next_generation = if (last + 1) % 2 == first_generation % 2 {
        last + 2
    } else {
        last + 1
    };

    let generation = |slot: usize| slots[slot].as_ref().map_or(0, CommitRecord::generation);
    let (older, newer) = if generation(SYNCED) <= generation(SYNCED + 1) {
        (SYNCED, SYNCED + 1)
    } else {
        (SYNCED + 1, SYNCED)
    };
    let mut record = best.record.clone();
    record.set_tail(best.tail);
    Ok(RecoveredRecord {
        record,
        first_generation,
        next_generation,
        next_synced: older,
        synced_generation: generation(newer),
        warnings,
    })
}

/// What is lost: the record `published`, rows after the head of `best`, or rows from `expected` on.
fn warnings(best: &Candidate<'_>, newest: &CommitRecord, published: u64, expected: u64) -> Vec<String> {
    let mut warnings = Vec::new();
    if newest.generation() < published {
        let number = newest.generation();
        warnings.push(format!(
            "the commit record published last is damaged; continuing from the newest intact one (number {number})"
        ));
    }
    let (head, lost) = (best.record.head(), newest.head().saturating_sub(best.record.head()));
    if lost > 0 {
        warnings.push(format!(
            "the newest {lost} rows did not reach the disk; continuing from the {head} rows that did"
        ));
    }
    if best.tail > expected {
        let (damaged, left) = (best.tail - 1, head - best.tail);
        warnings.push(format!(
            "row {damaged} is damaged; continuing with the {left} rows after it"
        ));
    }
    warnings
}

/// The first row that the ring holds under `record` if none is damaged.
fn oldest(record: &CommitRecord, layout: &ReplayLayout) -> u64 {
    record.tail().max(record.head().saturating_sub(layout.ring))
}

/// The first row from which on all rows up to the record's head are intact.
fn intact_from(record: &CommitRecord, layout: &ReplayLayout, ring: &Ring) -> u64 {
    let rows = oldest(record, layout)..record.head();
    rows.clone()
        .rev()
        .find(|&index| !ring.holds(index))
        .map_or(rows.start, |damaged| damaged + 1)
}
