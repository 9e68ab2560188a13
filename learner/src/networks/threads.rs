//! The threads that compute an update: the calling one alone, or two that share the work.

use std::sync::Arc;

use rayon::{ThreadPool, ThreadPoolBuilder};

/// The threads of a learner: the thread that created this, and possibly a second one.
///
/// There are at most two: one takes the first part of the work, the other one the rest.
#[derive(Clone, Debug)]
pub struct Threads(Option<Arc<ThreadPool>>);

/// Why the second thread cannot be started.
#[derive(Debug, thiserror::Error)]
#[error("cannot start the learner's second thread: {0}")]
pub struct ThreadsError(#[from] rayon::ThreadPoolBuildError);

impl Threads {
    /// The calling thread alone.
    pub const SINGLE: Self = Self(None);

    /// The calling thread and a new one. A thread can call this only once.
    ///
    /// # Errors
    /// When the system cannot start a thread, or the calling thread has a second one already.
    pub fn two_threads() -> Result<Self, ThreadsError> {
        // The calling thread is a member of the pool, so that it works while it waits and does not have to be woken.
        let pool = ThreadPoolBuilder::new()
            .num_threads(2)
            .use_current_thread()
            .thread_name(|_| "learner-2".into())
            .build()?;
        Ok(Self(Some(Arc::new(pool))))
    }

    /// How many of `items` the first thread takes: half of them, or all if it is the only one.
    pub fn first_share(&self, items: usize) -> usize {
        match self.0 {
            Some(_) => items.div_ceil(2),
            None => items,
        }
    }

    /// Calls both: at the same time on two threads, or one after the other on one.
    pub fn both(&self, first: impl FnOnce() + Send, second: impl FnOnce() + Send) {
        match &self.0 {
            Some(pool) => {
                pool.join(first, second);
            }
            None => {
                first();
                second();
            }
        }
    }
}
