//! Shared memory as room: how much of it a port or a service reserves, how much is free, and what runs have been promised.
//!
//! iceoryx2 makes its files at their full size and sparse: a page is taken when it is first written. So a file system
//! that is full is a SIGBUS at some later write and no error, and what counts is what is reserved, not what is taken.

use std::fs::{Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use super::files::{SHARED_MEMORY, prefix};

/// The unit in which a file takes memory, in bytes.
const PAGE: usize = 4096;

// What iceoryx2 0.10 adds to what is asked of it, rounded up from what its files were seen to measure; tests/room.rs
// compares.
const SEGMENT: usize = 512;
const CHUNK_INDEX: usize = 4;
const CONNECTION: usize = 512;
const CHANNEL: usize = 256;
const SERVICE: usize = 768;
const PARTY: usize = 96;

/// An empty file says how much the run was promised: its name is the run's prefix, this, and the number of bytes. (Not its
/// length: that may be limited.)
const PROMISE: &str = "promise_";

/// Whether a file of this name is such a note.
pub(super) fn is_promise(name: &str) -> bool {
    name.contains(PROMISE)
}

/// Bytes of a port's data: so many chunks with headers `H` and `U` and a payload of so many bytes.
pub(super) fn segment<H, U>(chunks: usize, payload: usize) -> u64 {
    let chunk = (size_of::<H>() + size_of::<U>() + payload).next_multiple_of(align_of::<u64>());
    pages(chunks * (chunk + CHUNK_INDEX) + SEGMENT)
}

/// Bytes of a connection between two ports: in each channel a queue there and one back, and a mark for each chunk of the
/// sender.
pub(super) fn connection(channels: usize, buffer: usize, borrowed: usize, chunks: usize) -> u64 {
    let queues = size_of::<u64>() * (2 * buffer + borrowed);
    pages(channels * (queues + CHANNEL) + chunks + CONNECTION)
}

/// Bytes of what a service knows of the ports and processes that take part in it.
pub(super) fn service(parties: usize) -> u64 {
    pages(SERVICE + PARTY * parties)
}

/// What so many bytes take up.
pub(super) fn pages(bytes: usize) -> u64 {
    bytes.next_multiple_of(PAGE) as u64
}

/// Bytes of shared memory that are free and not promised to another run of this user; `None` where there is no limit.
/// What other programs and other users' runs have reserved and not yet taken is not known, and counts as free.
///
/// # Errors
/// When the file system cannot be asked.
pub fn free_shared_memory(run_id: &str) -> io::Result<Option<u64>> {
    let status = rustix::fs::statvfs(SHARED_MEMORY)?;
    if status.f_blocks == 0 {
        return Ok(None);
    }
    let free = status.f_bavail * status.f_frsize;
    Ok(Some(free.saturating_sub(promised_to_others(run_id)?)))
}

/// Notes that the run may take so many bytes. The note goes with the run's other files.
pub(super) fn promise(run_id: &str, bytes: u64) -> io::Result<()> {
    let path = Path::new(SHARED_MEMORY).join(format!("{}{PROMISE}{bytes}", prefix(run_id)));
    let mut options = OpenOptions::new();
    options
        .write(true)
        .create(true)
        .truncate(false)
        .mode(0o600)
        .open(path)?;
    Ok(())
}

/// What this user's other runs were promised and have not taken.
fn promised_to_others(run_id: &str) -> io::Result<u64> {
    let user = rustix::process::getuid().as_raw();
    let files: Vec<(String, Metadata)> = std::fs::read_dir(SHARED_MEMORY)?
        .flatten()
        // One that has gone in between takes nothing.
        .filter_map(|entry| Some((entry.file_name().into_string().ok()?, entry.metadata().ok()?)))
        .filter(|(_, metadata)| metadata.uid() == user)
        .collect();
    let outstanding = |(name, _): &(String, Metadata)| {
        let (run, promised) = name.split_once(PROMISE)?;
        let promised: u64 = promised.parse().ok()?;
        let others = run.starts_with("shoal_") && run != prefix(run_id);
        let taken = files.iter().filter(|(name, _)| name.starts_with(run));
        let taken: u64 = taken.map(|(_, file)| 512 * file.blocks()).sum();
        others.then(|| promised.saturating_sub(taken))
    };
    Ok(files.iter().filter_map(outstanding).sum())
}
