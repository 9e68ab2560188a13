//! The scripts that `shoal join --template` prints.

use std::process::Command;

use crate::hosts::{Run, stop, wait_for_actors};
use crate::support::{self, Workplace, error_line, until};

/// The template as an executable file, with this text replaced.
fn template(place: &Workplace, name: &str, replaced: (&str, &str)) -> std::path::PathBuf {
    let printed = place.output(&["join", "--template", name]);
    assert!(printed.status.success());
    let text = String::from_utf8(printed.stdout).unwrap();
    assert!(text.contains(replaced.0), "{text}");
    let path = place.path().join(format!("{name}.sh"));
    std::fs::write(&path, text.replacen(replaced.0, replaced.1, 1)).unwrap();
    path
}

#[test]
fn the_script_for_slurm_trains_joins_and_resumes() {
    let place = Workplace::new();
    let quick = place.path().join("quick.toml");
    let text = "[environment]\nname = \"pendulum\"\n[ddpg]\nhidden = [24, 16]\n\
                [replay]\nwarmup = 64\ncapacity = 5000\n[evaluation]\nepisodes = 2\nfinal_episodes = 3\n";
    std::fs::write(&quick, text).unwrap();
    let script = template(&place, "slurm", ("what=pendulum", &format!("what={}", quick.display())));
    let bin = std::path::Path::new(env!("CARGO_BIN_EXE_shoal")).parent().unwrap();
    let path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap());
    let job = |role: &str| {
        let mut command = Command::new("bash");
        command
            .arg(&script)
            .arg(role)
            .current_dir(place.path())
            .env("PATH", &path);
        command
            .env("RUN", place.path().join("run"))
            .env("SLURM_CPUS_PER_TASK", "2");
        command.env("TMPDIR", place.path());
        command
    };
    let run = place.path().join("run");
    let rows = || {
        let commits = shoal_common::commit::CommitReader::open(&run.join("replay.bin"));
        commits.map_or([0; 3], |commits| [0, 2, 3].map(|actor| commits.actor(actor).rows))
    };
    // The array may start before the learner. The second round is that of jobs that are requeued during the run.
    for _ in 0..2 {
        let before = rows();
        let actors = job("actors").spawn().unwrap();
        let learner = job("learner").spawn().unwrap();
        until("every actor has more rows in the replay", || {
            rows().iter().zip(before).all(|(now, before)| *now > before)
        });
        let stopped = place.output(&["stop", "run"]);
        assert!(stopped.status.success(), "{}", error_line(&stopped));
        for mut job in [learner, actors] {
            until("the job has ended", || job.try_wait().unwrap().is_some());
            assert!(job.wait().unwrap().success());
        }
    }
    let steps =
        support::parse(&String::from_utf8(place.output(&["status", "run", "--json"]).stdout).unwrap())["env_steps"]
            .as_u64()
            .unwrap();
    let last = format!("run.steps={}", steps + 100);
    let finished = place.output(&["resume", "run", "--set", &last, "--quiet"]);
    assert!(finished.status.success(), "{}", error_line(&finished));
    // Jobs that are requeued after the end find nothing left to do.
    assert!(support::output_of(&mut job("actors")).status.success());
    let again = support::output_of(&mut job("learner"));
    assert!(error_line(&again).contains("already"));
    assert_eq!(support::output_of(&mut job("neither")).status.code(), Some(2));
}

#[test]
fn the_script_for_ssh_joins_with_the_key_from_standard_input() {
    let run = Run::start(&["--actors", "1", "--listen", "tls/127.0.0.1:0"]);
    let place = Workplace::new();
    let script = template(&place, "ssh", ("ACTORS:-4", "ACTORS:-1"));
    // Instead of going to a host, its command is run here.
    let bin = place.path().join("bin");
    std::fs::create_dir(&bin).unwrap();
    let shoal = env!("CARGO_BIN_EXE_shoal");
    std::fs::write(bin.join("ssh"), format!("#!/bin/sh\nshift 2\nexec {shoal} \"$@\"\n")).unwrap();
    let executable = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    std::fs::set_permissions(bin.join("ssh"), executable).unwrap();
    let mut command = Command::new("bash");
    command
        .arg(&script)
        .env("RUN", &run.running.run)
        .env("HOSTS", "one two")
        .env("TMPDIR", place.path());
    command.env("PATH", format!("{}:{}", bin.display(), std::env::var("PATH").unwrap()));
    let mut joined = command.spawn().unwrap();
    until("both hosts are there", || run.hosts().len() == 2);
    wait_for_actors(&run, &[1, 2]);
    stop(run);
    until("the script has ended", || joined.try_wait().unwrap().is_some());
    assert!(joined.wait().unwrap().success());
}
