//! The temporary directories of hosts.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use crate::hosts::{Run, stop};
use crate::support::{Workplace, until};

#[test]
fn the_directory_of_a_killed_host_is_removed_and_the_log_of_a_failed_one_is_kept() {
    let run = Run::start(&["--actors", "1", "--listen", "tls/127.0.0.1:0"]);
    let endpoint = run.endpoint();
    let key = run.running.run.join("join.key").display().to_string();
    let place = Workplace::new();
    let temporary = place.path().join("temporary");
    std::fs::create_dir(&temporary).unwrap();
    let entries = |directory: &Path| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(directory).unwrap();
        entries.map(|entry| entry.unwrap().path()).collect()
    };
    // What only looks like the directory of a killed host, or is not this user's.
    let other = |name: &str| {
        std::fs::create_dir(temporary.join(name)).unwrap();
        std::fs::write(temporary.join(name).join("config.toml"), "").unwrap();
        temporary.join(name)
    };
    let linked = other("elsewhere");
    std::os::unix::fs::symlink(&linked, temporary.join("shoal-join-0000000000000001")).unwrap();
    other("shoal-join-notes");
    let just_made = temporary.join("shoal-join-0000000000000002");
    std::fs::create_dir(&just_made).unwrap();
    if rustix::process::getuid().is_root() {
        let foreign = other("shoal-join-0000000000000003");
        std::os::unix::fs::chown(foreign, Some(65534), None).unwrap();
    }
    let others = entries(&temporary);
    // Starts a host, and waits until its processes work in its directory.
    let join = || {
        let before = entries(&temporary);
        let mut command = place.shoal(&["join", &endpoint, "--actors", "1", "--key", &key]);
        let joined = command
            .env("TMPDIR", &temporary)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let is_ready = |path: &PathBuf| {
            let log = std::fs::read_to_string(path.join("shoal.log")).unwrap_or_default();
            !before.contains(path) && log.contains("every role is ready")
        };
        let mut found = None;
        until("every role is ready", || {
            found = entries(&temporary).into_iter().find(is_ready);
            found.is_some()
        });
        (joined, found.unwrap())
    };
    let (mut killed, its_directory) = join();
    assert!(its_directory.join("join.key").exists());
    killed.kill().unwrap();
    killed.wait().unwrap();
    let (mut living, at_work) = join();
    assert!(!its_directory.exists());
    let (mut failing, with_log) = join();
    std::fs::remove_file(with_log.join("config.toml")).unwrap();
    until("the host has failed", || failing.try_wait().unwrap().is_some());
    let failed = failing.wait_with_output().unwrap();
    assert_eq!(failed.status.code(), Some(1));
    let log = with_log.join("shoal.log");
    assert!(String::from_utf8_lossy(&failed.stderr).contains(&log.display().to_string()));
    assert_eq!(entries(&with_log), [log]);
    let (mut last, _) = join();
    assert!(at_work.join("join.key").exists());
    stop(run);
    for host in [&mut living, &mut last] {
        until("the host has ended", || host.try_wait().unwrap().is_some());
        assert!(host.wait().unwrap().success());
    }
    let left: HashSet<PathBuf> = entries(&temporary).into_iter().collect();
    assert_eq!(left, others.into_iter().chain([with_log]).collect());
    assert!(linked.join("config.toml").exists());
}
