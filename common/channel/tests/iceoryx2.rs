//! Faults of iceoryx2 0.10 that `cleanup.rs` works around, shown with iceoryx2 alone. If a test fails after an update,
//! the fault is mended and its workaround may go.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

/// The environment variable with the directory of a test. A process that has it is the test's child.
const DIRECTORY: &str = "ICEORYX2_TEST_DIRECTORY";

/// How long an operation may take that is over in microseconds unless it never ends.
const TIMEOUT: Duration = Duration::from_secs(3);

/// The files of a test: a root directory, and names in shared memory with a prefix of its own. They are removed on
/// drop.
struct Place {
    directory: tempfile::TempDir,
}

fn prefix(directory: &Path) -> String {
    format!(
        "iox2t{}_",
        directory.file_name().unwrap().to_string_lossy().replace('.', "")
    )
}

fn config(directory: &Path) -> Config {
    let mut config = Config::default();
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    let root = directory.as_os_str().as_encoded_bytes();
    config
        .global
        .set_root_path(&iceoryx2::prelude::Path::new(root).unwrap());
    config.global.prefix = FileName::new(prefix(directory).as_bytes()).unwrap();
    config
}

/// A node, and a service that has room for a single subscriber.
fn open(directory: &Path) -> (Node<ipc::Service>, PortFactory<ipc::Service, u64, ()>) {
    let node = NodeBuilder::new()
        .config(&config(directory))
        .create::<ipc::Service>()
        .unwrap();
    let service = node.service_builder(&"numbers".try_into().unwrap());
    let service = service
        .publish_subscribe::<u64>()
        .max_subscribers(1)
        .open_or_create()
        .unwrap();
    (node, service)
}

impl Place {
    fn new() -> Self {
        Self {
            directory: tempfile::tempdir().unwrap(),
        }
    }

    /// Files whose names end like this, in the directory and in shared memory.
    fn files(&self, ending: &str) -> Vec<PathBuf> {
        let mut found = Vec::new();
        let mut directories = vec![self.directory.path().to_owned(), "/dev/shm".into()];
        while let Some(directory) = directories.pop() {
            for entry in std::fs::read_dir(directory).unwrap().flatten() {
                let name = entry.file_name().to_string_lossy().into_owned();
                if entry.path().is_dir() {
                    directories.push(entry.path());
                } else if name.starts_with(&prefix(self.directory.path())) && name.ends_with(ending) {
                    found.push(entry.path());
                }
            }
        }
        found
    }

    /// This program as a child that does only `test`, which must be the caller.
    fn child(&self, test: &str) -> Child {
        let mut child = Command::new(std::env::current_exe().unwrap());
        child.args(["--exact", test, "--nocapture"]).stdout(Stdio::piped());
        child.env(DIRECTORY, self.directory.path()).spawn().unwrap()
    }

    /// Frees what dead processes have left, as far as iceoryx2 does.
    fn clean_up(&self) {
        Node::<ipc::Service>::list(&config(self.directory.path()), |state| {
            if let NodeState::Dead(node) = state {
                let _ = node.blocking_remove_stale_resources(TIMEOUT);
            }
            CallbackProgression::Continue
        })
        .unwrap();
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        for file in self.files("") {
            let _ = std::fs::remove_file(file);
        }
    }
}

/// The directory if this process is the child of a test.
fn directory_of_parent() -> Option<PathBuf> {
    std::env::var_os(DIRECTORY).map(PathBuf::from)
}

/// Waits until the child has a port, then kills it.
fn kill_with_port(mut child: Child) {
    let lines = BufReader::new(child.stdout.take().unwrap()).lines();
    assert!(lines.map_while(Result::ok).any(|line| line.contains("has a port")));
    child.kill().unwrap();
    child.wait().unwrap();
}

/// A process that cleans up after a dead one removes the tag of each of its ports before the port itself. If it is
/// killed in between, iceoryx2 passes over the port in all later clean-ups, and removes the dead process's node all the
/// same.
#[test]
fn a_port_without_its_tag_is_never_freed() {
    if let Some(directory) = directory_of_parent() {
        let (_node, service) = open(&directory);
        let _port: Subscriber<ipc::Service, u64, ()> = service.subscriber_builder().create().unwrap();
        println!("has a port");
        std::thread::sleep(Duration::from_secs(60));
        return;
    }
    for (without_tag, is_free) in [(false, true), (true, false)] {
        let place = Place::new();
        let (_node, service) = open(place.directory.path());
        kill_with_port(place.child("a_port_without_its_tag_is_never_freed"));
        if without_tag {
            let tags = place.files(".port_tag");
            assert_eq!(tags.len(), 1, "{tags:?}");
            std::fs::remove_file(&tags[0]).unwrap();
        }
        place.clean_up();
        place.clean_up();
        assert_eq!(place.files("node.details").len(), 1, "only this process's node is left");
        assert_eq!(service.subscriber_builder().create().is_ok(), is_free);
    }
}

/// A process killed between `shm_open` and `ftruncate` leaves a segment without a size. Root can open it, and then maps
/// it again and again. Other users are refused, because the segment is not readable yet.
#[test]
fn a_segment_without_a_size_is_opened_forever_by_root() {
    if let Some(directory) = directory_of_parent() {
        let (_node, _service) = open(&directory);
        return;
    }
    if !rustix::process::getuid().is_root() {
        return;
    }
    let place = Place::new();
    let (node, service) = open(place.directory.path());
    let test = "a_segment_without_a_size_is_opened_forever_by_root";
    assert!(place.child(test).wait().unwrap().success(), "with its size");
    let segments = place.files(".dynamic");
    assert_eq!(segments.len(), 1, "{segments:?}");
    std::fs::File::options()
        .write(true)
        .open(&segments[0])
        .unwrap()
        .set_len(0)
        .unwrap();
    let mut child = place.child(test);
    let begun = Instant::now();
    let mut ended = None;
    while ended.is_none() && begun.elapsed() < TIMEOUT {
        std::thread::sleep(Duration::from_millis(20));
        ended = child.try_wait().unwrap();
    }
    child.kill().unwrap();
    child.wait().unwrap();
    // This process has the segment mapped, and must not touch it without a size.
    std::mem::forget((node, service));
    assert!(ended.is_none(), "{ended:?}");
}
