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

/// A published generation this far beyond all records is no generation: that word is damaged.
const FAR: u64 = 1 << 48;

/// A record that was written to the end, and the first of the rows before its head that are all intact.
struct Candidate<'a> {
    slot: usize,
    record: &'a Record,
    tail: u64,
}

impl Candidate<'_> {
    /// Greater is better. A power loss must not cost a row that was synced: they count first.
    fn merit(&self, synced: u64, layout: &ReplayLayout) -> (u64, u64, bool, u64) {
        let of_synced = self.record.head().min(synced).saturating_sub(self.tail);
        let of_all = self.record.head() - self.tail;
        (of_synced, of_all, self.whole(layout), self.record.generation())
    }

    fn whole(&self, layout: &ReplayLayout) -> bool {
        self.tail == oldest(self.record, layout)
    }
}

/// Chooses the newest record if all its rows are intact. Otherwise the one under which most of the synced rows are, and
/// of those the one with most rows.
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
    let &(_, synced) = records.iter().find(|(slot, _)| *slot >= 2).unwrap_or(&(0, newest));

    let mut candidates: Vec<Candidate<'_>> = Vec::new();
    for &(slot, record) in &records {
        let tail = intact_from(record, layout, ring);
        candidates.push(Candidate { slot, record, tail });
        // No other record can offer more than the newest when that is whole: the older rows are overwritten.
        if candidates[0].whole(layout) {
            break;
        }
    }
    let best = candidates
        .into_iter()
        .max_by_key(|candidate| candidate.merit(synced.head(), layout));
    let Candidate {
        slot,
        record: chosen,
        tail,
    } = best.ok_or(NONE_LEFT)?;

    let mut warnings = Vec::new();
    if newest.generation() < published {
        warnings.push(format!(
            "the commit record published last is damaged; going on from the newest that is not (number {})",
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
    let replaced = reach
        .min(chosen.head().saturating_add(layout.ring))
        .saturating_sub(layout.ring);
    if tail > oldest(chosen, layout).max(replaced) {
        warnings.push(format!(
            "row {} is damaged; going on with the {} rows after it",
            tail - 1,
            chosen.head() - tail
        ));
    }

    let published = if published < newest.generation() + FAR {
        published
    } else {
        0
    };
    let last = newest.generation().max(published);
    let next_generation = if slot < 2 && (last + 1) % 2 == slot as u64 {
        last + 2
    } else {
        last + 1
    };
    let generation = |slot: usize| slots[slot].as_ref().map_or(0, Record::generation);
    let (older, newer) = if generation(2) <= generation(3) { (2, 3) } else { (3, 2) };
    let mut record = chosen.clone();
    record.set_tail(tail);
    Ok(Found {
        record,
        next_generation,
        next_synced: older,
        synced_generation: generation(newer),
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
