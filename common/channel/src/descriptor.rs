//! The file descriptor of a listener, for `poll`.

use std::os::fd::BorrowedFd;

use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::*;

/// The descriptor of the socket that receives the notifications.
pub(super) fn of(listener: &Listener<ipc::Service>) -> BorrowedFd<'_> {
    // SAFETY: the listener owns the descriptor and keeps it open until it is dropped. It cannot be dropped while the
    // result borrows it.
    unsafe { BorrowedFd::borrow_raw(listener.file_descriptor().native_handle()) }
}
