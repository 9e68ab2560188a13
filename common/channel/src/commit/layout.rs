//! The layout of the replay file. Each offset is the end of the part before it.

use std::ops::Range;

use shoal_base::transition::RowLayout;

use super::words::Words;

#[cfg(not(all(target_endian = "little", target_pointer_width = "64")))]
compile_error!("the replay file and the checkpoints have the layout of memory: 64-bit little-endian only");

/// "SHOALRPL", read as a number.
const MAGIC: u64 = u64::from_le_bytes(*b"SHOALRPL");
/// The format that this build reads and writes. Increase it with every change of the layout or of a checksum.
const VERSION: u64 = 2;

/// Bytes of a header word; every field of the header is one.
const WORD: usize = size_of::<u64>();
/// The unit of the layout, in bytes. Parts that are written at different times never share a block, so that a block
/// torn by a power loss leaves its neighbours whole.
const BLOCK: usize = 4096;
/// Words of the preamble, including its checksum.
const PREAMBLE_WORDS: usize = 10;

/// Words of a commit record before the actors' words: generation, head, tail.
pub(super) const RECORD_WORDS: usize = 3;
/// Words of an actor in a commit record, before its snapshot: incarnation, sequence, rows.
pub(super) const ACTOR_WORDS: usize = 3;

/// More actors than any run has. The limit keeps the header of a forged file from exhausting the reader's memory.
const MAX_ACTORS: usize = 1 << 16;

/// More words than any actor's snapshot has; a limit for the same reason.
pub const MAX_ACTOR_SNAPSHOT_WORDS: usize = 1 << 24;

/// Slots for commit records: two for what is committed (a record of generation g goes to slot g mod 2), then two for
/// what is known to be on the disk.
pub const SLOTS: usize = 4;
/// The first of the two slots for what is on the disk.
pub const SYNCED: usize = 2;

/// The sizes of a replay file, and the run that it belongs to. A file of another layout is refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReplayLayout {
    /// The fields of a row.
    pub row: RowLayout,
    /// Rows in the ring: the sampling range, and the reserve that lockstep runs need beyond it.
    pub ring: u64,
    /// The most actors; their indices are `0 .. actors`.
    pub actors: usize,
    /// Words of an actor's snapshot after its last chunk; 0 if the file has no snapshots.
    pub actor_snapshot_words: usize,
    /// Identifies the configuration that the rows were collected under. The caller chooses it.
    pub fingerprint: u64,
}

/// The offsets of the parts of a replay file, in bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FileOffsets {
    /// The word with the published generation, which selects the active slot.
    pub published: usize,
    /// The word with the write horizon: the row number up to which the ring may have been written.
    pub write_horizon: usize,
    /// The slots of commit records.
    pub slots: [usize; SLOTS],
    /// End of the header, which readers map.
    pub header: usize,
    /// The rows' checks, one `u32` for each place of the ring.
    pub checks: Range<usize>,
    /// The rows.
    pub rows: Range<usize>,
    /// Length of the file.
    pub end: usize,
}

/// Why a file's preamble cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PreambleError {
    /// The file does not begin as a replay file does.
    #[error("it is not a replay file")]
    Magic,
    /// A replay file of another format.
    #[error("it has format {0}; this program reads format {VERSION}")]
    Version(u64),
    /// The preamble's checksum does not match.
    #[error("its header is damaged (checksum)")]
    Checksum,
    /// The preamble is undamaged, but its numbers are impossible.
    #[error("its header has an impossible size")]
    Size,
}

impl ReplayLayout {
    /// The offsets of all parts. `None` if there are no rows or no actors, if there are too many actors or snapshot
    /// words, or if the file would be larger than a file can be.
    pub fn offsets(&self) -> Option<FileOffsets> {
        if self.ring == 0
            || !(1..=MAX_ACTORS).contains(&self.actors)
            || self.actor_snapshot_words > MAX_ACTOR_SNAPSHOT_WORDS
        {
            return None;
        }
        let ring = usize::try_from(self.ring).ok()?;
        let slot = self
            .record_words()?
            .checked_add(1)?
            .checked_mul(WORD)?
            .checked_next_multiple_of(BLOCK)?;
        let row = self.row.width().checked_mul(size_of::<f32>())?;

        let published = BLOCK;
        let write_horizon = published + WORD;
        let first = published + BLOCK;
        let header = first.checked_add(slot.checked_mul(SLOTS)?)?;
        let checks = header..header.checked_add(ring.checked_mul(size_of::<u32>())?)?;
        let rows = checks.end.checked_next_multiple_of(BLOCK)?;
        let rows = rows..rows.checked_add(ring.checked_mul(row)?)?;
        let end = rows.end.checked_next_multiple_of(BLOCK)?;
        i64::try_from(end).ok()?;
        let slots = std::array::from_fn(|i| first + i * slot);
        Some(FileOffsets {
            published,
            write_horizon,
            slots,
            header,
            checks,
            rows,
            end,
        })
    }

    /// Words of a commit record; `None` on overflow.
    fn record_words(&self) -> Option<usize> {
        let stride = self.actor_snapshot_words.checked_add(ACTOR_WORDS)?;
        self.actors.checked_mul(stride)?.checked_add(RECORD_WORDS)
    }

    /// The words that a file of this layout begins with.
    pub fn preamble(&self) -> Vec<u64> {
        let mut words = vec![
            MAGIC,
            VERSION,
            self.row.observation_width() as u64,
            self.row.action_width() as u64,
            self.row.width() as u64,
            self.ring,
            self.actors as u64,
            self.actor_snapshot_words as u64,
            self.fingerprint,
        ];
        words.push(crc32fast::hash(bytemuck::cast_slice(&words)).into());
        words
    }

    /// Reads the layout from a file's first block, which may have any contents.
    pub fn read(words: &Words) -> Result<Self, PreambleError> {
        let preamble: Vec<u64> = (0..PREAMBLE_WORDS).map(|i| words.load(i * WORD)).collect();
        if preamble[0] != MAGIC {
            return Err(PreambleError::Magic);
        }
        if preamble[1] != VERSION {
            return Err(PreambleError::Version(preamble[1]));
        }
        let (fields, checksum) = preamble.split_at(PREAMBLE_WORDS - 1);
        if checksum[0] != u64::from(crc32fast::hash(bytemuck::cast_slice(fields))) {
            return Err(PreambleError::Checksum);
        }
        // The bound keeps `RowLayout::width` from overflowing.
        let size = |word: u64| u32::try_from(word).map(|n| n as usize).map_err(|_| PreambleError::Size);
        let layout = Self {
            row: RowLayout::new(size(fields[2])?, size(fields[3])?),
            ring: fields[5],
            actors: size(fields[6])?,
            actor_snapshot_words: size(fields[7])?,
            fingerprint: fields[8],
        };
        if fields[4] != layout.row.width() as u64 {
            return Err(PreambleError::Size);
        }
        Ok(layout)
    }

    /// Describes the first difference between this layout and the layout `found` of a file.
    pub fn difference(&self, found: &Self) -> Option<String> {
        let differs = |before: &str, expected: usize, found: usize, after: &str| {
            (expected != found).then(|| format!("{before} {found} {after}, this run's {expected}"))
        };
        let (row, found_row) = (&self.row, &found.row);
        differs(
            "its observations have",
            row.observation_width(),
            found_row.observation_width(),
            "numbers",
        )
        .or_else(|| {
            differs(
                "its actions have",
                row.action_width(),
                found_row.action_width(),
                "numbers",
            )
        })
        .or_else(|| differs("its ring has", self.ring as usize, found.ring as usize, "rows"))
        .or_else(|| differs("it has space for", self.actors, found.actors, "actors"))
        .or_else(|| {
            differs(
                "its actor snapshots have",
                self.actor_snapshot_words,
                found.actor_snapshot_words,
                "words",
            )
        })
        .or_else(|| {
            (self.fingerprint != found.fingerprint).then(|| {
                format!(
                    "it was written under another configuration (fingerprint {:016x}, this run's is {:016x})",
                    found.fingerprint, self.fingerprint
                )
            })
        })
    }
}

/// Bytes of the file that contain its preamble.
pub(super) const PREAMBLE_BYTES: usize = BLOCK;
