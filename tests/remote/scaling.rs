//! The actors of joined hosts are scaled.

use std::path::PathBuf;

use crate::hosts::{Host, Run, in_replay, stop, wait_for_actors};
use crate::support::{Leftovers, error_line, sent};

#[test]
fn scale_changes_the_actors_of_joined_hosts_without_losing_a_row() {
    let run = Run::start(&["--actors", "1", "--set", "actors.max=8"]);
    let hosts = [("a", "2"), ("b", "1")].map(|(name, actors)| Host::join(&run, &["--actors", actors, "--name", name]));
    wait_for_actors(&run, &[1, 2, 3]);
    let scale = |arguments: &[&str]| run.place.output(&[&["scale", "run"], arguments].concat());
    let actors_of = |name: &str| {
        let hosts = run.hosts();
        hosts
            .iter()
            .find(|host| host["name"] == name)
            .map(|host| host["actors"].clone())
    };
    for (refused, why) in [
        (&["--host", "c=2"][..], "no host \"c\" has joined"),
        (&["--host", "b=7"], "that would be 10 actors"),
        (&["--total", "2"], "cannot be shared by 3 hosts"),
    ] {
        let output = scale(refused);
        assert_eq!(output.status.code(), Some(1));
        assert!(error_line(&output).contains(why), "{}", error_line(&output));
    }
    // Rows flow throughout.
    wait_for_actors(&run, &[1, 2, 3]);
    let scaled = scale(&["--host", "b=3"]);
    assert!(scaled.status.success(), "{}", error_line(&scaled));
    assert_eq!(
        String::from_utf8_lossy(&scaled.stdout),
        "run: actors: 6, of them 1 on this host\n"
    );
    assert_eq!((actors_of("a"), actors_of("b")), (Some(2.into()), Some(3.into())));
    wait_for_actors(&run, &[0, 1, 2, 3, 4, 5]);
    // The learner's host takes what the others give up. No more than eight exist at any time.
    let scaled = scale(&["--total", "8", "--host", "a=1", "--host", "b=1"]);
    assert!(scaled.status.success(), "{}", error_line(&scaled));
    assert_eq!((actors_of("a"), actors_of("b")), (Some(1.into()), Some(1.into())));
    wait_for_actors(&run, &[0, 1, 2, 3, 4, 5, 6, 7]);
    // All have as many cores.
    let scaled = scale(&["--total", "6"]);
    assert!(scaled.status.success(), "{}", error_line(&scaled));
    assert_eq!((actors_of("a"), actors_of("b")), (Some(2.into()), Some(2.into())));
    assert_eq!(run.place.status("run")["actors"], 2);
    assert!(scale(&["--actors", "1"]).status.success());
    assert_eq!((actors_of("a"), actors_of("b")), (Some(2.into()), Some(2.into())));
    let path = stop(run);
    let attempts = |host: &Host| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(host.place.path()).unwrap();
        let is_host = |path: &PathBuf| path.join("shoal.log").exists();
        entries.map(|entry| entry.unwrap().path()).filter(is_host).collect()
    };
    let directories: Vec<PathBuf> = hosts.iter().flat_map(attempts).collect();
    assert_eq!(directories.len(), 3 + 4);
    let all: Vec<u32> = (0..8).collect();
    let sent_by = |directory: &PathBuf| all.iter().map(|actor| sent(directory, *actor)).sum::<u64>();
    let everywhere = directories.iter().chain([&path]).map(sent_by).sum::<u64>();
    for directory in directories {
        Leftovers::of(&directory).wait_until_gone();
    }
    for host in hosts {
        host.ends_with(0);
    }
    assert_eq!(in_replay(&path, &all), everywhere);
}
