//! The capacity of shared memory: how much of it a port or a service reserves, how much is free, and how much is
//! reserved to runs.
//!
//! iceoryx2 creates its files at their full size and sparse: a page is allocated when it is first written. A full file
//! system then causes a SIGBUS at some later write instead of an error. So the reserved size counts, not the allocated
//! one.

use std::fs::{Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use super::files::{SHARED_MEMORY, prefix};

/// The unit in which a file takes memory, in bytes.
const PAGE: usize = 4096;

// What iceoryx2 0.10 adds to the requested sizes: measured and rounded up. `tests/resources.rs` compares them with real
// files.
const SEGMENT: usize = 512;
const CHUNK_INDEX: usize = 4;
const CONNECTION: usize = 512;
const CHANNEL: usize = 256;
const SERVICE: usize = 768;
const PARTICIPANT: usize = 96;

/// An empty file records how much memory is reserved to a run. Its name is the run's prefix, this word, and the number
/// of bytes. (The length of a file may be limited, so it is not used.)
const RESERVATION: &str = "reserved_";

/// The same word of earlier versions, whose runs may be alive.
const EARLIER_RESERVATION: &str = "promise_";

/// The prefix of the run and the number of bytes in the name of a file that records a reservation.
fn split_reservation(name: &str) -> Option<(&str, &str)> {
    name.split_once(RESERVATION)
        .or_else(|| name.split_once(EARLIER_RESERVATION))
}

/// Whether a file of this name records a reservation.
pub(super) fn is_reservation(name: &str) -> bool {
    split_reservation(name).is_some()
}

/// Bytes of a port's data: `chunks` chunks with headers `H` and `U` and `payload` bytes of payload.
pub(super) fn segment<H, U>(chunks: usize, payload: usize) -> u64 {
    let chunk = (size_of::<H>() + size_of::<U>() + payload).next_multiple_of(align_of::<u64>());
    pages(chunks * (chunk + CHUNK_INDEX) + SEGMENT)
}

/// Bytes of a connection between two ports: in each channel a queue in each direction, and a mark for each chunk of the
/// sender.
pub(super) fn connection(channels: usize, buffer: usize, borrowed: usize, chunks: usize) -> u64 {
    let queues = size_of::<u64>() * (2 * buffer + borrowed);
    pages(channels * (queues + CHANNEL) + chunks + CONNECTION)
}

/// Bytes of a service's list of ports and processes.
pub(super) fn service(participants: usize) -> u64 {
    pages(SERVICE + PARTICIPANT * participants)
}

/// The number of bytes, rounded up to whole pages.
pub(super) fn pages(bytes: usize) -> u64 {
    bytes.next_multiple_of(PAGE) as u64
}

/// Bytes of shared memory that are free and not reserved to another run of this user; `None` if there is no limit.
/// Memory that other programs and other users' runs have reserved but not allocated is unknown, and counts as free.
///
/// # Errors
/// When the file system cannot be read.
pub fn free_shared_memory(run_id: &str) -> io::Result<Option<u64>> {
    let status = rustix::fs::statvfs(SHARED_MEMORY)?;
    if status.f_blocks == 0 {
        return Ok(None);
    }
    let free = status.f_bavail * status.f_frsize;
    Ok(Some(free.saturating_sub(reserved_by_others(run_id)?)))
}

/// Records that the run may take this many bytes. The record is removed with the run's other files.
pub(super) fn reserve_memory(run_id: &str, bytes: u64) -> io::Result<()> {
    let path = Path::new(SHARED_MEMORY).join(format!("{}{RESERVATION}{bytes}", prefix(run_id)));
    let mut options = OpenOptions::new();
    options
        .write(true)
        .create(true)
        .truncate(false)
        .mode(0o600)
        .open(path)?;
    Ok(())
}

/// Bytes that are reserved to this user's other runs and not allocated yet.
fn reserved_by_others(run_id: &str) -> io::Result<u64> {
    let user = rustix::process::getuid().as_raw();
    let files: Vec<(String, Metadata)> = std::fs::read_dir(SHARED_MEMORY)?
        .flatten()
        // Skip a file that was removed in between.
        .filter_map(|entry| Some((entry.file_name().into_string().ok()?, entry.metadata().ok()?)))
        .filter(|(_, metadata)| metadata.uid() == user)
        .collect();
    let outstanding = |(name, _): &(String, Metadata)| {
        let (run, reserved) = split_reservation(name)?;
        let reserved: u64 = reserved.parse().ok()?;
        let others = run.starts_with("shoal_") && run != prefix(run_id);
        let taken = files.iter().filter(|(name, _)| name.starts_with(run));
        let taken: u64 = taken.map(|(_, file)| 512 * file.blocks()).sum();
        others.then(|| reserved.saturating_sub(taken))
    };
    Ok(files.iter().filter_map(outstanding).sum())
}
