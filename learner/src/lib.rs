//! The learner: its networks ([`networks`]), the replay ([`replay`]), the learning algorithms ([`algorithms`]) and the
//! process that runs them ([`process`]). Each of these modules imports only from those listed before it.
//!
//! The path of a transition, from an actor through shared memory into the replay:
//!
//! ```
//! use shoal_common::channel::transitions::{ChunkReceiver, ChunkSender};
//! use shoal_common::channel::{Domain, EventName, Listener, Services};
//! use shoal_common::commit::CommitReader;
//! use shoal_common::role::Role;
//! use shoal_common::stop::Stop;
//! use shoal_common::transition::{ChunkLayout, RowLayout, Transition};
//! use shoal_learner::replay::{Replay, ReplayLayout};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let run_id = format!("example-{}", std::process::id());
//! let domain = Domain::join(&run_id, 1)?; // a run of at most one actor
//! let mut services = Services::new(&domain)?; // as the launcher does
//! services.create_actor(&domain, 0, 4)?; // at most four chunks sent and not committed
//!
//! // The learner's end.
//! let chunks = ChunkLayout { row: RowLayout::new(2, 1), rows: 8, actor_snapshot_words: 0 };
//! let layout = ReplayLayout { row: chunks.row, ring: 100, actors: 1, actor_snapshot_words: 0, fingerprint: 0 };
//! let directory = tempfile::tempdir()?;
//! let mut replay = Replay::create(&directory.path().join("replay.bin"), &layout)?;
//! let receiver = ChunkReceiver::open(&domain, 0, chunks, 4)?;
//! let mut take = |replay: &mut Replay| -> Result<(), Box<dyn std::error::Error>> {
//!     let chunk = receiver.receive()?.ok_or("no chunk")?;
//!     replay.append_and_commit(0, chunk.id(replay.committed(0).last_chunk), chunk.rows())?;
//!     Ok(())
//! };
//!
//! // The actor's end. Its first chunk is a handshake without rows, which it waits for.
//! let listener = Listener::bind(&domain, EventName(Role::Actor, 0))?;
//! let commits = CommitReader::open(replay.path())?;
//! let handshake = ChunkSender::open(&domain, 0, 1, chunks, 4)?;
//! take(&mut replay)?;
//! let mut sender = handshake
//!     .wait(&commits, &listener, &Stop::default(), || {})
//!     .map_err(|exit| exit.to_string())?;
//! let mut chunk = sender.empty_chunk()?;
//! let (s, a, s_next) = ([0.0, 1.0], [0.5], [0.1, 0.9]);
//! chunk.push(&Transition { s: &s, a: &a, r: -1.0, discount: 0.99, s_next: &s_next, last: false });
//! sender.send(chunk, 1)?;
//!
//! take(&mut replay)?;
//! assert_eq!(chunks.row.read(replay.row(0)).r, -1.0);
//! assert_eq!(sender.in_flight(commits.committed(0)), 0);
//! # drop((sender, receiver, listener, services));
//! # domain.leave()?;
//! # Ok(())
//! # }
//! ```

pub mod algorithms;
pub mod networks;
pub mod process;
pub mod replay;
