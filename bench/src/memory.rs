//! Resident memory of a process, from `/proc/<pid>/smaps`.

use std::path::Path;

use anyhow::Context;
use serde::Serialize;

/// Resident bytes of a process. The replay file is counted separately.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(super) struct Memory {
    /// Pages that no other process maps, of any kind.
    pub(super) private_bytes: u64,
    /// Private pages and this process's share of shared ones (Pss).
    pub(super) proportional_bytes: u64,
    /// Pages of files in shared memory, private or not.
    pub(super) shared_memory_bytes: u64,
    /// Pages of other files, mostly of this program, private or not.
    pub(super) file_bytes: u64,
    /// Pages of the replay file; none of the numbers above includes them.
    pub(super) replay_bytes: u64,
}

/// The kind of a mapping.
#[derive(Clone, Copy)]
enum Kind {
    Anonymous,
    SharedMemory,
    File,
    Replay,
}

impl Memory {
    /// The memory of process `pid` of a run with its replay at `replay`.
    pub(super) fn of(pid: u32, replay: &Path) -> anyhow::Result<Self> {
        let path = format!("/proc/{pid}/smaps");
        let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {path}"))?;
        let replay = replay.canonicalize().context("cannot find the replay")?;
        Ok(Self::parse(&text, &replay.to_string_lossy()))
    }

    fn parse(smaps: &str, replay: &str) -> Self {
        let (mut memory, mut kind) = (Self::default(), Kind::Anonymous);
        for line in smaps.lines() {
            let mut words = line.split_ascii_whitespace();
            let Some(first) = words.next() else { continue };
            let Some(field) = first.strip_suffix(':') else {
                // Addresses, permissions, offset, device, inode and name.
                let name = words.skip(4).collect::<Vec<_>>().join(" ");
                kind = match name.as_str() {
                    name if name == replay => Kind::Replay,
                    name if name.starts_with("/dev/shm/") => Kind::SharedMemory,
                    name if name.starts_with('/') => Kind::File,
                    _ => Kind::Anonymous,
                };
                continue;
            };
            let bytes = 1024 * words.next().and_then(|number| number.parse().ok()).unwrap_or(0_u64);
            match (field, kind) {
                ("Rss", Kind::Replay) => memory.replay_bytes += bytes,
                (_, Kind::Replay) => {}
                ("Rss", Kind::SharedMemory) => memory.shared_memory_bytes += bytes,
                ("Rss", Kind::File) => memory.file_bytes += bytes,
                ("Pss", _) => memory.proportional_bytes += bytes,
                ("Private_Clean" | "Private_Dirty" | "Private_Hugetlb", _) => memory.private_bytes += bytes,
                _ => {}
            }
        }
        memory
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMAPS: &str = "\
5581d0000000-5581d0400000 r-xp 00001000 08:01 12   /usr/bin/sho al
Rss:                1000 kB
Pss:                 250 kB
Pss_Dirty:             7 kB
Private_Clean:         0 kB
Private_Dirty:         4 kB
VmFlags: rd ex mr mw me
7f0000000000-7f0000400000 rw-s 00000000 00:1a 13   /dev/shm/shoal_1a_data
Rss:                 100 kB
Pss:                  60 kB
Private_Clean:         1 kB
Private_Dirty:        20 kB
7f1000000000-7f1000400000 rw-s 00000000 08:01 14   /tmp/my run/replay
Rss:               40000 kB
Pss:               40000 kB
Private_Dirty:     40000 kB
7f2000000000-7f2000400000 rw-p 00000000 00:00 0    [heap]
Rss:                  80 kB
Pss:                  80 kB
Private_Dirty:        80 kB
7f3000000000-7f3000400000 rw-p 00000000 00:00 0 
Rss:                   8 kB
Pss:                   8 kB
Private_Dirty:         8 kB
";

    #[test]
    fn the_replay_is_counted_separately() {
        let memory = Memory::parse(SMAPS, "/tmp/my run/replay");
        let expected = Memory {
            private_bytes: 1024 * (4 + 21 + 80 + 8),
            proportional_bytes: 1024 * (250 + 60 + 80 + 8),
            shared_memory_bytes: 1024 * 100,
            file_bytes: 1024 * 1000,
            replay_bytes: 1024 * 40_000,
        };
        assert_eq!(memory, expected);
    }
}
