//! The learner's host with its run, and the hosts that join it.

use crate::support::{QUICK, Running, Workplace, committed, sent, until};

/// Steps that no test reaches.
const ENDLESS: &str = "100000000";

/// A learner's host and its run, which others may join.
pub(crate) struct Run {
    pub(crate) place: Workplace,
    pub(crate) running: Running,
}

impl Run {
    pub(crate) fn start(arguments: &[&str]) -> Self {
        let place = Workplace::logging_chunks();
        let listens = arguments.contains(&"--listen");
        let listen: &[&str] = if listens { &[] } else { &["--listen", "tcp/127.0.0.1:0"] };
        let train = ["train", "pendulum", "--run", "run", "--steps", ENDLESS];
        let running = place.launch("run", &[&train[..], listen, &QUICK, arguments].concat());
        Self { place, running }
    }

    pub(crate) fn endpoint(&self) -> String {
        let file = std::fs::read_to_string(self.running.run.join("join.toml")).unwrap();
        let table: toml::Table = file.parse().unwrap();
        table["endpoint"].as_str().unwrap().to_owned()
    }

    /// What `status` says of the other hosts.
    pub(crate) fn hosts(&self) -> Vec<serde_json::Value> {
        self.place.status("run")["hosts"].as_array().unwrap().clone()
    }
}

/// Another host, which has joined a run.
pub(crate) struct Host {
    pub(crate) place: Workplace,
    pub(crate) running: Running,
}

impl Host {
    /// Joins with these arguments, and waits until all roles of the host are ready.
    pub(crate) fn join(run: &Run, arguments: &[&str]) -> Self {
        let place = Workplace::logging_chunks();
        let endpoint = run.endpoint();
        let arguments = [&["join", &endpoint, "--local", "host"], arguments].concat();
        let running = place.launch_command("host", &mut place.shoal(&arguments));
        Self { place, running }
    }

    /// Rows that its actors have sent.
    pub(crate) fn sent(&self, actors: &[u32]) -> u64 {
        actors.iter().map(|actor| sent(&self.running.run, *actor)).sum()
    }

    /// Waits until the host has ended with this exit code and has left nothing.
    pub(crate) fn ends_with(self, code: i32) {
        let (ended, _, leftovers) = self.running.wait();
        assert_eq!(ended, Some(code), "{}", self.place.stderr());
        assert!(leftovers.processes().is_empty(), "{:?}", leftovers.processes());
        assert!(leftovers.files().is_empty(), "{:?}", leftovers.files());
    }
}

pub(crate) fn stop(run: Run) -> std::path::PathBuf {
    let output = run.place.output(&["stop", "run"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let path = run.running.run.clone();
    let (code, _, leftovers) = run.running.wait();
    assert_eq!(code, Some(0), "{}", run.place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    // The run's directory must outlive its workplace.
    std::mem::forget(run.place);
    path
}

/// Waits for the end of this run, which `stop` asks for.
pub(crate) fn ends_as_stopped(run: Run, mut stop: std::process::Child) {
    until("the run is stopped", || stop.try_wait().unwrap().is_some());
    assert!(stop.wait().unwrap().success());
    let Run { place, running } = run;
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
}

/// Rows of these actors in the replay.
pub(crate) fn in_replay(run: &std::path::Path, actors: &[u32]) -> u64 {
    actors.iter().map(|actor| committed(run, *actor as usize)).sum()
}

/// Waits until the replay has more rows of each of these actors.
pub(crate) fn wait_for_actors(run: &Run, actors: &[u32]) {
    let rows = |actor: u32| committed(&run.running.run, actor as usize);
    let before: Vec<u64> = actors.iter().map(|actor| rows(*actor)).collect();
    until("every remote actor has more rows in the replay", || {
        actors.iter().zip(&before).all(|(actor, before)| rows(*actor) > *before)
    });
}
