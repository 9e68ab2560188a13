//! The process of a role: reads the run directory, and starts the role with its settings.

use std::ffi::CString;
#[cfg(feature = "remote")]
use std::path::Path;
use std::process::ExitCode;

use anyhow::Context;
use shoal_actor::{actor, evaluator};
use shoal_common::channel::environment::EnvironmentPort;
use shoal_common::channel::{Domain, EventName, HeartbeatSender};
use shoal_common::config::{Config, Mode};
use shoal_common::message::say;
use shoal_common::role::{Role, RoleInstance};
use shoal_common::run_dir::RunDir;
use shoal_common::stop::Stop;
use shoal_env_server::vector::VectorEnvironment;
use shoal_learner::process;
#[cfg(feature = "remote")]
use shoal_remote::{
    endpoint::Endpoint,
    files::{HostFile, JoinFile, KeyFile},
};
use shoal_run::external_environment::server_location::LaunchContext;
use shoal_run::external_environment::{self, LaunchSpec, server_iceoryx2_config};
use shoal_run::status::evaluated_period;
use tracing_subscriber::Layer;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

use crate::cli::RoleArgs;
use crate::log_level::log_level;

/// Runs a role until it is done or its standard input closes.
pub(crate) fn run(role: Role, args: &RoleArgs) -> anyhow::Result<ExitCode> {
    #[cfg(feature = "remote")]
    if matches!(role, Role::Gate | Role::Relay) {
        shoal_remote::network::restart_with_one_thread()?;
    }
    // The log goes to the launcher through standard error. If the launcher is gone, losing it is not an error.
    let to_launcher = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(false)
        .with_target(false)
        .log_internal_errors(false);
    // Zenoh's own messages do not help readers of a run's log.
    let level = log_level();
    let of_network = if level == LevelFilter::TRACE {
        level
    } else {
        LevelFilter::ERROR
    };
    let targets = Targets::new().with_default(level).with_target("zenoh", of_network);
    let registry = tracing_subscriber::registry().with(to_launcher.with_filter(targets));
    #[cfg(feature = "remote")]
    let registry = registry.with(shoal_remote::refused::layer());
    registry.init();

    // For `ps` and `top`, which would otherwise show `exe`. The kernel keeps 15 bytes.
    if let Ok(name) = CString::new(format!("shoal-{}-{}", role.name(), args.index)) {
        let _ = rustix::thread::set_name(&name);
    }
    let run = RunDir::open(&args.run)?;
    let config = run.config()?;
    let instance = RoleInstance {
        role,
        index: args.index,
        incarnation: args.incarnation,
    };
    if role == Role::EnvServer
        && let Some(program) = launch_spec(&config, &run, instance)?.command(&config.environment)?
    {
        return external_environment::serve_with(&program);
    }
    let stop = Stop::when_stdin_closes().context("cannot watch standard input")?;
    let domain = Domain::join(&config.run.id, config.actors.max_on_a_host())?;
    let ended = work(&domain, &config, &run, instance, &stop);
    let left = domain.leave();
    ended?;
    if let Err(error) = left {
        // A process that leaves later removes the rest.
        say(error);
    }
    Ok(ExitCode::SUCCESS)
}

fn work(domain: &Domain, config: &Config, run: &RunDir, instance: RoleInstance, stop: &Stop) -> anyhow::Result<()> {
    match instance.role {
        Role::EnvServer => serve(domain, config, &launch_spec(config, run, instance)?, instance, stop),
        Role::Actor => {
            let settings = actor::ActorSettings::new(config, run, instance);
            Ok(actor::run(domain, &settings, stop)?)
        }
        Role::Evaluator => {
            let settings = evaluator::EvaluatorSettings::new(config, run, instance, evaluated_period(config, run)?);
            Ok(evaluator::run(domain, &settings, stop)?)
        }
        Role::Learner => {
            let settings = process::LearnerSettings {
                instance,
                config: config.clone(),
                run: run.clone(),
                evaluated_period: evaluated_period(config, run)?,
            };
            Ok(process::run(domain, &settings, stop)?)
        }
        #[cfg(feature = "remote")]
        Role::Gate => {
            let endpoint = JoinFile::read(run.path())?.listen;
            let settings = shoal_remote::gate::GateSettings {
                instance,
                config: config.clone(),
                run: run.clone(),
                key: key(&endpoint, &run.path().join(KeyFile::GATE))?,
                endpoint,
            };
            Ok(shoal_remote::gate::run(domain, &settings, stop)?)
        }
        #[cfg(feature = "remote")]
        Role::Relay => {
            let host = HostFile::read(run)?;
            let settings = shoal_remote::relay::RelaySettings {
                instance,
                config: config.clone(),
                run: run.clone(),
                key: key(&host.endpoint, &run.path().join(KeyFile::JOIN))?,
                host,
            };
            Ok(shoal_remote::relay::run(domain, &settings, stop)?)
        }
        #[cfg(not(feature = "remote"))]
        Role::Gate | Role::Relay => anyhow::bail!(shoal_remote::NOT_BUILT),
    }
}

/// The key for an endpoint; `None` if that needs none.
#[cfg(feature = "remote")]
fn key(endpoint: &Endpoint, path: &Path) -> anyhow::Result<Option<KeyFile>> {
    Ok(endpoint.is_encrypted().then(|| KeyFile::read(path)).transpose()?)
}

/// The arguments of an environment server.
fn launch_spec<'a>(config: &'a Config, run: &RunDir, instance: RoleInstance) -> anyhow::Result<LaunchSpec<'a>> {
    let RoleInstance { index, incarnation, .. } = instance;
    let (client, environments) = if index == config.evaluation_server() {
        (EventName(Role::Evaluator, 0), config.evaluation_envs())
    } else {
        (EventName(Role::Actor, index), config.actors.envs)
    };
    Ok(LaunchSpec {
        iceoryx2: server_iceoryx2_config(&config.run.id)?,
        run_id: &config.run.id,
        index,
        incarnation,
        client,
        environments,
        seed: config.run.seed,
        // A lockstep run must not depend on how often processes were started.
        stream: if config.run.mode == Mode::Lockstep {
            0
        } else {
            incarnation
        },
        launch_context: LaunchContext::of_run(run, config)?,
        pictures: None,
        description: None,
    })
}

fn serve(
    domain: &Domain,
    config: &Config,
    launch: &LaunchSpec<'_>,
    instance: RoleInstance,
    stop: &Stop,
) -> anyhow::Result<()> {
    let environment = &config.environment;
    let mut environments = VectorEnvironment::new(
        &environment.name,
        &environment.parameters,
        launch.environments,
        launch.seed,
        launch.index.into(),
        launch.stream,
    )?;
    let spec = environments.spec().clone();
    let port = EnvironmentPort::open(domain, launch.index, spec, environments.count(), launch.client)?;
    let heartbeat = HeartbeatSender::new(domain, instance)?;
    Ok(shoal_env_server::server::run(
        &mut environments,
        &port,
        launch.seed,
        heartbeat,
        stop,
    )?)
}
