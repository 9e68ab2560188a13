//! Ornstein-Uhlenbeck exploration noise (section 4.3.1), one process for each environment and action element.

use rand::RngExt;
use rand_distr::StandardNormal;
use shoal_common::config::{ExplorationConfig, Warmup};
use shoal_common::network::ActionRange;
use shoal_common::stream::{Stream, seek};

/// The noise of one actor's environments. A step's normal numbers depend only on its number, so that a repeated step
/// gets the same ones.
#[derive(Clone, Debug)]
pub struct OrnsteinUhlenbeck {
    settings: ExplorationConfig,
    /// The states of the processes, one environment after another.
    x: Vec<f64>,
    width: usize,
    stream: Stream,
}

impl OrnsteinUhlenbeck {
    /// Noise at rest for `environments` environments with actions of `width` numbers.
    pub fn new(settings: &ExplorationConfig, environments: usize, width: usize, stream: Stream) -> Self {
        Self {
            settings: settings.clone(),
            x: vec![0.0; environments * width],
            width,
            stream,
        }
    }

    /// Sets the noise of one environment to zero, as at the start of an episode (line 5 of Algorithm 4).
    pub fn reset(&mut self, environment: usize) {
        self.x[environment * self.width..][..self.width].fill(0.0);
    }

    /// The states of the processes, one environment after another.
    pub(crate) fn state(&self) -> &[f64] {
        &self.x
    }

    /// Continues from these states. Panics unless there are as many as in `state`.
    pub(crate) fn restore(&mut self, state: &[f64]) {
        self.x.copy_from_slice(state);
    }

    /// How to act before the policy's first update.
    pub fn warmup(&self) -> Warmup {
        self.settings.warmup
    }

    /// The random numbers of step number `step`.
    pub(crate) fn stream_at(&mut self, step: u64) -> &mut Stream {
        seek(&mut self.stream, step)
    }

    /// Advances every process by step number `step`: x ← x − θ x + σ N(0, 1).
    pub fn advance(&mut self, step: u64) {
        let ExplorationConfig { theta, sigma, .. } = self.settings;
        let stream = seek(&mut self.stream, step);
        for x in &mut self.x {
            let normal: f64 = stream.sample(StandardNormal);
            *x += -theta * *x + sigma * normal;
        }
    }

    /// Adds the noise to the actions, in units of half the range of each action element, and clips the sum to the range
    /// (equation 3.32).
    pub fn add_to(&self, actions: &mut [f32], range: &ActionRange) {
        let width = range.width();
        for (action, x) in actions.chunks_exact_mut(width).zip(self.x.chunks_exact(width)) {
            for (i, a) in action.iter_mut().enumerate() {
                *a = range.clip(i, *a + range.half()[i] * x[i] as f32);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_common::space::Space;
    use shoal_common::stream::{Purpose, stream};

    fn noise(environments: usize) -> OrnsteinUhlenbeck {
        OrnsteinUhlenbeck::new(
            &ExplorationConfig::default(),
            environments,
            1,
            stream(7, Purpose::Exploration, 0, 0),
        )
    }

    #[test]
    fn a_repeated_step_gets_the_same_numbers() {
        let (mut straight, mut again) = (noise(3), noise(3));
        (0..10).for_each(|step| straight.advance(step));
        (0..5).for_each(|step| again.advance(step));
        let mut resumed = again.clone();
        resumed.advance(77);
        (5..10).for_each(|step| again.advance(step));
        assert_eq!(straight.x, again.x);
        assert_ne!(resumed.x, straight.x);
    }

    #[test]
    fn the_noise_has_the_variance_and_the_correlation_of_the_process() {
        let mut noise = noise(2000);
        (0..100).for_each(|step| noise.advance(step));
        let variance = noise.x.iter().map(|x| x * x).sum::<f64>() / 2000.0;
        // σ² / (1 − (1 − θ)²)
        let expected = 0.04 / (1.0 - 0.85_f64.powi(2));
        assert!(
            (variance / expected - 1.0).abs() < 0.15,
            "{variance} against {expected}"
        );
        let before = noise.x.clone();
        noise.advance(100);
        let correlation = before.iter().zip(&noise.x).map(|(a, b)| a * b).sum::<f64>() / 2000.0 / variance;
        assert!((correlation - 0.85).abs() < 0.06, "{correlation}");
    }

    #[test]
    fn the_noise_is_scaled_and_clipped_and_an_episode_starts_without_it() {
        let mut noise = noise(2);
        noise.x = vec![0.5, -3.0];
        let mut actions = [1.0, 0.5];
        let torque = ActionRange::new(&Space::boxed(&[(-2.0, 2.0)])).unwrap();
        noise.add_to(&mut actions, &torque);
        assert_eq!(actions, [2.0, -2.0]);
        noise.reset(1);
        assert_eq!(noise.x, [0.5, 0.0]);
    }
}
