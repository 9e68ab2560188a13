use ratatui::Terminal;
use ratatui::backend::TestBackend;
use shoal_common::channel::control::{HostStatus, RunStatus};

use super::super::RunEvent;
use super::*;

fn status() -> RunStatus {
    let role = |role, index, state, rate| RoleStatus {
        role,
        index,
        pid: Some(1_000 + index),
        state,
        restarts: 1,
        rate,
        policy_version: (role != Role::EnvServer).then_some(12_345),
        policy_lag: (role == Role::Actor).then_some(3),
    };
    let working = RoleState::Working;
    RunStatus {
        roles: vec![
            role(Role::Learner, 0, working, 523.0),
            role(Role::EnvServer, 16, working, 0.0),
            role(Role::Evaluator, 0, RoleState::WaitingForPeer, 0.0),
            role(Role::EnvServer, 0, working, 262.0),
            role(Role::Actor, 0, RoleState::WaitingForRatio, 262.0),
            role(Role::EnvServer, 1, working, 261.0),
            role(Role::Actor, 1, RoleState::Restarting, 0.0),
        ],
        env_steps: 60_000,
        steps: 120_000,
        updates: 59_000,
        actors: 2,
        ratio: 1.0,
        updates_per_step: 1.0,
        updates_per_second: 523.4,
        env_steps_per_second: 524.0,
        eval_return_mean: Some(-150.25),
        waiting: Some("actors wait: ratio 1.00 of 1.00".into()),
        ..RunStatus::default()
    }
}

fn screen() -> Screen {
    let mut screen = Screen::new("runs/pendulum-1".into(), "pendulum, ddpg, free".into(), true);
    let evaluations = vec![(2_000.0, -1_400.0), (4_000.0, -900.0), (6_000.0, -140.5)];
    for _ in 0..3 {
        screen.handle(RunEvent::Running(Box::new(status()), evaluations.clone()));
    }
    screen
}

fn terminal(screen: &Screen, width: u16, height: u16) -> Terminal<TestBackend> {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| draw(frame, screen)).unwrap();
    terminal
}

fn lines(screen: &Screen, width: u16, height: u16) -> Vec<String> {
    let terminal = terminal(screen, width, height);
    let buffer = terminal.backend().buffer();
    let line = |y| (0..width).map(|x| buffer[(x, y)].symbol()).collect::<String>();
    (0..height).map(|y| line(y).trim_end().to_owned()).collect()
}

#[test]
fn a_terminal_of_usual_size_shows_everything() {
    let lines = lines(&screen(), 80, 24);
    assert_eq!(lines[0], "runs/pendulum-1 running  pendulum, ddpg, free");
    assert!(
        lines[1].contains("60,000 of 120,000 steps, 59,000 updates"),
        "{lines:#?}"
    );
    assert_eq!(lines[2], "523 updates/s, 524 steps/s, eval -150.25, best -140.50");
    assert_eq!(lines[3], "ratio 1.00 of 1.00; actors wait");
    assert!(
        lines[4].starts_with("role") && lines[4].contains("restarts"),
        "{lines:#?}"
    );
    let row = |name: &str| {
        lines
            .iter()
            .find(|line| line.starts_with(name))
            .unwrap_or_else(|| panic!("{lines:#?}"))
    };
    assert!(row("learner 0").contains("523/s") && row("learner 0").contains("12,345"));
    assert!(row("actor 0").contains("waits (ratio)"));
    assert!(row("actor 1").contains("restarting"));
    assert!(row("env-server 16").contains("1016"));
    let text = lines.join("\n");
    assert!(
        text.contains("return over steps") && text.contains("updates/s, at most 523"),
        "{text}"
    );
    assert!(text.contains("6,000") && text.contains("-1400"), "{text}");
    assert_eq!(lines[23], "+/- actors  s stop  ? help  q quit");
}

#[test]
fn other_hosts_are_shown_below_the_roles() {
    let mut screen = screen();
    let host = |name: &str, state| HostStatus {
        host: 1,
        name: name.into(),
        state,
        actors: 4,
        wanted_actors: 4,
        rows_per_second: 1_234.5,
        resent_chunks: 7,
        round_trip_us: Some(1_250),
        policy_lag: 3,
        silent_seconds: 5.2,
        roles: Vec::new(),
    };
    screen.status.hosts = vec![host("node-2", HostState::Connected), host("node-3", HostState::CutOff)];
    for height in [20, 30] {
        let lines = lines(&screen, 80, height);
        let row = |name: &str| {
            let found = lines.iter().find(|line| line.starts_with(name));
            found.unwrap_or_else(|| panic!("{lines:#?}")).clone()
        };
        assert!(row("host").contains("round trip"));
        assert!(row("node-2").contains("connected") && row("node-2").contains("1.2 ms"));
        assert!(row("node-3").contains("cut off for 5 s"));
        assert!(row("learner 0").contains("working"));
    }
    // On a small terminal the roles come first.
    let lines = lines(&screen, 40, 10);
    assert!(lines[5].starts_with("learner 0"), "{lines:#?}");
}

#[test]
fn a_small_terminal_shows_the_most_important_part() {
    let lines = lines(&screen(), 40, 10);
    assert!(lines[0].starts_with("runs/pendulum-1 running"), "{lines:#?}");
    assert!(lines[1].contains("60,000 of 120,000"), "{lines:#?}");
    assert_eq!(lines[3], "ratio 1.00 of 1.00; actors wait");
    assert!(
        lines[5].starts_with("learner 0") && lines[5].contains("523/s"),
        "{lines:#?}"
    );
    assert_eq!(lines[8], "and 4 more");
    assert_eq!(lines[9], "+/- actors  s stop  ? help  q quit");
}

#[test]
fn terminals_of_any_size_are_drawn_on() {
    let mut screen = screen();
    for (width, height) in [(1, 1), (2, 40), (10, 3), (200, 2), (200, 60)] {
        for overlay in [Overlay::Nothing, Overlay::Help, Overlay::Stop] {
            screen.overlay = overlay;
            terminal(&screen, width, height);
        }
    }
}

#[test]
fn no_colours_are_used_if_switched_off() {
    let mut screen = screen();
    screen.colours = false;
    let terminal = terminal(&screen, 80, 24);
    let coloured = |cell: &&ratatui::buffer::Cell| (cell.fg, cell.bg) != (Color::Reset, Color::Reset);
    assert_eq!(terminal.backend().buffer().content().iter().filter(coloured).count(), 0);
    let with = {
        screen.colours = true;
        self::terminal(&screen, 80, 24)
    };
    assert!(with.backend().buffer().content().iter().filter(coloured).count() > 20);
}

#[test]
fn boxes_and_the_end_of_the_run_are_shown() {
    let mut screen = screen();
    screen.press('s');
    assert!(lines(&screen, 80, 24).join("\n").contains("Stop the run?"));
    screen.press('n');
    screen.press('?');
    assert!(lines(&screen, 40, 10).join("\n").contains("one actor more"));
    screen.handle(RunEvent::Ended(Box::new(status()), Vec::new()));
    let lines = lines(&screen, 80, 24);
    assert!(lines[0].contains("has ended"), "{lines:#?}");
    assert!(lines[23].contains("shoal resume runs/pendulum-1"), "{lines:#?}");
}
