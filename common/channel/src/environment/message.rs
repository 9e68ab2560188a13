//! The messages between an actor and its environment server. `docs/PROTOCOL.md` describes them for servers in other
//! languages.

use iceoryx2::prelude::ZeroCopySend;
use shoal_base::space::{EnvironmentSpec, MAX_EXACT_INTEGER, Space};

/// The kinds of requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum RequestKind {
    /// Return the spaces and the number of environments.
    Describe = 0,
    /// Every environment begins the next training episode of its own stream.
    Reset = 1,
    /// Environment `e` begins the evaluation episode `episode + e`, whose start state is always the same.
    ResetToEvaluation = 2,
    /// Every environment takes a step with its action.
    Step = 3,
    /// Return a snapshot of the current training episodes.
    Snapshot = 4,
    /// The environments continue the training episodes of a snapshot.
    Restore = 5,
    /// Every environment begins the training episode `episode` of its own stream; later resets count from there.
    ResetToTraining = 6,
}

impl RequestKind {
    pub(super) const ALL: [Self; 7] = [
        Self::Describe,
        Self::Reset,
        Self::ResetToEvaluation,
        Self::Step,
        Self::Snapshot,
        Self::Restore,
        Self::ResetToTraining,
    ];
}

/// Header of a request. The payload has the actions, environment after environment, for [`RequestKind::Step`], the
/// words of the snapshot for [`RequestKind::Restore`], and is empty otherwise.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[type_name("ShoalEnvironmentRequest")]
#[repr(C)]
pub struct RequestHeader {
    pub(super) kind: u32,
    /// Number of evaluation episodes of [`RequestKind::ResetToEvaluation`], from `episode` on; 0 means no limit. An
    /// environment whose next episode would be beyond them is not reset again.
    pub episodes: u32,
    /// The episode of [`RequestKind::ResetToTraining`], or the first episode of [`RequestKind::ResetToEvaluation`].
    pub episode: u64,
}

impl RequestHeader {
    pub(super) fn new(kind: RequestKind, episode: u64, episodes: u32) -> Self {
        Self {
            kind: kind as u32,
            episodes,
            episode,
        }
    }
}

/// The outcome of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum ResponseStatus {
    Answered = 0,
    /// A step or a snapshot before a reset or a restore: another server began the episode.
    NotStarted = 1,
    /// The request has the wrong length, invalid contents, or an unknown kind.
    Refused = 2,
    /// An environment returned something invalid, which the server has logged. The server's episodes end.
    Invalid = 3,
}

/// Header of a response. For [`RequestKind::Describe`] the payload has the least and greatest values of an observation
/// and of an action (for boxes), for [`RequestKind::Snapshot`] the snapshot's words, and otherwise the blocks of
/// [`ResponseLayout`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[type_name("ShoalEnvironmentResponse")]
#[repr(C)]
pub struct ResponseHeader {
    pub(super) status: u32,
    /// Environments the server steps.
    pub environments: u32,
    /// Values of a discrete observation; 0 for a box.
    pub discrete_observations: u32,
    /// Numbers in an observation.
    pub observation_width: u32,
    /// Values of a discrete action; 0 for a box.
    pub discrete_actions: u32,
    /// Numbers in an action.
    pub action_width: u32,
    /// Steps after which an episode is truncated.
    pub time_limit: u32,
    /// Numbers in an environment's state; 0 if it cannot be saved.
    pub state_width: u32,
}

impl ResponseHeader {
    /// The spaces and the number of environments in a response to [`RequestKind::Describe`] with payload `bounds`.
    /// `None` if the payload has another length.
    pub(super) fn described(&self, bounds: &[f32]) -> Option<(EnvironmentSpec, usize)> {
        let spaces = [
            (self.discrete_observations, self.observation_width),
            (self.discrete_actions, self.action_width),
        ];
        let length = |(discrete, width): (u32, u32)| if discrete > 0 { 0 } else { 2 * width as usize };
        let without_starts: usize = spaces.into_iter().map(length).sum();
        // Servers of earlier versions do not send the start of a discrete space.
        let with_starts = bounds.len() != without_starts;
        let mut rest = bounds;
        let mut space = |(discrete, width): (u32, u32)| {
            if discrete > 0 {
                let start = match (with_starts, rest) {
                    (false, _) => 0,
                    (true, [start, others @ ..]) => {
                        rest = others;
                        whole(*start)?
                    }
                    (true, []) => return None,
                };
                return Some(Space::Discrete { n: discrete, start });
            }
            let width = width as usize;
            let (low, high) = (rest.get(..width)?, rest.get(width..)?.get(..width)?);
            rest = &rest[2 * width..];
            Some(Space::Box {
                low: low.into(),
                high: high.into(),
            })
        };
        let spec = EnvironmentSpec {
            observation: space(spaces[0])?,
            action: space(spaces[1])?,
            time_limit: self.time_limit,
            state_width: self.state_width as usize,
        };
        rest.is_empty().then_some((spec, self.environments as usize))
    }
}

/// A whole number that is exact as an `f32`.
fn whole(number: f32) -> Option<i32> {
    (number.fract() == 0.0 && number.abs() <= MAX_EXACT_INTEGER as f32).then_some(number as i32)
}

/// The layout of a response: its blocks, each of them environment after environment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ResponseLayout {
    pub(super) environments: usize,
    observation: usize,
}

/// The blocks of a response, in their order.
#[derive(Clone, Copy, Debug)]
pub(super) enum Block {
    Observations,
    NextObservations,
    Rewards,
    Terminated,
    Truncated,
}

/// Mutable blocks of a response to [`RequestKind::Step`]. A reset or restore fills `observations` alone.
#[derive(Debug)]
pub struct StepBlocks<'a> {
    /// The observations to act on next. After the end of an episode this is the first observation of the next one.
    pub observations: &'a mut [f32],
    /// The observations after the step, s', also if the episode ended with it.
    pub next_observations: &'a mut [f32],
    /// The rewards of the step.
    pub rewards: &'a mut [f32],
    /// 1 if the step led to a terminal state, otherwise 0.
    pub terminated: &'a mut [f32],
    /// 1 if the time limit ended the episode, otherwise 0.
    pub truncated: &'a mut [f32],
}

impl ResponseLayout {
    /// The layout for this many environments with observations of this width.
    pub fn new(environments: usize, observation: usize) -> Self {
        Self {
            environments,
            observation,
        }
    }

    /// Numbers in each [`Block`], in their order.
    fn lengths(&self) -> [usize; 5] {
        let (scalars, observations) = (self.environments, self.environments * self.observation);
        [observations, observations, scalars, scalars, scalars]
    }

    /// Numbers in a response.
    pub fn len(&self) -> usize {
        self.lengths().iter().sum()
    }

    /// Whether a response holds nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// A block of a response of `len()` numbers.
    pub(super) fn block<'a>(&self, block: Block, response: &'a [f32]) -> &'a [f32] {
        let lengths = self.lengths();
        let (before, here) = lengths.split_at(block as usize);
        &response[before.iter().sum()..][..here[0]]
    }

    /// The blocks of a response of `len()` numbers.
    pub fn split_mut<'a>(&self, response: &'a mut [f32]) -> StepBlocks<'a> {
        let lengths = self.lengths();
        let (observations, rest) = response.split_at_mut(lengths[Block::Observations as usize]);
        let (next_observations, rest) = rest.split_at_mut(lengths[Block::NextObservations as usize]);
        let (rewards, rest) = rest.split_at_mut(lengths[Block::Rewards as usize]);
        let (terminated, truncated) = rest.split_at_mut(lengths[Block::Terminated as usize]);
        StepBlocks {
            observations,
            next_observations,
            rewards,
            terminated,
            truncated,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_description_is_read_unless_it_is_too_short() {
        let header = ResponseHeader {
            environments: 3,
            observation_width: 2,
            discrete_actions: 4,
            action_width: 1,
            time_limit: 200,
            ..ResponseHeader::default()
        };
        let (spec, environments) = header.described(&[-1.0, -2.0, 1.0, 2.0]).unwrap();
        assert_eq!(spec.observation, Space::boxed(&[(-1.0, 1.0), (-2.0, 2.0)]));
        assert_eq!(
            (spec.action, spec.time_limit, environments),
            (Space::discrete(4), 200, 3)
        );
        assert_eq!(header.described(&[-1.0, -2.0, 1.0]), None);
    }

    #[test]
    fn a_block_is_read_back_as_written() {
        let layout = ResponseLayout::new(2, 3);
        let mut response = vec![f32::NAN; layout.len()];
        let blocks = layout.split_mut(&mut response);
        blocks.observations.fill(0.0);
        blocks.next_observations.fill(1.0);
        blocks.rewards.fill(2.0);
        blocks.terminated.fill(3.0);
        blocks.truncated.fill(4.0);
        use Block::{NextObservations, Observations, Rewards, Terminated, Truncated};
        for (value, (block, length)) in [
            (Observations, 6),
            (NextObservations, 6),
            (Rewards, 2),
            (Terminated, 2),
            (Truncated, 2),
        ]
        .into_iter()
        .enumerate()
        {
            assert_eq!(layout.block(block, &response), vec![value as f32; length]);
        }
    }
}
