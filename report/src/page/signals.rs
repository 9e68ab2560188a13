//! The signals of an episode in the form that the page shows.

use serde::Serialize;
use shoal_common::space::EnvironmentSpec;
use shoal_env_server::environment::Signal;
use shoal_run::evaluation::rollout::Trajectory;

use super::numbers::short;

/// A signal with its value at each frame; NaN where it has none.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Trace {
    /// The name under which the page's scripts find it.
    pub(super) key: String,
    pub(super) label: String,
    /// Empty for counts.
    pub(super) unit: String,
    /// Its bounds, if the environment's spaces have any.
    pub(super) range: Option<[f64; 2]>,
    pub(super) values: Vec<f64>,
}

/// The environment's signals in an episode, followed by the reward and the return so far, at `frames`, which are
/// indices of the episode's T + 1 states. An action belongs to the state in which it is taken, a reward to the state
/// that follows.
pub(super) fn traces(
    signals: &[Signal],
    spec: &EnvironmentSpec,
    trajectory: &Trajectory,
    frames: &[usize],
) -> Vec<Trace> {
    let at_frames = |values: &[f64]| {
        let value = |t: &usize| short(values.get(*t).copied().unwrap_or(f64::NAN));
        frames.iter().map(value).collect()
    };
    let stated = signals.iter().map(|signal| Trace {
        key: signal.key.clone(),
        label: signal.label.clone(),
        unit: signal.unit.clone(),
        range: signal.range(spec),
        values: at_frames(&trajectory.values(signal.source)),
    });
    let reward: Vec<f64> = [f64::NAN].iter().chain(&trajectory.rewards).copied().collect();
    let sums = trajectory.rewards.iter().scan(0.0, |sum, reward| {
        *sum += reward;
        Some(*sum)
    });
    let so_far: Vec<f64> = [0.0].into_iter().chain(sums).collect();
    let every = [("reward", "reward", reward), ("return", "return so far", so_far)].map(|(key, label, values)| Trace {
        key: key.into(),
        label: label.into(),
        unit: String::new(),
        range: None,
        values: at_frames(&values),
    });
    stated.chain(every).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_common::config::Config;
    use shoal_common::space::Space;
    use shoal_run::description;
    use shoal_run::evaluation::rollout::Rollout;
    use shoal_run::testing::small;

    /// Traces of the episode that starts in this state.
    fn traces_from(config: &Config, parameters: &[f32], state: &[f64], frames: &[usize]) -> Vec<Trace> {
        let mut rollout = Rollout::new(config, parameters).unwrap();
        let trajectory = rollout.episode_from(state).unwrap();
        traces(
            &description::of(config).unwrap().signals,
            &config.spec,
            &trajectory,
            frames,
        )
    }

    #[test]
    fn actions_belong_to_the_state_before_the_step_and_rewards_to_the_state_after_it() {
        let trajectory = Trajectory {
            observations: vec![vec![0.0], vec![1.0], vec![2.0]],
            actions: vec![vec![5.0], vec![6.0]],
            rewards: vec![-1.0, -3.0],
            terminated: true,
        };
        let spec = EnvironmentSpec {
            observation: Space::boxed(&[(0.0, 9.0)]),
            action: Space::boxed(&[(f32::NEG_INFINITY, f32::INFINITY)]),
            time_limit: 2,
            state_width: 0,
        };
        let traces = traces(&Signal::by_number(&spec), &spec, &trajectory, &[0, 1, 2]);
        let keys: Vec<&str> = traces.iter().map(|trace| trace.key.as_str()).collect();
        assert_eq!(keys, ["observation-1", "action-1", "reward", "return"]);
        assert_eq!((traces[0].range, traces[1].range), (Some([0.0, 9.0]), None));
        assert_eq!(traces[0].values, [0.0, 1.0, 2.0]);
        assert_eq!(traces[1].values[..2], [5.0, 6.0]);
        assert!(traces[1].values[2].is_nan() && traces[2].values[0].is_nan());
        assert_eq!(traces[2].values[1..], [-1.0, -3.0]);
        assert_eq!(traces[3].values, [0.0, -1.0, -4.0]);
    }

    #[test]
    fn a_hanging_pendulum_is_half_a_turn_from_upright() {
        let (config, parameters) = small("name = \"pendulum\"\ntime_limit = 3");
        let traces = traces_from(&config, &parameters, &[std::f64::consts::PI, 0.0], &[0, 3]);
        assert_eq!(traces[0].key, "angle");
        assert!(
            traces[0]
                .values
                .iter()
                .all(|angle| (angle.abs() - std::f64::consts::PI).abs() < 1e-3),
            "{traces:?}"
        );
    }

    #[test]
    fn the_position_of_the_vehicle_comes_from_the_observation() {
        let (config, parameters) = small("name = \"point-mass\"\nreward = \"r3\"");
        let traces = traces_from(&config, &parameters, &[1.5, -2.0, 0.0, 0.0], &[0]);
        let first: Vec<(&str, f64)> = traces.iter().map(|t| (t.label.as_str(), t.values[0])).take(3).collect();
        assert_eq!(first, [("x", 1.5), ("y", -2.0), ("distance to the goal", 2.5)]);
        assert_eq!(traces[0].range, Some([-4.0, 4.0]));
    }
}
