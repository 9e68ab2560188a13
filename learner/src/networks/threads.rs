//! Who computes an update: this thread alone, or two that share it.

use std::sync::Arc;

use rayon::{ThreadPool, ThreadPoolBuilder};

/// The threads of a learner: the one that made this, and perhaps a second one beside it.
///
/// Two is all there can be: one thread takes the first part of what is to be done, the other one the rest.
#[derive(Clone, Debug)]
pub struct Threads(Option<Arc<ThreadPool>>);

/// Why a second thread cannot be had.
#[derive(Debug, thiserror::Error)]
#[error("cannot start the learner's second thread: {0}")]
pub struct ThreadsError(#[from] rayon::ThreadPoolBuildError);

impl Threads {
    /// The thread that asks, and no other.
    pub const ALONE: Self = Self(None);

    /// The thread that asks, and a new one beside it. A thread can ask once.
    ///
    /// # Errors
    /// When the system gives no thread, or the one that asks has a second one already.
    pub fn two() -> Result<Self, ThreadsError> {
        // As a member of its pool this thread works while it waits, and does not have to be woken.
        let pool = ThreadPoolBuilder::new()
            .num_threads(2)
            .use_current_thread()
            .thread_name(|_| "learner-2".into())
            .build()?;
        Ok(Self(Some(Arc::new(pool))))
    }

    /// How many of `items` the first thread takes: half of them, or all where there is no other.
    pub fn first_share(&self, items: usize) -> usize {
        match self.0 {
            Some(_) => items.div_ceil(2),
            None => items,
        }
    }

    /// Does both: at the same time where there are two threads, one after the other where there is one.
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
