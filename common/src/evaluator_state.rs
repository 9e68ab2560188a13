//! What an evaluator leaves to its successor: the newest evaluations. So no policy is evaluated twice, and no
//! evaluation is missing in the records if the launcher is killed before it records it.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::path::Path;

use shoal_base::durable::{FileKind, SealError, read_sealed, seal, write_atomically_unsynced};
use shoal_base::report::EvaluationReport;
use shoal_channel::reports::Report;

const KIND: FileKind = FileKind {
    magic: *b"SHOALEVA",
    version: 1,
    name: "an evaluator's state",
};

/// The newest evaluations of a run, at least all that the launcher may not have received yet.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EvaluatorState {
    evaluations: VecDeque<EvaluationReport>,
}

/// Why the state cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("{path} {cause}; move it away, and the evaluator starts without saved evaluations")]
pub struct EvaluatorStateError {
    path: String,
    cause: SealError,
}

impl EvaluatorState {
    /// Reads the state at `path`. The state is empty if there is no file, or if a power loss has damaged it.
    ///
    /// # Errors
    /// When it cannot be read, or is of another version.
    pub fn read(path: &Path) -> Result<Self, EvaluatorStateError> {
        let failed = |cause| EvaluatorStateError {
            path: path.display().to_string(),
            cause,
        };
        let bytes = match read_sealed(KIND, path) {
            Ok(bytes) => bytes,
            Err(SealError::Io(cause)) if cause.kind() == io::ErrorKind::NotFound => return Ok(Self::default()),
            Err(SealError::Checksum) => {
                tracing::warn!(
                    "{} is damaged; the evaluator starts without saved evaluations",
                    path.display()
                );
                return Ok(Self::default());
            }
            Err(cause) => return Err(failed(cause)),
        };
        let (evaluations, _) = bincode::serde::decode_from_slice(&bytes, bincode::config::standard())
            .map_err(|_| failed(SealError::Checksum))?;
        Ok(Self { evaluations })
    }

    /// The evaluations, the oldest first.
    pub fn evaluations(&self) -> impl Iterator<Item = &EvaluationReport> {
        self.evaluations.iter()
    }

    /// The newest evaluation.
    pub fn last(&self) -> Option<&EvaluationReport> {
        self.evaluations.back()
    }

    /// Adds an evaluation, and writes the state to `path`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn add(&mut self, evaluation: EvaluationReport, path: &Path) -> io::Result<()> {
        self.evaluations.push_back(evaluation);
        if self.evaluations.len() > EvaluationReport::BUFFER {
            self.evaluations.pop_front();
        }
        let bytes =
            bincode::serde::encode_to_vec(&self.evaluations, bincode::config::standard()).map_err(io::Error::other)?;
        write_atomically_unsynced(path, |file| seal(KIND, file, |body| body.write_all(&bytes)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn evaluation(env_steps: u64) -> EvaluationReport {
        EvaluationReport {
            policy_version: 3,
            env_steps,
            updates: 1,
            return_mean: f64::NAN,
            return_std: 0.1,
            episodes: 10,
            best: 0,
        }
    }

    #[test]
    fn the_newest_evaluations_are_read_back_bit_for_bit() {
        let parent = tempfile::tempdir().unwrap();
        let path = parent.path().join("evaluator.state");
        let mut state = EvaluatorState::read(&path).unwrap();
        assert_eq!(state.last(), None);
        for steps in 0..100 {
            state.add(evaluation(steps), &path).unwrap();
        }
        let read = EvaluatorState::read(&path).unwrap();
        let steps: Vec<u64> = read.evaluations().map(|it| it.env_steps).collect();
        assert_eq!(steps, (100 - EvaluationReport::BUFFER as u64..100).collect::<Vec<_>>());
        assert!(read.last().unwrap().return_mean.is_nan());
    }

    #[test]
    fn a_damaged_state_is_replaced_and_another_kind_of_file_is_refused() {
        let parent = tempfile::tempdir().unwrap();
        let path = parent.path().join("evaluator.state");
        EvaluatorState::default().add(evaluation(1), &path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        std::fs::write(&path, &whole[..whole.len() - 1]).unwrap();
        assert_eq!(EvaluatorState::read(&path).unwrap(), EvaluatorState::default());
        std::fs::write(&path, vec![0; whole.len()]).unwrap();
        assert_eq!(EvaluatorState::read(&path).unwrap(), EvaluatorState::default());
        std::fs::write(&path, [b"SHOALCHK".as_slice(), &whole[8..]].concat()).unwrap();
        let refused = EvaluatorState::read(&path).unwrap_err().to_string();
        assert!(
            refused.contains("is not an evaluator's state") && !refused.contains('\n'),
            "{refused}"
        );
    }
}
