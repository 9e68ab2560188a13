//! A run checks memory, disk space and limits before anything starts. Everything it creates is private to its owner.
//! Tests that need small file systems mount them in a namespace of their own; if the machine allows none, they are
//! ignored.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]
#![allow(clippy::print_stderr, reason = "a test prints what it measured")]

#[path = "support/suite.rs"]
mod suite;
mod support;

use std::fs;
use std::os::unix::fs::{MetadataExt, chown};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Output, Stdio};
use std::sync::OnceLock;

use rustix::process::{Pid, Signal, kill_process};
use suite::{Need, ROOT, test};
use support::{Leftovers, QUICK, Running, Workplace, committed, error_line, json, until};

const SHOAL: &str = env!("CARGO_BIN_EXE_shoal");
const ENDLESS: [&str; 2] = ["--steps", "100000000"];
const PAGE: u64 = 4096;

fn main() -> ExitCode {
    suite::run(vec![
        test!(a_run_reserves_at_most_the_computed_memory_and_at_least_half_of_it),
        test!(
            the_default_run_fits_into_a_container_and_one_with_64_actors_is_refused,
            NAMESPACE
        ),
        test!(memory_reserved_for_another_run_is_not_free, NAMESPACE),
        test!(leftovers_that_cannot_be_removed_do_not_prevent_a_start, NAMESPACE),
        test!(a_full_disk_is_reported_before_anything_is_created, NAMESPACE),
        test!(a_disk_that_fills_up_ends_the_run_with_one_line, NAMESPACE),
        test!(a_read_only_directory_is_reported, NAMESPACE),
        test!(the_limit_of_open_files_is_raised_or_an_error_is_reported),
        test!(everything_a_run_creates_is_private_to_its_owner),
        test!(runs_of_two_users_do_not_affect_each_other, ROOT),
        test!(another_users_files_with_the_name_of_a_run_change_nothing, ROOT),
    ])
}

/// Permission to mount file systems in a private namespace.
static NAMESPACE: Need = Need::new(
    "this machine allows no mount namespace",
    || unshare_options().is_some(),
    None,
);

/// The options of `unshare` with which this machine allows mounting, if any do; tried once.
fn unshare_options() -> Option<&'static [&'static str]> {
    const WAYS: [&[&str]; 2] = [&["--mount"], &["--user", "--map-root-user", "--mount"]];
    static WAY: OnceLock<Option<&[&str]>> = OnceLock::new();
    let allowed = |way: &&[&str]| {
        let mount = ["sh", "-c", "mount -t tmpfs tmpfs /mnt"];
        let tried = Command::new("unshare").args(*way).args(mount).output();
        tried.is_ok_and(|output| output.status.success())
    };
    *WAY.get_or_init(|| WAYS.into_iter().find(allowed))
}

/// Runs a shell script in a mount namespace. `$SHOAL` is the program, `$QUICK` the quick settings. Only for tests that
/// need a [`NAMESPACE`].
fn in_namespace(place: &Workplace, script: &str) -> Output {
    let quick: Vec<String> = QUICK.iter().map(|argument| argument.replace(' ', "")).collect();
    let mut command = Command::new("unshare");
    command
        .args(unshare_options().unwrap())
        .args(["sh", "-ec", script])
        .env("SHOAL", SHOAL)
        .env("QUICK", quick.join(" "))
        .current_dir(place.path())
        .stdin(Stdio::null());
    support::output_of(&mut command)
}

/// Mounts 64 MB of shared memory and a private `/tmp/shoal-<uid>`. With the outer directory, the next start would find
/// killed runs whose files it cannot see.
const CONTAINER: &str = "mount -t tmpfs -o size=64m tmpfs /dev/shm
    mkdir -p /tmp/shoal-$(id -u); mount -t tmpfs -o mode=700 tmpfs /tmp/shoal-$(id -u)
    ";

fn files_of(running: &Running) -> Vec<PathBuf> {
    let files = running.leftovers().files().into_iter();
    files.map(|name| Path::new("/dev/shm").join(name)).collect()
}

/// A directory and everything in it, at any depth.
fn everything_in(directory: &Path) -> Vec<PathBuf> {
    let mut found = vec![directory.to_owned()];
    let mut next = 0;
    while let Some(path) = found.get(next) {
        if path.is_dir() {
            let inside: Vec<PathBuf> = fs::read_dir(path).unwrap().map(|entry| entry.unwrap().path()).collect();
            found.extend(inside);
        }
        next += 1;
    }
    found
}

fn is_private(path: &Path) -> bool {
    // A file may be removed in between.
    fs::symlink_metadata(path).is_ok_and(|metadata| metadata.mode() & 0o077 == 0) || !path.exists()
}

fn a_run_reserves_at_most_the_computed_memory_and_at_least_half_of_it() {
    for arguments in [
        &["--actors", "1", "--set", "actors.max=1"][..],
        &["--actors", "12", "--set", "actors.max=12"],
        &[
            "--actors",
            "3",
            "--set",
            "actors.max=3",
            "--envs",
            "40",
            "--set",
            "actors.window=40",
        ],
        &[
            "--actors",
            "6",
            "--set",
            "actors.max=6",
            "--set",
            "ddpg.hidden=[400, 300]",
        ],
        &[
            "--actors",
            "2",
            "--set",
            "actors.max=2",
            "--set",
            "actors.chunk_steps=2000",
        ],
    ] {
        let place = Workplace::new();
        let running = place.start_as("run", &[&QUICK[..], &ENDLESS, arguments].concat());
        // A role opens its last channels after it has reported that it is ready.
        let actors: usize = arguments[1].parse().unwrap();
        until("the learner has rows of every actor", || {
            (0..actors).all(|actor| committed(&running.run, actor) > 0)
        });
        until("something is learned", || running.learned("updates") > 0);
        let files = files_of(&running);
        let recorded = |path: &PathBuf| path.to_str()?.split_once("_reserved_")?.1.parse().ok();
        let computed: u64 = files.iter().find_map(recorded).unwrap();
        let reserved: u64 = files
            .iter()
            .map(|path| fs::metadata(path).unwrap().len().next_multiple_of(PAGE))
            .sum();
        assert!(
            reserved <= computed && computed <= 2 * reserved,
            "{arguments:?}: {reserved} bytes reserved, {computed} computed"
        );
    }
}

fn the_default_run_fits_into_a_container_and_one_with_64_actors_is_refused() {
    let place = Workplace::new();
    let output = in_namespace(
        &place,
        &format!("{CONTAINER} exec $SHOAL train pendulum --steps 1300 --run run --json"),
    );
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(json(&output)["env_steps"], 1300);

    let refused = in_namespace(
        &place,
        &format!("{CONTAINER} exec $SHOAL train pendulum --steps 1300 --run large --json --actors 64"),
    );
    let message = error_line(&refused);
    assert!(
        message.contains("MiB of /dev/shm for up to 64 actors, but only 64.0 MiB are free: allow at most "),
        "{message}"
    );
    assert!(!place.path().join("large").exists(), "nothing was created");
}

fn leftovers_that_cannot_be_removed_do_not_prevent_a_start() {
    let place = Workplace::new();
    // A directory that something is mounted on cannot be removed.
    let left = "left=/tmp/shoal-$(id -u)/left; mkdir $left; mount -t tmpfs tmpfs $left";
    let train = "$SHOAL train pendulum --steps 300 --run run --json $QUICK; test -d $left";
    let output = in_namespace(&place, &format!("{CONTAINER} {left}\n{train}"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(json(&output)["env_steps"], 300);
}

fn memory_reserved_for_another_run_is_not_free() {
    let place = Workplace::new();
    let script = "$SHOAL train pendulum --steps 100000000 --run first --quiet & first=$!
        timeout 60 sh -c 'until ls /dev/shm | grep -q reserved; do sleep 0.05; done'
        $SHOAL train pendulum --steps 100 --run second --json || code=$?
        kill $first; wait $first || true
        exit $code";
    let output = in_namespace(&place, &[CONTAINER, script].concat());
    let message = error_line(&output);
    assert!(message.contains("of /dev/shm"), "{message}");
    assert!(!place.path().join("second").exists(), "nothing was created");
}

fn a_full_disk_is_reported_before_anything_is_created() {
    let place = Workplace::new();
    fs::create_dir(place.path().join("small")).unwrap();
    let script = "mount -t tmpfs -o size=8m tmpfs small
        $SHOAL train pendulum --run small/run --json || code=$?
        ls small
        exit $code";
    let output = in_namespace(&place, script);
    let message = error_line(&output);
    assert!(
        message.contains("of disk and") && message.contains("small has 8.0 MiB"),
        "{message}"
    );
}

fn a_disk_that_fills_up_ends_the_run_with_one_line() {
    let place = Workplace::new();
    fs::create_dir(place.path().join("small")).unwrap();
    let script = "mount -t tmpfs -o size=32m tmpfs small
        $SHOAL train pendulum --steps 100000000 --run small/run $QUICK --quiet --json & run=$!
        timeout 60 sh -c 'until test -s small/run/checkpoints/latest.ckpt; do sleep 0.05; done'
        cat /dev/zero > small/filler 2>/dev/null || true
        timeout 60 tail --pid=$run -f /dev/null
        wait $run";
    let output = in_namespace(&place, script);
    let message = error_line(&output);
    assert!(message.contains("No space left on device"), "{message}");
}

fn a_read_only_directory_is_reported() {
    let place = Workplace::new();
    fs::create_dir(place.path().join("closed")).unwrap();
    let script = "mount -t tmpfs -o ro tmpfs closed; exec $SHOAL train pendulum --run closed/run --json";
    let output = in_namespace(&place, script);
    let message = error_line(&output);
    assert!(
        message.contains("closed/run") && message.contains("Read-only file system"),
        "{message}"
    );

    place.train(&["pendulum", "--steps", "300", "--run", "run"]);
    let closed = "mount --bind run run; mount -o remount,bind,ro run;";
    let evaluated = in_namespace(
        &place,
        &format!("{closed} exec $SHOAL eval run --policy last --episodes 2 --json"),
    );
    assert_eq!(json(&evaluated)["episodes"], 2, "reading is enough");
    let message = error_line(&in_namespace(&place, &format!("{closed} exec $SHOAL plot run")));
    assert!(
        message.contains(".svg") && message.contains("Read-only file system"),
        "{message}"
    );
}

fn the_limit_of_open_files_is_raised_or_an_error_is_reported() {
    let place = Workplace::new();
    let limited = |limit: &str, run: &str| {
        let script = format!("ulimit {limit}; exec {SHOAL} train pendulum --steps 300 --run {run} --json \"$@\"");
        let mut command = Command::new("sh");
        command
            .args(["-c", &script, "sh"])
            .args(QUICK)
            .current_dir(place.path());
        support::output_of(&mut command)
    };
    let message = error_line(&limited("-n 64", "run"));
    assert!(
        message.contains("open files") && message.contains("the limit is 64"),
        "{message}"
    );
    assert!(!place.path().join("run").exists(), "nothing was created");
    let output = limited("-Sn 32", "run");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn everything_a_run_creates_is_private_to_its_owner() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    until("there is a checkpoint", || {
        running.run.join("checkpoints/latest.ckpt").exists()
    });
    let user = rustix::process::getuid().as_raw();
    // It closes everything below it.
    let root = PathBuf::from(format!("/tmp/shoal-{user}"));
    let files = files_of(&running);
    assert!(files.len() > 50, "{files:?}");
    let open = |paths: Vec<PathBuf>| paths.into_iter().filter(|path| !is_private(path)).collect::<Vec<_>>();
    let none: [PathBuf; 0] = [];
    assert_eq!(open([files, vec![root]].concat()), none);
    assert_eq!(open(everything_in(&running.run)), none);
    running.signal(rustix::process::Signal::INT);
    running.wait();
    assert!(place.output(&["plot", "run", "--out", "figures"]).status.success());
    assert_eq!(open(everything_in(&place.path().join("run"))), none);
    let figures = everything_in(&place.path().join("figures"));
    assert!(figures.len() > 1);
    assert_eq!(open(figures), none);
}

fn runs_of_two_users_do_not_affect_each_other() {
    const NOBODY: u32 = 65534;
    let (place, other) = (Workplace::new(), Workplace::new());
    let running = place.start("run", &ENDLESS);
    until("something is learned", || running.learned("updates") > 0);
    let state = || {
        let mut files: Vec<_> = files_of(&running)
            .into_iter()
            .map(|path| fs::metadata(path).map(|metadata| metadata.ino()).unwrap())
            .collect();
        files.sort_unstable();
        (files, running.log().lines().count())
    };
    let before = state();

    // The other user may have no access to the program's own directory.
    let program = other.path().join("shoal");
    fs::copy(SHOAL, &program).unwrap();
    chown(other.path(), Some(NOBODY), Some(NOBODY)).unwrap();
    let mut command = Command::new(&program);
    command
        .args(["train", "pendulum", "--steps", "300", "--run", "run", "--json"])
        .args(QUICK)
        .current_dir(other.path())
        .env("HOME", other.path())
        .uid(NOBODY)
        .gid(NOBODY);
    let output = support::output_of(&mut command);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(json(&output)["env_steps"], 300);
    for path in everything_in(&other.path().join("run")) {
        assert_eq!(fs::metadata(&path).unwrap().uid(), NOBODY, "{}", path.display());
    }
    let root = fs::metadata(format!("/tmp/shoal-{NOBODY}")).unwrap();
    assert_eq!((root.uid(), root.mode() & 0o777), (NOBODY, 0o700));
    let left = Leftovers::of(&other.path().join("run"));
    assert!(left.files().is_empty(), "{:?} of {}", left.files(), left.run_id());
    assert_eq!(state(), before, "the first run was not touched");
}

/// Removes files and kills a process when dropped.
struct Cleanup(Vec<PathBuf>, std::process::Child);

impl Drop for Cleanup {
    fn drop(&mut self) {
        for path in &self.0 {
            let _ = fs::remove_file(path);
        }
        // The roles end with the launcher.
        let _ = self.1.kill();
        let _ = self.1.wait();
    }
}

fn another_users_files_with_the_name_of_a_run_change_nothing() {
    const OWNER: u32 = 65534;
    const OTHER: u32 = 20_002;
    let place = Workplace::new();
    // The other user may have no access to the program's own directory.
    fs::copy(SHOAL, place.path().join("shoal")).unwrap();
    chown(place.path(), Some(OWNER), Some(OWNER)).unwrap();
    let owner = |arguments: &[&str]| {
        let mut command = Command::new(place.path().join("shoal"));
        command
            .args(arguments)
            .current_dir(place.path())
            .env("HOME", place.path());
        command.uid(OWNER).gid(OWNER);
        command
    };
    let quick = ["train", "pendulum", "--run", "run", "--steps", "100000000", "--quiet"];
    let mut cleanup = Cleanup(Vec::new(), owner(&[&quick[..], &QUICK[..]].concat()).spawn().unwrap());
    let run = place.path().join("run");
    let log = || fs::read_to_string(run.join("shoal.log")).unwrap_or_default();
    until("every role is ready", || log().contains("every role is ready"));
    let id = Leftovers::of(&run).run_id().to_owned();

    for name in ["x", "y.global_mgmt", "reserved_1", "0_0.connection"] {
        let path = PathBuf::from(format!("/dev/shm/shoal_{id}_{name}"));
        fs::write(&path, "").unwrap();
        chown(&path, Some(OTHER), Some(OTHER)).unwrap();
        cleanup.0.push(path);
    }
    let works = |arguments: &[&str]| {
        let output = support::output_of(&mut owner(arguments));
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    works(&["status", "run"]);
    let started = || log().matches("started as process").count();
    let before = started();
    let processes = Leftovers::of(&run).processes();
    kill_process(Pid::from_raw(*processes.last().unwrap()).unwrap(), Signal::KILL).unwrap();
    until("a killed process is replaced", || started() > before);
    works(&["stop", "run"]);
    assert!(cleanup.1.wait().unwrap().success());
    works(&["resume", "run", "--steps", &(rows(&run) + 300).to_string(), "--quiet"]);
    works(
        &[
            &["train", "pendulum", "--run", "next", "--steps", "300", "--quiet"],
            &QUICK[..],
        ]
        .concat(),
    );
    for path in cleanup.0.drain(..) {
        fs::remove_file(path).unwrap();
    }
    assert!(Leftovers::of(&run).files().is_empty());
}

fn rows(run: &Path) -> u64 {
    shoal_common::commit::CommitReader::open(&run.join("replay.bin"))
        .unwrap()
        .rows()
}
