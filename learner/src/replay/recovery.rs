//! Which of the file's commit records to believe. After a `kill -9` it is the newest, and nothing is lost. After a power
//! loss any block of the file may be older than any other, and each record is as good as the rows it can show.

use shoal_common::commit::{Places, Record, ReplayLayout, SLOTS, Words};

use super::ring::Ring;

/// What the file proves.
pub(super) struct Found {
    pub(super) record: Record,
    /// For the record the caller publishes: newer than all others, and not in the slot this one was found in.
    pub(super) next_generation: u64,
    pub(super) next_synced: usize,
    pub(super) synced_generation: u64,
    pub(super) warnings: Vec<String>,
}

const NONE_LEFT: &str = "all of its commit records are damaged";

/// A record that was written to the end, and the first of the rows before its head that are all intact.
struct Candidate<'a> {
    slot: usize,
    record: &'a Record,
    tail: u64,
}

impl Candidate<'_> {
    fn kept(&self) -> u64 {
        self.record.head() - self.tail
    }
}

/// Chooses the record with the most rows intact, counted back from its head; of equal ones the newest.
pub(super) fn recover(words: &Words, places: &Places, layout: &ReplayLayout, ring: &Ring) -> Result<Found, String> {
    let slots: [Option<Record>; SLOTS] = places.slots.map(|slot| Record::load(words, slot, layout.actors));
    let published = words.load(places.selector);
    let reach = words.load(places.reach);

    let mut records: Vec<(usize, &Record)> = slots
        .iter()
        .enumerate()
        .filter_map(|(slot, record)| Some((slot, record.as_ref()?)))
        .collect();
    records.sort_by_key(|(_, record)| std::cmp::Reverse(record.generation()));
    let &(_, newest) = records.first().ok_or(NONE_LEFT)?;

    let mut best: Option<Candidate<'_>> = None;
    for (slot, record) in &records {
        // Scanned only if it can win: most often the newest record is whole, and its rows are all that is looked at.
        if best
            .as_ref()
            .is_none_or(|best| record.head() - oldest(record, layout) > best.kept())
        {
            let candidate = Candidate {
                slot: *slot,
                record,
                tail: intact_from(record, layout, ring),
            };
            if best.as_ref().is_none_or(|best| candidate.kept() > best.kept()) {
                best = Some(candidate);
            }
        }
    }
    let Candidate {
        slot,
        record: chosen,
        tail,
    } = best.ok_or(NONE_LEFT)?;

    let mut warnings = Vec::new();
    if newest.generation() < published {
        warnings.push(format!(
            "the newest commit record (number {published}) is damaged; going on from record {}",
            newest.generation()
        ));
    }
    if chosen.head() < newest.head() {
        warnings.push(format!(
            "the newest {} rows did not reach the disk; going on from the {} rows that did",
            newest.head() - chosen.head(),
            chosen.head()
        ));
    }
    // Rows that a write under way when the process died was about to replace: nobody misses them.
    let replaced = reach.min(chosen.head() + layout.ring).saturating_sub(layout.ring);
    if tail > oldest(chosen, layout).max(replaced) {
        warnings.push(format!(
            "row {} is damaged; going on with the {} rows after it",
            tail - 1,
            chosen.head() - tail
        ));
    }

    let last = newest.generation().max(published);
    let next_generation = if slot < 2 && (last + 1) % 2 == slot as u64 {
        last + 2
    } else {
        last + 1
    };
    let synced = |slot: usize| slots[slot].as_ref().map_or(0, Record::generation);
    let (next_synced, synced_generation) = if synced(2) <= synced(3) {
        (2, synced(3))
    } else {
        (3, synced(2))
    };
    let mut record = chosen.clone();
    record.set_tail(tail);
    Ok(Found {
        record,
        next_generation,
        next_synced,
        synced_generation,
        warnings,
    })
}

/// The first row the ring holds under `record` if none is damaged.
fn oldest(record: &Record, layout: &ReplayLayout) -> u64 {
    record.tail().max(record.head().saturating_sub(layout.ring))
}

/// The first row from which on all are intact up to the record's head.
fn intact_from(record: &Record, layout: &ReplayLayout, ring: &Ring) -> u64 {
    let rows = oldest(record, layout)..record.head();
    rows.clone()
        .rev()
        .find(|&index| !ring.holds(index))
        .map_or(rows.start, |damaged| damaged + 1)
}
