//! SAC's policy: a normal distribution for each element of the action, squashed by tanh and scaled to the range of the
//! actions.

use super::{ActionRange, Network, NetworkLayout};

/// The range that log σ is clamped to, as in the program of Haarnoja et al. 2018b.
pub const LOG_STD_RANGE: (f32, f32) = (-20.0, 2.0);

/// A policy π(a|s) with buffers for a batch of observations. The network has two outputs for each action element: all
/// means μ, then all log σ. An action is tanh(u), u ~ N(μ, σ²), scaled to the range. It does not own its parameters:
/// each call borrows them.
#[derive(Clone, Debug)]
pub struct GaussianPolicy {
    network: Network,
    range: ActionRange,
    /// μ and log σ of each observation.
    outputs: Vec<f32>,
}

impl GaussianPolicy {
    /// A policy with actions in `range`, for at most `batch` observations a call.
    ///
    /// # Panics
    /// If the network does not have two outputs for each element of an action.
    pub fn new(layout: NetworkLayout, range: ActionRange, batch: usize) -> Self {
        assert_eq!(
            layout.outputs(),
            2 * range.width(),
            "μ and log σ for each element of an action"
        );
        Self {
            outputs: vec![0.0; layout.outputs() * batch],
            network: Network::new(layout, batch),
            range,
        }
    }

    /// The same policy, which normalises its observations or not.
    pub fn normalising(self, normalised: bool) -> Self {
        Self {
            network: self.network.normalising(normalised),
            ..self
        }
    }

    /// The layout of the parameters.
    pub fn layout(&self) -> &NetworkLayout {
        self.network.layout()
    }

    /// The range of its actions.
    pub fn range(&self) -> &ActionRange {
        &self.range
    }

    /// Writes the action of the mean, tanh μ, in environment units, for every observation, one after the other. Nothing
    /// is allocated.
    ///
    /// # Panics
    /// If the slices do not match the layout, or have more observations than the batch.
    pub fn mean(&mut self, parameters: &[f32], observations: &[f32], actions: &mut [f32]) {
        self.choose(parameters, observations, actions, |mu, _| mu);
    }

    /// As [`mean`](Self::mean), but each u is μ + σ ε, where ε is the next number of `normal`.
    pub fn sample(
        &mut self,
        parameters: &[f32],
        observations: &[f32],
        mut normal: impl FnMut() -> f32,
        actions: &mut [f32],
    ) {
        let (least, greatest) = LOG_STD_RANGE;
        self.choose(parameters, observations, actions, |mu, log_sigma| {
            mu + log_sigma.clamp(least, greatest).exp() * normal()
        });
    }

    /// Chooses each element's u from its μ and log σ.
    fn choose(
        &mut self,
        parameters: &[f32],
        observations: &[f32],
        actions: &mut [f32],
        mut u: impl FnMut(f32, f32) -> f32,
    ) {
        let Self {
            network,
            range,
            outputs,
        } = self;
        let width = range.width();
        let outputs = &mut outputs[..2 * actions.len()];
        network.forward(parameters, observations, outputs);
        for (action, outputs) in actions.chunks_exact_mut(width).zip(outputs.chunks_exact(2 * width)) {
            let (mu, log_sigma) = outputs.split_at(width);
            for (element, a) in action.iter_mut().enumerate() {
                *a = range.action(element, u(mu[element], log_sigma[element]).tanh());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use shoal_base::space::Space;

    use super::super::Hidden;
    use super::*;

    /// A policy of one observed number whose outputs are its parameters: h = max(s, 0), μ = (1, 2) h and log σ =
    /// (−1, 50) h.
    fn policy(batch: usize) -> (GaussianPolicy, Vec<f32>) {
        let range = ActionRange::new(&Space::boxed(&[(-1.0, 3.0), (-2.0, 2.0)])).unwrap();
        let policy = GaussianPolicy::new(NetworkLayout::new(1, Hidden::relu([1]), 4), range, batch);
        (policy, vec![1.0, 0.0, 1.0, 2.0, -1.0, 50.0, 0.0, 0.0, 0.0, 0.0])
    }

    #[test]
    fn the_mean_is_squashed_and_scaled() {
        let (mut policy, parameters) = policy(2);
        let mut actions = [f32::NAN; 4];
        policy.mean(&parameters, &[1.0, -1.0], &mut actions);
        let expected = [1.0 + 2.0 * 1.0_f32.tanh(), 2.0 * 2.0_f32.tanh(), 1.0, 0.0];
        assert_eq!(actions, expected);
    }

    #[test]
    fn a_sample_moves_by_the_standard_deviation_whose_logarithm_is_clamped() {
        let (mut policy, parameters) = policy(1);
        let mut actions = [f32::NAN; 2];
        let mut normals = [0.5_f32, -0.25].into_iter();
        policy.sample(&parameters, &[1.0], || normals.next().unwrap(), &mut actions);
        let u = [1.0 + 0.5 * (-1.0_f32).exp(), 2.0 - 0.25 * LOG_STD_RANGE.1.exp()];
        assert_eq!(actions, [1.0 + 2.0 * u[0].tanh(), 2.0 * u[1].tanh()]);
    }
}
