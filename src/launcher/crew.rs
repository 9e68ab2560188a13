//! All processes of a run: who is there, who is ready, who has to be started again, and who is given up.

use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use shoal_common::channel::Domain;
use shoal_common::config::Config;
use shoal_common::durable::write_atomically;
use shoal_common::report::{Activity, Heartbeat, Identity, Role};
use shoal_common::run_dir::RunDir;

use super::log::Log;
use super::process::{Process, name};

/// Failures in a row after which a role is given up.
const LIMIT: u32 = 5;

/// The pause before the first restart after a failure; each further one is twice as long.
const FIRST_PAUSE: Duration = Duration::from_millis(100);

/// How long a process may take to be ready before it counts as stuck.
const READY: Duration = Duration::from_secs(60);

/// A process that is killed after so long was killed by somebody; one that goes earlier may well be killing itself.
const SETTLED: Duration = Duration::from_secs(1);

/// A process that has worked for so long has recovered from whatever made its predecessors fail.
const RECOVERED: Duration = Duration::from_secs(30);

/// How long actors may take to hand over their last chunks, and the learner to save its state.
const ACTORS_END: Duration = Duration::from_secs(3);
const OTHERS_END: Duration = Duration::from_secs(15);

/// How the crew is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    AtWork,
    LearnerDone,
}

/// All processes of a run.
#[derive(Debug)]
pub(super) struct Crew {
    members: Vec<Member>,
    log: Log,
    run: PathBuf,
    /// Where the number of processes ever started is kept: incarnations are never used twice, not by a resumed run either.
    counter: PathBuf,
    started: u64,
    all_ready: bool,
}

#[derive(Debug)]
struct Member {
    identity: Identity,
    process: Option<Process>,
    begun: Instant,
    /// Failures since the last time it had recovered.
    failures: u32,
    restarts: u32,
    restart_at: Instant,
    heartbeat: Option<Heartbeat>,
}

impl Crew {
    pub(super) fn new(config: &Config, run: &RunDir, log: Log) -> anyhow::Result<Self> {
        let counter = run.path().join("incarnations");
        let started = read_counter(&counter)?;
        let actors = 0..config.actors.count;
        let members = [
            (Role::Learner, 0),
            (Role::EnvServer, config.evaluation_server()),
            (Role::Evaluator, 0),
        ]
        .into_iter()
        .chain(actors.flat_map(|i| [(Role::EnvServer, i), (Role::Actor, i)]))
        .map(|(role, index)| Member {
            identity: Identity {
                role,
                index,
                incarnation: 0,
            },
            process: None,
            begun: Instant::now(),
            failures: 0,
            restarts: 0,
            restart_at: Instant::now(),
            heartbeat: None,
        })
        .collect();
        Ok(Self {
            members,
            log,
            run: run.path().into(),
            counter,
            started,
            all_ready: false,
        })
    }

    /// Starts everyone.
    pub(super) fn start_all(&mut self) -> anyhow::Result<()> {
        (0..self.members.len()).try_for_each(|i| self.start(i))
    }

    fn start(&mut self, i: usize) -> anyhow::Result<()> {
        self.started += 1;
        let text = self.started.to_string();
        write_atomically(&self.counter, |file| std::io::Write::write_all(file, text.as_bytes()))
            .with_context(|| format!("cannot write {}", self.counter.display()))?;
        let member = &mut self.members[i];
        member.identity.incarnation = self.started;
        let process = Process::start(member.identity, &self.run, &self.log)?;
        self.log
            .note(&name(member.identity), &format!("started as process {}", process.pid()));
        member.process = Some(process);
        member.begun = Instant::now();
        member.heartbeat = None;
        Ok(())
    }

    /// Takes note of a sign of life.
    pub(super) fn hear(&mut self, heartbeat: &Heartbeat) {
        let member = self.members.iter_mut().find(|member| {
            let Identity {
                role,
                index,
                incarnation,
            } = member.identity;
            (heartbeat.role(), heartbeat.index, heartbeat.incarnation) == (Some(role), index, incarnation)
        });
        if let Some(member) = member {
            member.heartbeat = Some(*heartbeat);
        }
        if !self.all_ready && self.members.iter().all(|member| member.heartbeat.is_some()) {
            self.all_ready = true;
            self.log.note("launcher", "every role is ready");
        }
    }

    /// What the members of a role are doing: what the first one says that was heard of.
    pub(super) fn activity(&self, role: Role) -> Option<Activity> {
        let mut of_role = self.members.iter().filter(|member| member.identity.role == role);
        of_role.find_map(|member| member.heartbeat?.activity())
    }

    /// How often processes were started again.
    pub(super) fn restarts(&self) -> u32 {
        self.members.iter().map(|member| member.restarts).sum()
    }

    /// Notices who has ended, and starts them again when their time has come.
    pub(super) fn look_after(&mut self, domain: &Domain) -> anyhow::Result<State> {
        for i in 0..self.members.len() {
            let member = &mut self.members[i];
            let Some(process) = &mut member.process else {
                if Instant::now() >= member.restart_at {
                    member.restarts += 1;
                    self.start(i)?;
                }
                continue;
            };
            if member.heartbeat.is_none() && member.begun.elapsed() >= READY {
                self.log
                    .note(&name(member.identity), "is not ready after a minute, and was killed");
                process.kill();
            }
            let Some(status) = process.exit_status() else {
                continue;
            };
            member.process = None;
            let name = name(member.identity);
            if member.identity.role == Role::Learner && status.success() {
                self.log.note(&name, "done");
                return Ok(State::LearnerDone);
            }
            // Its places in shared memory are free for its successor.
            domain.clean();
            let ready = member.heartbeat.is_some();
            if member.begun.elapsed() >= RECOVERED {
                member.failures = 0;
            }
            // Killed while it worked is nobody's fault; ending by itself, or before it has settled, is a failure.
            let settled = ready && member.begun.elapsed() >= SETTLED;
            let pause = if settled && status.signal().is_some() {
                Duration::ZERO
            } else {
                member.failures += 1;
                FIRST_PAUSE * 2_u32.pow(member.failures.min(LIMIT) - 1)
            };
            self.log
                .note(&name, &format!("{}; starting it again in {pause:?}", ending(status)));
            if member.failures >= LIMIT {
                self.give_up(i, status)?;
            }
            self.members[i].restart_at = Instant::now() + pause;
        }
        Ok(State::AtWork)
    }

    fn give_up(&self, i: usize, status: ExitStatus) -> anyhow::Result<()> {
        let name = name(self.members[i].identity);
        let lines = self.log.last_lines(&name);
        let said = lines
            .last()
            .map_or("it said nothing", |line| line.strip_prefix("error: ").unwrap_or(line));
        bail!(
            "{name} failed {LIMIT} times and is given up ({}): {said}",
            ending(status)
        );
    }

    /// Ends everyone: the actors first, so that the learner still takes what they send.
    pub(super) fn end_all(&mut self) {
        self.end(|role| role == Role::Actor, ACTORS_END);
        self.end(|_| true, OTHERS_END);
        self.log.note("launcher", "every role has ended");
    }

    fn end(&mut self, which: impl Fn(Role) -> bool, patience: Duration) {
        let deadline = Instant::now() + patience;
        let mut leaving: Vec<_> = self
            .members
            .iter_mut()
            .filter(|member| which(member.identity.role))
            .collect();
        for process in leaving.iter_mut().filter_map(|member| member.process.as_mut()) {
            process.ask_to_end();
        }
        loop {
            for member in &mut leaving {
                if member
                    .process
                    .as_mut()
                    .is_some_and(|process| process.exit_status().is_some())
                {
                    member.process = None;
                }
            }
            if leaving.iter().all(|member| member.process.is_none()) {
                return;
            }
            if Instant::now() >= deadline {
                break;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        for member in leaving {
            if member.process.take().is_some() {
                self.log
                    .note(&name(member.identity), "did not end when asked to, and was killed");
            }
        }
    }
}

/// Processes ever started in this run.
fn read_counter(path: &Path) -> anyhow::Result<u64> {
    /// More than any run starts, and far from overflowing when it is counted on.
    const LIMIT: u64 = 1 << 60;
    let text = match std::fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(0),
        text => text.with_context(|| format!("cannot read {}", path.display()))?,
    };
    let number = std::str::from_utf8(&text)
        .ok()
        .and_then(|text| text.trim().parse().ok());
    number.filter(|started| *started < LIMIT).with_context(|| {
        format!(
            "{} is damaged: write a number into it that is greater than every incarnation in the run's log",
            path.display()
        )
    })
}

fn ending(status: ExitStatus) -> String {
    match (status.signal(), status.code()) {
        (Some(signal), _) => format!("killed by signal {signal}"),
        (_, Some(code)) => format!("ended with exit code {code}"),
        _ => "ended".into(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn counted(bytes: &[u8]) -> anyhow::Result<u64> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("incarnations");
        std::fs::write(&path, bytes).unwrap();
        let counted = read_counter(&path);
        assert_eq!(std::fs::read(path).unwrap(), bytes);
        counted
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn a_counter_is_a_number_that_can_be_counted_on_or_refused(
            bytes in prop_oneof![
                prop::collection::vec(any::<u8>(), 0..30),
                "[ +-]?[0-9]{0,25}\n?".prop_map(String::into_bytes),
                any::<u64>().prop_map(|n| n.to_string().into_bytes()),
            ],
        ) {
            match counted(&bytes) {
                Ok(started) => prop_assert!(started < 1 << 60),
                Err(error) => prop_assert!(error.to_string().contains("incarnations is damaged"), "{}", error),
            }
        }
    }

    #[test]
    fn a_counter_that_is_not_there_is_none() {
        assert_eq!(read_counter(Path::new("/nowhere/incarnations")).unwrap(), 0);
        assert_eq!(counted(b"17").unwrap(), 17);
        assert!(counted(b"18446744073709551615").is_err() && counted(b"").is_err());
    }
}
