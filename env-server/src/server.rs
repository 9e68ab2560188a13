//! The environment server's loop: answers the requests of one client by stepping its environments.

use shoal_base::role::Activity;
use shoal_base::stop::Stop;
use shoal_channel::environment::{EnvironmentPort, RequestKind};
use shoal_channel::{ChannelError, HeartbeatSender};

use crate::vector::{Reset, VectorEnvironment};

/// Answers requests until `stop`. `seed` determines the evaluation episodes.
///
/// # Errors
/// When the channel fails. An invalid request is refused and logged; it is not an error.
pub fn run(
    environments: &mut VectorEnvironment,
    port: &EnvironmentPort,
    seed: u64,
    mut heartbeat: HeartbeatSender,
    stop: &Stop,
) -> Result<(), ChannelError> {
    let mut started = false;
    heartbeat.beat(Activity::WaitingForPeer);
    loop {
        let request = match port.next(stop, || heartbeat.beat(Activity::WaitingForPeer)) {
            Ok(request) => request,
            Err(exit) => return exit.into_result(),
        };
        let refused = match request.kind() {
            Some(kind @ (RequestKind::Reset | RequestKind::ResetToTraining | RequestKind::ResetToEvaluation)) => {
                let first = request.episode();
                let episodes = vec![first; environments.count()];
                let reset = match kind {
                    RequestKind::ResetToTraining => Reset::Episodes(&episodes),
                    RequestKind::ResetToEvaluation => Reset::Evaluation {
                        seed,
                        first,
                        episodes: request.episodes(),
                    },
                    _ => Reset::Next,
                };
                heartbeat.announce_first_step();
                let refused = request
                    .respond(|_, blocks| environments.reset(reset, blocks.observations))?
                    .err();
                started |= refused.is_none();
                refused
            }
            Some(RequestKind::Step) if started => {
                heartbeat.announce_first_step();
                let refused = request
                    .respond(|actions, blocks| environments.step(actions, blocks))?
                    .err();
                if refused.is_none() {
                    heartbeat.count(environments.count() as u64);
                }
                heartbeat.beat(Activity::Working);
                refused
            }
            Some(RequestKind::Snapshot) if started => request
                .respond_with_snapshot(|words| environments.snapshot(words))?
                .err(),
            Some(RequestKind::Step | RequestKind::Snapshot) => {
                request.not_started()?;
                None
            }
            Some(RequestKind::Restore) => {
                let words = request.snapshot_words();
                heartbeat.announce_first_step();
                let refused = request
                    .respond(|_, blocks| environments.restore(&words, blocks.observations))?
                    .err();
                started |= refused.is_none();
                refused
            }
            _ => {
                request.refuse()?;
                None
            }
        };
        if let Some(error) = refused {
            tracing::error!("a request was refused: {error}");
        }
    }
}

#[cfg(test)]
mod tests {
    use shoal_base::report::{Heartbeat, PROVEN_STEPS};
    use shoal_base::role::{Role, RoleInstance};
    use shoal_channel::environment::{EnvironmentClient, StepResult};
    use shoal_channel::reports::Reports;
    use shoal_channel::{Domain, EventName, Listener, Services};

    use super::*;

    const ENVS: u32 = 250;

    fn pendulums() -> VectorEnvironment {
        VectorEnvironment::new("pendulum", &toml::Table::new(), ENVS, 1, 0, 0).unwrap()
    }

    /// Serves in a thread of its own.
    fn start(run_id: &str, client: EventName, stop: &Stop) -> std::thread::JoinHandle<()> {
        let (run_id, stop) = (run_id.to_owned(), stop.clone());
        std::thread::spawn(move || {
            let domain = Domain::join(&run_id, 1).unwrap();
            let mut environments = pendulums();
            let port = EnvironmentPort::open(&domain, 0, environments.spec().clone(), ENVS as usize, client).unwrap();
            let instance = RoleInstance {
                role: Role::EnvServer,
                index: 0,
                incarnation: 0,
            };
            let heartbeat = HeartbeatSender::new(&domain, instance).unwrap();
            run(&mut environments, &port, 1, heartbeat, &stop).unwrap();
            drop(port);
            domain.leave().unwrap();
        })
    }

    #[test]
    fn heartbeats_come_at_once_before_a_restore_at_the_first_step_and_when_the_server_is_able_to_work() {
        let run_id = format!("{:x}", std::process::id());
        let domain = Domain::join(&run_id, 1).unwrap();
        let mut services = Services::new(&domain).unwrap();
        services.create_common(&domain).unwrap();
        services.create_environment(&domain, 0).unwrap();
        let (own, stop) = (EventName(Role::Evaluator, 0), Stop::default());
        let listener = Listener::bind(&domain, own).unwrap();
        let heartbeats = Reports::<Heartbeat>::open(&domain).unwrap();
        let server = start(&run_id, own, &stop);
        let mut vector = pendulums();
        let client = EnvironmentClient::open(&domain, 0, vector.spec(), ENVS as usize, stop.clone()).unwrap();

        let mut words = vec![0; vector.snapshot_words()];
        let mut observations = vec![0.0; ENVS as usize * vector.spec().observation.width()];
        vector.reset(Reset::Next, &mut observations).unwrap();
        vector.snapshot(&mut words).unwrap();
        client.restore(&listener, &words, || ()).unwrap();
        let working = || -> Vec<u64> {
            std::iter::from_fn(|| heartbeats.receive().unwrap())
                .filter(|heartbeat| heartbeat.activity() == Some(Activity::Working))
                .map(|heartbeat| heartbeat.steps)
                .collect()
        };
        let before_the_first_step = working();
        let is_refused = client.step(&listener, &[0.0], || ()).is_err();
        // The server has finished with the refused step before it takes the next request.
        client.restore(&listener, &words, || ()).unwrap();
        let of_the_refused_step = working();
        for _ in 0..PROVEN_STEPS / u64::from(ENVS) {
            let taken = client.step(&listener, &vec![0.0; ENVS as usize], || ()).unwrap();
            assert!(matches!(taken, StepResult::Taken(_)));
        }
        stop.request();
        server.join().unwrap();
        let of_steps = working();
        drop((client, heartbeats, listener, services));
        domain.leave().unwrap();
        assert_eq!(before_the_first_step, [0]);
        assert!(is_refused, "one action is too few");
        assert!(
            of_the_refused_step.iter().all(|steps| *steps == 0),
            "{of_the_refused_step:?}"
        );
        assert!(of_steps.contains(&ENVS.into()), "{of_steps:?}");
        assert!(of_steps.contains(&PROVEN_STEPS), "{of_steps:?}");
    }
}
