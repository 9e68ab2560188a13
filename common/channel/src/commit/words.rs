//! The words of the replay's header as atomics in shared memory: the only module of this crate that accesses mapped
//! bytes.

use std::fs::File;
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};

use memmap2::{MmapOptions, MmapRaw};

/// The first words of a file, mapped for reading while another process may write them.
#[derive(Debug)]
pub struct Words {
    map: MmapRaw,
}

impl Words {
    /// Maps the first `bytes` bytes. Fails if the file is shorter, because reading beyond its end would raise SIGBUS.
    pub fn map(file: &File, bytes: usize) -> io::Result<Self> {
        require(file, bytes)?;
        Ok(Self {
            map: MmapOptions::new().len(bytes).map_raw_read_only(file)?,
        })
    }

    fn slice(&self) -> &[AtomicU64] {
        // SAFETY: the mapping begins at a page, so it is aligned, lives as long as `self`, and has `len()` bytes. Every
        // process that maps these bytes uses them as atomics only (the files are private to the user, and the rows are
        // another mapping), so no non-atomic access races with ours. `Words` only loads relaxed, which the standard
        // library allows on read-only memory.
        unsafe { std::slice::from_raw_parts(self.map.as_ptr().cast(), self.map.len() / size_of::<AtomicU64>()) }
    }

    /// Relaxed load of the word at `offset` bytes.
    #[inline]
    pub fn load(&self, offset: usize) -> u64 {
        self.slice()[offset / size_of::<u64>()].load(Ordering::Relaxed)
    }
}

/// The words for the single process that writes them.
#[derive(Debug)]
pub struct WritableWords {
    words: Words,
}

impl WritableWords {
    /// Maps the first `bytes` bytes for writing. Fails if the file is shorter.
    pub fn map(file: &File, bytes: usize) -> io::Result<Self> {
        require(file, bytes)?;
        Ok(Self {
            words: Words {
                map: MmapOptions::new().len(bytes).map_raw(file)?,
            },
        })
    }

    /// The words for reading.
    pub fn read(&self) -> &Words {
        &self.words
    }

    /// Relaxed store into the word at `offset` bytes.
    #[inline]
    pub fn store(&mut self, offset: usize, value: u64) {
        self.words.slice()[offset / size_of::<u64>()].store(value, Ordering::Relaxed);
    }
}

fn require(file: &File, bytes: usize) -> io::Result<()> {
    if file.metadata()?.len() < bytes as u64 {
        return Err(io::Error::new(
            io::ErrorKind::UnexpectedEof,
            "the file ends within its header",
        ));
    }
    Ok(())
}
