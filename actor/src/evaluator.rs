//! The evaluator: runs the newest policy without exploration, always from the same start states, and keeps the best
//! one.

use std::num::NonZeroU32;
use std::path::Path;
use std::rc::Rc;

use shoal_common::channel::environment::{EnvironmentClient, ResetRequest, StepResult};
use shoal_common::channel::policy::{self, PolicyHeader, PolicyReader};
use shoal_common::channel::reports::Reporter;
use shoal_common::channel::{ChannelError, Domain, EventName, HeartbeatSender, Listener, Notifier, wait_for};
use shoal_common::config::Config;
use shoal_common::evaluator_state::EvaluatorState;
use shoal_common::exit::Exit;
use shoal_common::numbers::mean_and_std;
use shoal_common::policy::{Policy, PolicyLayout};
use shoal_common::policy_file::{PolicyFile, PolicyFileError};
use shoal_common::report::{EvaluatedPeriod, EvaluationReport};
use shoal_common::role::{Activity, Role, RoleInstance};
use shoal_common::run_dir::RunDir;
use shoal_common::stop::Stop;

use crate::environment::{after_fault, connect};
use crate::error::ActorError;

/// The settings of an evaluator.
#[derive(Clone, Debug)]
pub struct EvaluatorSettings {
    /// Which process this is.
    pub instance: RoleInstance,
    /// The run's configuration.
    pub config: Config,
    /// The environment server's index.
    server: u32,
    /// The number of environments that it steps at once.
    envs: usize,
    /// The run directory, where the best policy is written, and all evaluated ones if configured.
    pub run: RunDir,
    /// The period of the policy that a previous evaluator evaluated last.
    pub evaluated_period: Option<u64>,
}

impl EvaluatorSettings {
    /// The settings of this run's evaluator. `evaluated_period` is the period of the policy that a previous evaluator
    /// evaluated last.
    pub fn new(config: &Config, run: &RunDir, instance: RoleInstance, evaluated_period: Option<u64>) -> Self {
        Self {
            instance,
            config: config.clone(),
            server: config.evaluation_server(),
            envs: config.evaluation_envs() as usize,
            run: run.clone(),
            evaluated_period,
        }
    }
}

/// Decides whether a candidate replaces the best policy. Returns the one to keep, and whether it is the candidate.
/// Among many policies, some do well on a few episodes by chance. A candidate that seems better than the best must
/// therefore be better on other episodes too. `confirm` returns the mean return on these other episodes, or `None` if
/// nothing is to be confirmed.
fn better_of<E>(
    best: Option<EvaluatedPolicy>,
    mut candidate: EvaluatedPolicy,
    mut confirm: impl FnMut(&[f32]) -> Result<Option<f64>, E>,
) -> Result<(Option<EvaluatedPolicy>, bool), E> {
    if !candidate.mean.is_finite() {
        return Ok((best, false));
    }
    // A previous evaluator may have died after it wrote this policy and before it reported that. The policy is then
    // the best one already, and is reported now.
    let Some(mut best) = best.filter(|best| !best.is_same_policy(&candidate)) else {
        return Ok((Some(candidate), true));
    };
    let mut better = candidate.mean > best.mean;
    if better {
        if best.confirmed.is_none() {
            best.confirmed = confirm(&best.parameters)?;
        }
        if let Some(confirmed) = best.confirmed {
            candidate.confirmed = confirm(&candidate.parameters)?;
            better = candidate
                .confirmed
                .is_some_and(|mean| mean.is_finite() && (mean > confirmed || !confirmed.is_finite()));
        }
    }
    Ok((Some(if better { candidate } else { best }), better))
}

/// Evaluates policies until `stop`.
///
/// # Errors
/// When a channel fails, the environment is not the expected one, or the evaluator's state or a policy cannot be read
/// or written.
pub fn run(domain: &Domain, settings: &EvaluatorSettings, stop: &Stop) -> Result<(), ActorError> {
    let mut evaluator = match Evaluator::new(domain, settings, stop) {
        Ok(evaluator) => evaluator,
        Err(exit) => return exit.into_result(),
    };
    loop {
        if let Err(exit) = evaluator.evaluate_next() {
            return exit.into_result();
        }
    }
}

struct Evaluator<'a> {
    settings: &'a EvaluatorSettings,
    stop: &'a Stop,
    listener: Listener,
    learner: Notifier,
    client: EnvironmentClient,
    reader: PolicyReader,
    policy: Policy,
    evaluations: Reporter<EvaluationReport>,
    state: EvaluatorState,
    periods: Reporter<EvaluatedPeriod>,
    heartbeat: HeartbeatSender,
    actions: Vec<f32>,
    /// The period of the policy evaluated last.
    evaluated_period: Option<u64>,
    best: Option<EvaluatedPolicy>,
}

/// A policy with its evaluation.
struct EvaluatedPolicy {
    /// Its version.
    version: u64,
    /// Mean return of its evaluation; finite.
    mean: f64,
    parameters: Vec<f32>,
    /// Mean return on the confirmation episodes; `None` before they are run.
    confirmed: Option<f64>,
}

impl EvaluatedPolicy {
    /// The best policy that a previous evaluator kept in this file. One that diverged is ignored: earlier versions of
    /// the program may have kept one.
    fn kept(path: &Path, layout: &PolicyLayout) -> Result<Option<Self>, PolicyFileError> {
        let kept = PolicyFile::read_if_any(path, layout)?.filter(|kept| kept.return_mean.is_finite());
        Ok(kept.map(|kept| Self {
            version: kept.version,
            mean: kept.return_mean,
            parameters: kept.parameters,
            confirmed: None,
        }))
    }

    /// A restarted learner may give a version to another policy, so the parameters are compared too.
    fn is_same_policy(&self, other: &Self) -> bool {
        self.version == other.version && self.parameters == other.parameters
    }
}

impl<'a> Evaluator<'a> {
    fn new(domain: &Domain, settings: &'a EvaluatorSettings, stop: &'a Stop) -> Result<Self, Exit<ActorError>> {
        let policy = settings.config.policy(settings.envs)?;
        let layout = policy.layout();
        let listener = Listener::bind(domain, EventName(Role::Evaluator, settings.instance.index))?;
        let mut heartbeat = HeartbeatSender::new(domain, settings.instance)?;
        let client = connect(
            domain,
            &listener,
            settings.server,
            &settings.config.spec,
            settings.envs,
            stop,
        )?;
        let reader = PolicyReader::open(domain, layout.fingerprint(), layout.parameters())?;
        let best = EvaluatedPolicy::kept(&settings.run.best_policy(), &layout)?;
        let state = EvaluatorState::read(&settings.run.evaluator_state())?;
        // After failures, the launcher compares the versions that the evaluator begins with.
        heartbeat.set_policy_version(state.last().map_or(0, |evaluation| evaluation.policy_version));
        heartbeat.beat(Activity::WaitingForPeer);
        let evaluations = Reporter::open(domain)?;
        // The launcher skips evaluations that it has already recorded.
        state.evaluations().for_each(|evaluation| evaluations.send(*evaluation));
        let periods = Reporter::open(domain)?;
        if let Some(period) = settings.evaluated_period {
            periods.send(EvaluatedPeriod { period });
        }
        Ok(Self {
            settings,
            stop,
            learner: Notifier::new(domain, EventName(Role::Learner, 0))?,
            client,
            reader,
            evaluations,
            periods,
            state,
            heartbeat,
            actions: vec![0.0; settings.envs * settings.config.spec.action.width()],
            policy,
            listener,
            evaluated_period: settings.evaluated_period,
            best,
        })
    }

    fn evaluate_next(&mut self) -> Result<(), Exit<ActorError>> {
        let published = self.await_due_policy().map_err(Exit::convert)?;
        let header = published.header();
        let returns = self.returns(published.parameters(), 0, self.settings.config.evaluation.episodes)?;
        let (return_mean, return_std) = mean_and_std(&returns);
        let best = self.replace_if_better(&published, return_mean)?;
        if best {
            self.write_policy(&published, return_mean, return_std, &self.settings.run.best_policy())?;
        }
        if self.settings.config.evaluation.keep_policies {
            let path = self.settings.run.evaluated_policy(header.env_steps);
            self.write_policy(&published, return_mean, return_std, &path)?;
        }
        let period = self.settings.config.evaluation.period(header.env_steps);
        self.evaluated_period = Some(period);
        let evaluation = EvaluationReport {
            policy_version: header.version,
            env_steps: header.env_steps,
            updates: header.updates,
            return_mean,
            return_std,
            episodes: self.settings.config.evaluation.episodes,
            best: best.into(),
        };
        // Before the report: if this process dies in between, its successor sends the report.
        self.state
            .add(evaluation, &self.settings.run.evaluator_state())
            .map_err(ActorError::WriteEvaluatorState)?;
        self.evaluations.send(evaluation);
        self.periods.send(EvaluatedPeriod { period });
        self.learner.notify();
        Ok(())
    }

    /// Compares this policy with the best one, with further episodes of both if it seems better, and keeps the better
    /// one. Returns whether that is this policy.
    fn replace_if_better(&mut self, published: &policy::PublishedPolicy, mean: f64) -> Result<bool, Exit<ActorError>> {
        let candidate = EvaluatedPolicy {
            version: published.header().version,
            mean,
            parameters: published.parameters().to_vec(),
            confirmed: None,
        };
        let evaluation = &self.settings.config.evaluation;
        let first = evaluation.episodes;
        let episodes = first.saturating_mul(evaluation.confirm);
        let best = self.best.take();
        let (best, replaced) = better_of(best, candidate, |parameters| -> Result<_, Exit<ActorError>> {
            if episodes == 0 {
                return Ok(None);
            }
            Ok(Some(mean_and_std(&self.returns(parameters, first, episodes)?).0))
        })?;
        self.best = best;
        Ok(replaced)
    }

    /// Runs `episodes` evaluation episodes with these parameters, from number `first` on. Returns the returns of the
    /// episodes.
    fn returns(&mut self, parameters: &[f32], first: u32, episodes: u32) -> Result<Vec<f64>, Exit<ActorError>> {
        let mut returns = Vec::new();
        while (returns.len() as u32) < episodes {
            let done = returns.len() as u32;
            // If the server dies, its episodes are run again.
            match self.run_episodes(parameters, first.saturating_add(done), episodes - done) {
                Ok(Some(more)) => returns.extend(more),
                Ok(None) => {}
                Err(Exit::Failed(ActorError::Channel(error))) if error.fault().is_some() => {
                    after_fault(&error, &mut self.heartbeat, &self.listener, self.stop).map_err(Exit::convert)?;
                }
                Err(exit) => return Err(exit),
            }
        }
        Ok(returns)
    }

    /// Waits for a policy of a period that has not been evaluated.
    fn await_due_policy(&mut self) -> Result<Rc<policy::PublishedPolicy>, Exit<ChannelError>> {
        let Self {
            reader,
            evaluated_period,
            settings,
            listener,
            stop,
            heartbeat,
            evaluations,
            periods,
            ..
        } = self;
        let due = |header: &PolicyHeader| {
            evaluated_period.is_none_or(|period| settings.config.evaluation.period(header.env_steps) > period)
        };
        let published = wait_for(
            listener,
            stop,
            || Ok(reader.latest()?.filter(|policy| due(policy.header()))),
            || {
                heartbeat.beat(Activity::WaitingForPeer);
                evaluations.refresh_connections();
                periods.refresh_connections();
                Ok(())
            },
        )?;
        self.heartbeat.set_policy_version(published.header().version);
        Ok(published)
    }

    /// Runs evaluation episodes with these parameters, from number `first` on: one in each environment, and at most
    /// `episodes_left`. Returns the returns of the episodes, or `None` if the server was lost.
    fn run_episodes(
        &mut self,
        parameters: &[f32],
        first: u32,
        episodes_left: u32,
    ) -> Result<Option<Vec<f64>>, Exit<ActorError>> {
        let Self {
            client,
            listener,
            policy,
            heartbeat,
            actions,
            ..
        } = self;
        // No environment is reset more often than an episode is needed.
        let Some(episodes) = NonZeroU32::new(episodes_left.min(self.settings.envs as u32)) else {
            return Ok(Some(Vec::new()));
        };
        let request = ResetRequest::Evaluation {
            first: first.into(),
            episodes,
        };
        let begun = client.reset(listener, request, || {
            heartbeat.beat(Activity::WaitingForServer);
        });
        let mut current = begun.map_err(Exit::convert)?;
        let mut returns = vec![0.0; self.settings.envs];
        let mut running: Vec<_> = (0..self.settings.envs).map(|e| (e as u32) < episodes.get()).collect();
        while running.contains(&true) {
            policy.act(parameters, current.observations(), actions);
            let stepped = client.step(listener, actions, || heartbeat.beat(Activity::WaitingForServer));
            match stepped.map_err(Exit::convert)? {
                StepResult::Taken(next) => current = next,
                StepResult::Lost => return Ok(None),
            }
            for (e, (running, total)) in running.iter_mut().zip(&mut returns).enumerate() {
                if *running {
                    *total += f64::from(current.reward(e));
                    *running = !(current.terminated(e) || current.truncated(e));
                }
            }
            heartbeat.count(self.settings.envs as u64);
            heartbeat.beat(Activity::Working);
            if self.stop.requested() {
                return Err(Exit::Stopped);
            }
        }
        returns.truncate(episodes.get() as usize);
        Ok(Some(returns))
    }

    fn write_policy(
        &self,
        published: &policy::PublishedPolicy,
        return_mean: f64,
        return_std: f64,
        path: &Path,
    ) -> Result<(), ActorError> {
        let header = published.header();
        let file = PolicyFile {
            fingerprint: header.fingerprint,
            version: header.version,
            env_steps: header.env_steps,
            return_mean,
            return_std,
            episodes: self.settings.config.evaluation.episodes.into(),
            parameters: published.parameters().to_vec(),
        };
        Ok(file.write(path)?)
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use shoal_common::network::{Hidden, NetworkLayout};

    use super::*;

    /// A policy whose one parameter is its mean return on the episodes that confirm.
    fn policy(version: u64, mean: f64, confirmed: f32) -> EvaluatedPolicy {
        EvaluatedPolicy {
            version,
            mean,
            parameters: vec![confirmed],
            confirmed: None,
        }
    }

    /// The version that is the best one, whether it is the candidate, and how often something was confirmed.
    fn decided(best: Option<EvaluatedPolicy>, candidate: EvaluatedPolicy) -> (Option<u64>, bool, u32) {
        let mut asked = 0;
        let confirm = |parameters: &[f32]| {
            asked += 1;
            Ok::<_, Infallible>(Some(f64::from(parameters[0])))
        };
        let Ok((best, replaced)) = better_of(best, candidate, confirm);
        (best.map(|best| best.version), replaced, asked)
    }

    #[test]
    fn a_best_policy_that_cannot_be_inspected_is_an_error() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("best.policy");
        let network = NetworkLayout::new(1, Hidden::relu([1, 1]), 1);
        let layout = PolicyLayout::Deterministic(network);
        assert!(EvaluatedPolicy::kept(&path, &layout).unwrap().is_none());
        // To follow it fails, also for root.
        std::os::unix::fs::symlink(&path, &path).unwrap();
        assert!(EvaluatedPolicy::kept(&path, &layout).is_err());
    }

    #[test]
    fn a_better_policy_is_confirmed_and_one_that_diverged_never_is_the_best() {
        assert_eq!(decided(None, policy(1, 5.0, 5.0)), (Some(1), true, 0), "the first one");
        for diverged in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert_eq!(decided(None, policy(1, diverged, 5.0)), (None, false, 0));
            assert_eq!(
                decided(Some(policy(1, 5.0, 5.0)), policy(2, diverged, 9.0)),
                (Some(1), false, 0)
            );
        }
        let best = || Some(policy(1, 5.0, 5.0));
        assert_eq!(
            decided(best(), policy(2, 6.0, 5.5)),
            (Some(2), true, 2),
            "better in both"
        );
        assert_eq!(decided(best(), policy(2, 6.0, 4.5)), (Some(1), false, 2), "lucky");
        assert_eq!(decided(best(), policy(2, 6.0, f32::NAN)), (Some(1), false, 2));
        assert_eq!(decided(best(), policy(2, 4.0, 9.0)), (Some(1), false, 0), "worse");
        assert_eq!(
            decided(best(), policy(1, 4.0, 5.0)),
            (Some(1), true, 0),
            "the same one again"
        );
        assert_eq!(
            decided(best(), policy(1, 4.0, 4.0)),
            (Some(1), false, 0),
            "another policy with the version of the best"
        );
        let known = Some(EvaluatedPolicy {
            confirmed: Some(5.0),
            ..policy(1, 5.0, 5.0)
        });
        assert_eq!(
            decided(known, policy(2, 6.0, 5.5)),
            (Some(2), true, 1),
            "known from before"
        );
        let Ok((best, replaced)) = better_of(best(), policy(2, 6.0, 0.0), |_| Ok::<_, Infallible>(None));
        assert!(
            replaced && best.is_some_and(|best| best.version == 2),
            "nothing is confirmed"
        );
    }
}
