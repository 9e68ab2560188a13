//! What the kernel wakes a listener by.

use std::os::fd::BorrowedFd;

use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::*;

/// The descriptor of the socket that rings arrive at.
pub(super) fn of(listener: &Listener<ipc::Service>) -> BorrowedFd<'_> {
    // SAFETY: the listener opened the descriptor, and keeps it and no other one until it is dropped, which it cannot be
    // while it is borrowed here.
    unsafe { BorrowedFd::borrow_raw(listener.file_descriptor().native_handle()) }
}
