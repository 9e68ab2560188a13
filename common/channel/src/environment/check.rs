//! Checks of what an environment returns. The client checks every response, whatever program serves the environment, so
//! that later code need not expect NaN, infinities or impossible indices.

use std::num::NonZeroU32;

use shoal_base::space::{EnvironmentSpec, Space};

use super::message::{Block, ResponseLayout};

/// An invalid response. It ends the server's episodes.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ResponseFault {
    /// The server itself has found invalid numbers, and has written them to its standard error.
    #[error("the environment server reports that an environment returned something invalid")]
    Reported,
    /// The response has a wrong length.
    #[error("the environment server answered with {found} numbers instead of {expected}")]
    Length {
        /// Numbers in the response.
        found: usize,
        /// Numbers in a valid response.
        expected: usize,
    },
    /// An invalid number.
    #[error("environment {environment} returned {value} as {what}; {expected}")]
    Number {
        /// Index of the environment within the server.
        environment: usize,
        /// What the number stands for.
        what: &'static str,
        /// The number.
        value: f32,
        /// The valid numbers, in words.
        expected: String,
    },
    /// An episode that is longer than the environment's time limit.
    #[error("environment {environment} goes on after {limit} steps, its time limit: terminated or truncated must be 1")]
    TooLong {
        /// Index of the environment within the server.
        environment: usize,
        /// The time limit, in steps.
        limit: u32,
    },
}

/// The lengths of the current episodes.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct EpisodeLengths {
    limit: u32,
    /// For each environment: the steps taken in its episode, and the number of episodes that follow it. `None` after
    /// its last one.
    current: Vec<Option<(u32, u64)>>,
}

impl EpisodeLengths {
    /// Training episodes, one after another without an end.
    pub(super) fn of_training(environments: usize, limit: u32) -> Self {
        Self {
            limit,
            current: vec![Some((0, u64::MAX)); environments],
        }
    }

    /// This number of evaluation episodes, dealt to the environments in turn.
    pub(super) fn of_evaluation(environments: usize, limit: u32, episodes: NonZeroU32) -> Self {
        let further = |e: usize| {
            (episodes.get() as usize)
                .checked_sub(e + 1)
                .map(|left| left / environments)
        };
        Self {
            limit,
            current: (0..environments)
                .map(|e| further(e).map(|left| (0, left as u64)))
                .collect(),
        }
    }

    /// Counts a step of every environment; `ended` tells whether it was the last one of its episode. An episode that
    /// does not end with the step of the time limit is too long.
    pub(super) fn count(&mut self, ended: impl Fn(usize) -> bool) -> Result<(), ResponseFault> {
        let limit = self.limit;
        for (environment, current) in self.current.iter_mut().enumerate() {
            *current = match *current {
                Some((_, left)) if ended(environment) => left.checked_sub(1).map(|left| (0, left)),
                Some((steps, _)) if steps + 1 >= limit => return Err(ResponseFault::TooLong { environment, limit }),
                Some((steps, left)) => Some((steps + 1, left)),
                None => None,
            };
        }
        Ok(())
    }
}

/// Which part of a response is used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ResponsePart {
    /// All of it: the response to a step.
    Step,
    /// The observations to act on: the response to a reset or a restore.
    Observations,
}

/// Finds the first invalid number of a response.
pub(super) fn check_response(
    spec: &EnvironmentSpec,
    layout: &ResponseLayout,
    response: &[f32],
    part: ResponsePart,
) -> Result<(), ResponseFault> {
    let block = |block| layout.block(block, response);
    let all = [
        (Block::Observations, "an observation"),
        (Block::NextObservations, "an observation"),
        (Block::Rewards, "a reward"),
        (Block::Terminated, "terminated"),
        (Block::Truncated, "truncated"),
    ];
    let counts = match part {
        ResponsePart::Step => &all[..],
        ResponsePart::Observations => &all[..1],
    };
    for (which, what) in counts {
        let numbers = block(*which);
        let wrong = match (which, &spec.observation) {
            (Block::Observations | Block::NextObservations, Space::Discrete { n, .. }) => first(numbers, |number| {
                number.fract() == 0.0 && (0.0..*n as f32).contains(&number)
            }),
            (Block::Terminated | Block::Truncated, _) => first(numbers, |number| number == 0.0 || number == 1.0),
            _ => first(numbers, f32::is_finite),
        };
        if let Some(i) = wrong {
            let width = numbers.len() / layout.environments;
            return Err(ResponseFault::Number {
                environment: i / width,
                what,
                value: numbers[i],
                expected: expected(*which, &spec.observation),
            });
        }
    }
    Ok(())
}

fn first(numbers: &[f32], right: impl Fn(f32) -> bool) -> Option<usize> {
    // Nearly always all numbers are valid. Without an early exit the compiler can use vector instructions.
    if numbers.iter().fold(true, |all, number| all & right(*number)) {
        return None;
    }
    numbers.iter().position(|number| !right(*number))
}

fn expected(block: Block, observation: &Space) -> String {
    match (block, observation) {
        (Block::Observations | Block::NextObservations, Space::Discrete { n, .. }) => {
            format!("expected: an index from 0 to {}", n.saturating_sub(1))
        }
        (Block::Terminated | Block::Truncated, _) => "expected: 0 or 1".into(),
        _ => "expected: a finite number".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_episode_beyond_the_time_limit_is_a_fault_unless_the_environment_is_done() {
        let mut training = EpisodeLengths::of_training(2, 3);
        for _ in 0..5 {
            for _ in 0..2 {
                training.count(|_| false).unwrap();
            }
            training.count(|_| true).unwrap();
        }
        for _ in 0..2 {
            training.count(|e| e == 0).unwrap();
        }
        let too_long = ResponseFault::TooLong {
            environment: 1,
            limit: 3,
        };
        assert_eq!(training.count(|e| e == 0), Err(too_long));

        // Two episodes: the third environment has none.
        let mut evaluation = EpisodeLengths::of_evaluation(3, 3, NonZeroU32::new(2).unwrap());
        evaluation.count(|e| e < 2).unwrap();
        for _ in 0..10 {
            evaluation.count(|_| false).unwrap();
        }
        // Three episodes: the first environment has two of them.
        let mut evaluation = EpisodeLengths::of_evaluation(2, 3, NonZeroU32::new(3).unwrap());
        evaluation.count(|_| true).unwrap();
        for _ in 0..2 {
            evaluation.count(|_| false).unwrap();
        }
        assert!(matches!(
            evaluation.count(|_| false),
            Err(ResponseFault::TooLong { environment: 0, .. })
        ));
    }

    fn spec(observation: Space) -> EnvironmentSpec {
        EnvironmentSpec {
            observation,
            action: Space::discrete(2),
            time_limit: 10,
            state_width: 0,
        }
    }

    /// Checks a response of two environments to a step, with one number changed.
    fn fault_of(observation: Space, at: usize, value: f32, part: ResponsePart) -> Result<(), ResponseFault> {
        let spec = spec(observation);
        let layout = ResponseLayout::new(2, spec.observation.width());
        let mut response = vec![1.0; layout.len()];
        response[at] = value;
        check_response(&spec, &layout, &response, part)
    }

    #[test]
    fn an_invalid_number_is_found_and_named() {
        let boxed = || Space::boxed(&[(-1.0, 1.0); 3]);
        // Two times: observations 0 to 5, next observations 6 to 11, rewards 12 and 13, terminated 14, truncated 16.
        for (at, value, environment, what) in [
            (1, f32::NAN, 0, "an observation"),
            (4, f32::INFINITY, 1, "an observation"),
            (11, f32::NEG_INFINITY, 1, "an observation"),
            (12, f32::NAN, 0, "a reward"),
            (15, 2.0, 1, "terminated"),
            (16, 0.5, 0, "truncated"),
            (17, f32::NAN, 1, "truncated"),
        ] {
            let Err(ResponseFault::Number {
                environment: found,
                what: named,
                ..
            }) = fault_of(boxed(), at, value, ResponsePart::Step)
            else {
                panic!("{at}: {value} passed");
            };
            assert_eq!((found, named), (environment, what), "{at}");
        }
        assert_eq!(
            fault_of(boxed(), 0, 7.0, ResponsePart::Step),
            Ok(()),
            "a number outside its bounds is allowed"
        );
        assert_eq!(
            fault_of(boxed(), 12, f32::NAN, ResponsePart::Observations),
            Ok(()),
            "a reset has no reward"
        );
        assert!(fault_of(boxed(), 5, f32::NAN, ResponsePart::Observations).is_err());
    }

    #[test]
    fn an_index_must_be_within_its_space() {
        for (value, right) in [
            (0.0, true),
            (2.0, true),
            (3.0, false),
            (-1.0, false),
            (1.5, false),
            (f32::NAN, false),
        ] {
            let found = fault_of(Space::discrete(3), 0, value, ResponsePart::Observations);
            assert_eq!(found.is_ok(), right, "{value}");
        }
        let text = fault_of(Space::discrete(3), 1, 3.0, ResponsePart::Step)
            .unwrap_err()
            .to_string();
        assert!(text.contains("environment 1") && text.contains("0 to 2"), "{text}");
    }
}
