//! Child processes: started in a group of their own, read, and ended with all that they started.

mod child_group;
mod child_output;
mod peer;

pub use self::child_group::ChildGroup;
pub use self::child_output::{ChildOutput, harmless};
pub use self::peer::Peer;
