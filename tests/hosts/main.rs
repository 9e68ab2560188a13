//! Hosts as far apart as one machine allows: each has a network, a `/dev/shm` and a root directory of its own, and a
//! virtual cable connects them. The cable is unplugged and made silent, and processes are killed meanwhile. All traffic
//! stays between the two.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

#[path = "../support/suite.rs"]
mod suite;
#[path = "../support/mod.rs"]
mod support;

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::Duration;

use shoal_common::config::Config;
use suite::{Need, test};
use support::{QUICK, Running, Workplace, check_stored_rows, committed, sent, until, wait_for_rows};

/// Network namespaces and virtual cables.
static NAMESPACES: Need = Need::new(
    "this machine makes no network namespaces (root and iproute2 are needed)",
    makes_namespaces,
    None,
);

/// What `slow_cable.py` needs besides.
static SLOW_CABLES: Need = Need::new(
    "this machine makes no network namespaces, or has no TUN devices or no python3",
    || {
        let python = Command::new("python3").arg("--version").output();
        makes_namespaces() && Path::new("/dev/net/tun").exists() && python.is_ok_and(|output| output.status.success())
    },
    None,
);

fn makes_namespaces() -> bool {
    let name = format!("shoal-try-{}-{:?}", std::process::id(), std::thread::current().id());
    let made = try_ip(&["netns", "add", &name]);
    made && try_ip(&["netns", "del", &name])
}

fn main() -> ExitCode {
    suite::run(vec![
        test!(
            a_pendulum_is_trained_by_two_hosts_and_nothing_else_is_contacted,
            NAMESPACES
        ),
        test!(cut_cables_and_killed_processes_lose_and_repeat_no_row, NAMESPACES),
        test!(a_slow_cable_that_loses_packets_loses_and_repeats_no_row, SLOW_CABLES),
    ])
}

fn try_ip(arguments: &[&str]) -> bool {
    Command::new("ip")
        .args(arguments)
        .output()
        .is_ok_and(|output| output.status.success())
}

fn ip(arguments: &[&str]) {
    assert!(try_ip(arguments), "ip {}", arguments.join(" "));
}

/// Two hosts and the cable between them.
struct Cable {
    number: u32,
    /// Passes the packets if the cable is slow.
    slow: Option<Child>,
}

const LEARNER: &str = "a";
const OTHER: &str = "b";

impl Cable {
    /// `number` distinguishes it from the cables of other tests.
    fn new(number: u32) -> Self {
        let cable = Self::without_cable(number);
        let [learner, other] = [LEARNER, OTHER].map(|host| cable.namespace(host));
        let [plug, socket] = [LEARNER, OTHER].map(|host| cable.device(host));
        ip(&[
            "link", "add", &plug, "netns", &learner, "type", "veth", "peer", "name", &socket, "netns", &other,
        ]);
        for (host, address) in [(LEARNER, "1"), (OTHER, "2")] {
            let (name, device) = (cable.namespace(host), cable.device(host));
            ip(&[
                "-n",
                &name,
                "addr",
                "add",
                &format!("10.99.{number}.{address}/24"),
                "dev",
                &device,
            ]);
            ip(&["-n", &name, "link", "set", &device, "up"]);
        }
        cable
    }

    /// A cable that delays every packet by `delay` and loses the share `loss` of them.
    fn slow(number: u32, delay: Duration, loss: f64) -> Self {
        let mut cable = Self::without_cable(number);
        let program = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hosts/slow_cable.py");
        let mut command = Command::new("python3");
        command.arg(program);
        for (host, address) in [(LEARNER, "1"), (OTHER, "2")] {
            command.args([cable.namespace(host), format!("10.99.{number}.{address}")]);
        }
        command.args([delay.as_millis().to_string(), loss.to_string()]);
        let mut slow = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let mut ready = [0; 6];
        slow.stdout.as_mut().unwrap().read_exact(&mut ready).unwrap();
        assert_eq!(&ready, b"ready\n");
        cable.slow = Some(slow);
        cable
    }

    /// The two hosts.
    fn without_cable(number: u32) -> Self {
        let cable = Self { number, slow: None };
        for host in [LEARNER, OTHER] {
            let name = cable.namespace(host);
            ip(&["netns", "add", &name]);
            ip(&["-n", &name, "link", "set", "lo", "up"]);
        }
        cable
    }

    fn namespace(&self, host: &str) -> String {
        format!("shoal-{}-{}{host}", std::process::id(), self.number)
    }

    fn device(&self, host: &str) -> String {
        format!("v{}{host}", self.number)
    }

    fn endpoint(&self) -> String {
        format!("tls/10.99.{}.1:7447", self.number)
    }

    /// Unplugs the cable, which both hosts notice, or plugs it in.
    fn set_plugged(&self, plugged: bool) {
        let state = if plugged { "up" } else { "down" };
        ip(&[
            "-n",
            &self.namespace(LEARNER),
            "link",
            "set",
            &self.device(LEARNER),
            state,
        ]);
    }

    /// Drops every packet silently, or lets packets pass again.
    fn set_silent(&self, silent: bool) {
        for host in [LEARNER, OTHER] {
            let device = self.device(host);
            let queue: &[&str] = if silent {
                // No packet is as short as this.
                &[
                    "add", "dev", &device, "root", "tbf", "rate", "1kbit", "burst", "10", "limit", "10",
                ]
            } else {
                &["del", "dev", &device, "root"]
            };
            let mut command = Command::new("ip");
            command
                .args(["netns", "exec", &self.namespace(host), "tc", "qdisc"])
                .args(queue);
            assert!(command.output().unwrap().status.success(), "{command:?}");
        }
    }

    /// The program on a host, in this directory.
    fn shoal(&self, host: &str, place: &Workplace, arguments: &[&str]) -> Command {
        let own = "mount -t tmpfs tmpfs /dev/shm && mount -t tmpfs tmpfs \"$0\" && exec \"$@\"";
        let root = format!("/tmp/shoal-{}", rustix::process::getuid().as_raw());
        std::fs::create_dir_all(&root).unwrap();
        let mut command = Command::new("ip");
        command.args([
            "netns",
            "exec",
            &self.namespace(host),
            "unshare",
            "--mount",
            "sh",
            "-c",
            own,
            &root,
        ]);
        command
            .arg(env!("CARGO_BIN_EXE_shoal"))
            .args(arguments)
            .current_dir(place.path());
        command
    }

    /// The addresses, besides its own, that a host has a connection with or listens for: remote addresses of its TCP
    /// connections, and local ones of its UDP sockets.
    fn contacts(&self, host: &str) -> Vec<String> {
        let list = |file: &str| {
            let path = format!("/proc/net/{file}");
            let mut command = Command::new("ip");
            let read = command
                .args(["netns", "exec", &self.namespace(host), "cat", &path])
                .output()
                .unwrap();
            String::from_utf8(read.stdout).unwrap()
        };
        let column = |text: String, column: usize| -> Vec<String> {
            let lines = text.lines().skip(1).map(str::to_owned);
            lines
                .filter_map(|line| Some(line.split_whitespace().nth(column)?.to_owned()))
                .collect()
        };
        let mut found = [
            column(list("tcp"), 2),
            column(list("tcp6"), 2),
            column(list("udp"), 1),
            column(list("udp6"), 1),
        ]
        .concat();
        // The remote address of a listening socket.
        found.retain(|address| address != "00000000:0000" && address != "00000000000000000000000000000000:0000");
        found.sort();
        found.dedup_by_key(|address| address.split(':').next().map(str::to_owned));
        found
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        if let Some(slow) = &mut self.slow {
            drop(slow.stdin.take());
            slow.wait().unwrap();
        }
        for host in [LEARNER, OTHER] {
            try_ip(&["netns", "del", &self.namespace(host)]);
        }
    }
}

/// A run on one host, and what has joined it on the other.
struct Pair {
    cable: Cable,
    learner: (Workplace, Running),
    other: (Workplace, Running),
}

impl Pair {
    fn start(cable: Cable, settings: &[&str]) -> Self {
        let place = Workplace::logging_chunks();
        let endpoint = cable.endpoint();
        let train = [
            "train", "pendulum", "--run", "run", "--actors", "1", "--json", "--listen", &endpoint,
        ];
        let train = [&train[..], settings].concat();
        let running = place.launch_command("run", &mut cable.shoal(LEARNER, &place, &train));
        let key = running.run.join("join.key").display().to_string();
        let other = Workplace::logging_chunks();
        let join = ["join", &endpoint, "--key", &key, "--actors", "2", "--local", "host"];
        let joined = other.launch_command("host", &mut cable.shoal(OTHER, &other, &join));
        Self {
            cable,
            learner: (place, running),
            other: (other, joined),
        }
    }

    /// What a command of the program prints on the learner's host.
    fn output(&self, arguments: &[&str]) -> String {
        let launcher = self.learner.1.launcher().to_string();
        let run = self.learner.1.run.display().to_string();
        let arguments: Vec<&str> = arguments
            .iter()
            .map(|word| if *word == "run" { &run } else { *word })
            .collect();
        let mut command = Command::new("nsenter");
        command.args(["--target", &launcher, "--mount", "--net", env!("CARGO_BIN_EXE_shoal")]);
        let output = command.args(arguments).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    }

    /// What `status` says of the other host.
    fn host(&self) -> serde_json::Value {
        let status: serde_json::Value = serde_json::from_str(&self.output(&["status", "run", "--json"])).unwrap();
        status["hosts"][0].clone()
    }

    fn state_of_host(&self) -> serde_json::Value {
        self.host()["state"].clone()
    }

    fn rows_of_host(&self) -> u64 {
        let run = &self.learner.1.run;
        [1, 2].map(|actor| committed(run, actor)).iter().sum()
    }

    fn wait_for_host(&self) {
        let before = self.rows_of_host();
        until("rows of the other host arrive", || self.rows_of_host() > before);
    }

    /// Stops the run; the other host ends with it. Returns the rows that its actors have sent, and those in the replay.
    fn stop(self) -> (u64, u64) {
        self.output(&["stop", "run"]);
        let run: PathBuf = self.learner.1.run.clone();
        let (code, ..) = self.learner.1.wait_for_launcher();
        assert_eq!(code, Some(0), "{}", self.learner.0.stderr());
        let host = self.other.1.run.clone();
        let (code, ..) = self.other.1.wait_for_launcher();
        assert_eq!(code, Some(0), "{}", self.other.0.stderr());
        let rows = [1, 2].map(|actor| committed(&run, actor)).iter().sum();
        check_stored_rows(&run, &Config::load(&run.join("config.toml")).unwrap());
        ([1, 2].map(|actor| sent(&host, actor)).iter().sum(), rows)
    }
}

fn a_pendulum_is_trained_by_two_hosts_and_nothing_else_is_contacted() {
    let quick = [&QUICK[..], &["--steps", "100000"]].concat();
    let pair = Pair::start(Cable::new(41), &quick);
    pair.wait_for_host();
    // Addresses are in hexadecimal, the last byte first.
    for (host, other) in [(LEARNER, "0229630A"), (OTHER, "0129630A")] {
        let contacts = pair.cable.contacts(host);
        assert!(
            contacts.iter().all(|contact| contact.starts_with(other)),
            "{host}: {contacts:?}"
        );
        assert!(!contacts.is_empty());
    }
    let Pair { cable, learner, other } = pair;
    let run = learner.1.run.clone();
    let (code, printed) = learner.1.wait_for_launcher();
    assert_eq!(code, Some(0), "{}", learner.0.stderr());
    assert_eq!(support::parse(&printed)["env_steps"], 100_000);
    let (code, _) = other.1.wait_for_launcher();
    assert_eq!(code, Some(0), "{}", other.0.stderr());
    assert!([0, 1, 2].iter().all(|actor| committed(&run, *actor) > 0));
    drop(cable);
}

fn cut_cables_and_killed_processes_lose_and_repeat_no_row() {
    let settings = [
        &QUICK[..],
        &["--steps", "100000000", "--set", "replay.updates_per_step=0.2"],
    ]
    .concat();
    let pair = Pair::start(Cable::new(42), &settings);
    pair.wait_for_host();
    for (seconds, silent) in [(1, false), (4, false), (1, true), (5, true)] {
        let cut = |cut: bool| match silent {
            true => pair.cable.set_silent(cut),
            false => pair.cable.set_plugged(!cut),
        };
        cut(true);
        // The others go on, and what is killed meanwhile comes back.
        wait_for_rows(&pair.learner.1, 50);
        match (seconds, silent) {
            (1, false) => pair.learner.1.kill_if_alive("gate-0"),
            (4, false) => pair.other.1.kill_if_alive("relay-0"),
            (1, true) => pair.learner.1.kill_if_alive("learner-0"),
            _ => pair.other.1.kill_if_alive("env-server-1"),
        }
        std::thread::sleep(Duration::from_secs(seconds));
        if seconds > 3 {
            until("the host is shown as cut off", || pair.state_of_host() == "cut-off");
        }
        cut(false);
        pair.wait_for_host();
        until("the host is shown as connected", || pair.state_of_host() == "connected");
    }
    for role in ["relay-0", "gate-0"] {
        let running = if role == "gate-0" {
            &pair.learner.1
        } else {
            &pair.other.1
        };
        running.stop_role(role);
        std::thread::sleep(Duration::from_secs(8));
        running.continue_role(role);
        pair.wait_for_host();
    }
    pair.wait_for_host();
    let (sent, in_replay) = pair.stop();
    assert!(sent > 0);
    assert_eq!(in_replay, sent);
}

fn a_slow_cable_that_loses_packets_loses_and_repeats_no_row() {
    let settings = [
        &QUICK[..],
        &["--steps", "100000000", "--set", "replay.updates_per_step=0.2"],
    ]
    .concat();
    let delay = Duration::from_millis(20);
    let pair = Pair::start(Cable::slow(43, delay, 0.02), &settings);
    pair.wait_for_host();
    for role in ["gate-0", "relay-0", "learner-0", "env-server-1"] {
        let running = if ["gate-0", "learner-0"].contains(&role) {
            &pair.learner.1
        } else {
            &pair.other.1
        };
        running.kill_if_alive(role);
        wait_for_rows(&pair.learner.1, 400);
        pair.wait_for_host();
    }
    until("the round trip is shown", || {
        pair.host()["round_trip_us"].as_u64().is_some()
    });
    let round_trip = Duration::from_micros(pair.host()["round_trip_us"].as_u64().unwrap());
    assert!(round_trip >= 2 * delay, "{round_trip:?}");
    let (sent, in_replay) = pair.stop();
    assert!(sent > 0);
    assert_eq!(in_replay, sent);
}
