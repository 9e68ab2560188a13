//! Snapshots: the current training episodes as words. Another vector made with the same arguments continues them bit
//! for bit.

use super::{EPISODE_BITS, VectorEnvironment, training_stream, wrong_count};
use crate::environment::RequestError;

/// The first words of a training episode in a snapshot. The environment's state follows them.
struct Counters {
    episode: u64,
    steps: u32,
    position: u64,
}

impl VectorEnvironment {
    /// Words in a snapshot; 0 if the environments cannot save their state.
    pub fn snapshot_words(&self) -> usize {
        self.spec.snapshot_words(self.count())
    }

    /// Writes the current training episodes: for each environment the words that
    /// [`snapshot_words`](shoal_base::space::EnvironmentSpec::snapshot_words) counts, with the state as the bits of its
    /// numbers.
    ///
    /// Evaluation episodes have no snapshots: they are repeated by their number. Panics unless `words` has
    /// `snapshot_words()` words.
    ///
    /// # Errors
    /// When the environments cannot save their state, or are not in training episodes.
    pub fn snapshot(&self, words: &mut [u64]) -> Result<(), RequestError> {
        assert_eq!(words.len(), self.snapshot_words(), "length of `words`");
        let width = self.snapshot_width()?;
        let mut state = vec![0.0; self.spec.state_width];
        for (words, running) in words.chunks_exact_mut(width).zip(&self.running) {
            let episode = match self.evaluation {
                None => running.next_training.checked_sub(1),
                Some(_) => None,
            };
            // An episode draws far fewer than 2⁶⁴ numbers.
            let position = running.rng.get_word_pos() as u64;
            let counters = [episode.ok_or(RequestError::NoTraining)?, running.steps.into(), position];
            running.environment.save(&mut state);
            let numbers = state.iter().map(|number| number.to_bits());
            words
                .iter_mut()
                .zip(counters.into_iter().chain(numbers))
                .for_each(|(word, value)| *word = value);
        }
        Ok(())
    }

    /// Continues the training episodes of a snapshot. The snapshot must come from as many environments, made with the
    /// same name, parameters, seed, server and incarnation. All later observations, rewards and flags are then the same
    /// as in the original. Writes the E observations to act on next.
    ///
    /// Panics unless `observations` has E × observation width numbers.
    ///
    /// # Errors
    /// When the words are not such a snapshot; then nothing has changed.
    pub fn restore(&mut self, words: &[u64], observations: &mut [f32]) -> Result<(), RequestError> {
        let (count, observed) = (self.count(), self.spec.observation.width());
        assert_eq!(observations.len(), count * observed, "length of `observations`");
        let width = self.snapshot_width()?;
        if words.len() != count * width {
            return Err(wrong_count("snapshot", words.len(), count, format!("{width} each")));
        }
        let mut episodes = Vec::with_capacity(count);
        for (e, words) in words.chunks_exact(width).enumerate() {
            let (counters, state) = self.read(e, words)?;
            self.scratch.restore(&state)?;
            episodes.push((counters, state));
        }
        for (e, (counters, state)) in episodes.into_iter().enumerate() {
            let running = &mut self.running[e];
            running.environment.restore(&state)?;
            running.rng = training_stream(&self.training, e, counters.episode);
            running.rng.set_word_pos(counters.position.into());
            running.next_training = counters.episode + 1;
            running.steps = counters.steps;
            running.done = false;
            running
                .environment
                .observe(&mut observations[e * observed..][..observed]);
        }
        self.evaluation = None;
        Ok(())
    }

    /// Words for one environment.
    fn snapshot_width(&self) -> Result<usize, RequestError> {
        match self.spec.snapshot_words(1) {
            0 => Err(RequestError::NoSnapshots),
            width => Ok(width),
        }
    }

    /// Reads the words of environment `e`; an error if no episode can have these counters.
    fn read(&self, e: usize, words: &[u64]) -> Result<(Counters, Vec<f64>), RequestError> {
        let impossible = |what| RequestError::Snapshot { environment: e, what };
        let Some((&[episode, steps, position], state)) = words.split_first_chunk() else {
            return Err(impossible("length"));
        };
        let steps = u32::try_from(steps).ok().filter(|&steps| steps < self.spec.time_limit);
        let counters = Counters {
            episode: Some(episode)
                .filter(|&episode| episode < 1 << EPISODE_BITS)
                .ok_or(impossible("episode"))?,
            steps: steps.ok_or(impossible("number of steps"))?,
            position,
        };
        Ok((counters, state.iter().map(|&bits| f64::from_bits(bits)).collect()))
    }
}

#[cfg(test)]
mod tests;
