//! The slippery 4×4 lake of section 4.1: Gymnasium's FrozenLake-v1.

use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::{
    space::{EnvironmentSpec, Space},
    stream::Stream,
};

use super::{Class, Drawing, Environment, OutOfRange, Picture, RequestError, Signal, Step, check_time_limit};

/// The map, row by row: S the start, F frozen, H a hole, G the goal.
pub const MAP: &[u8; STATES] = b"SFFFFHFHFFFHHFFG";
const SIDE: usize = 4;

/// The number of states: the cells of the lake, numbered row by row.
pub const STATES: usize = SIDE * SIDE;
/// The number of actions: 0 left, 1 down, 2 right, 3 up.
pub const ACTIONS: usize = 4;

/// Parameters of the frozen lake.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FrozenLakeParameters {
    /// Steps after which an episode is truncated.
    #[schemars(extend("unit" = "steps", "source" = "section 4.1"))]
    pub time_limit: u32,
}

impl Default for FrozenLakeParameters {
    fn default() -> Self {
        Self { time_limit: 100 }
    }
}

/// A possible outcome of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LakeTransition {
    /// Its probability.
    pub p: f64,
    /// The state after the step.
    pub next: usize,
    /// 1 at the goal, else 0.
    pub reward: f64,
    /// The state after the step is a hole or the goal.
    pub terminated: bool,
}

/// The outcomes of `action` in `state` (equation 4.1), in Gymnasium's order: the intended direction lies between the
/// two that the agent may slip to. Holes and the goal are never left: they have one outcome, without reward.
///
/// Panics unless `state < STATES` and `action < ACTIONS`.
pub fn transitions(state: usize, action: usize) -> impl Iterator<Item = LakeTransition> {
    assert!(action < ACTIONS, "action {action} of {ACTIONS}");
    let ways = if is_terminal(state) { 1 } else { 3 };
    (0..ways).map(move |slip| outcome(state, slipped(action, slip), 1.0 / f64::from(ways)))
}

/// The direction of the move: the number before the intended one (`slip` 0), the intended one (1), or the number after
/// it (2).
fn slipped(action: usize, slip: u32) -> usize {
    (action + ACTIONS - 1 + slip as usize) % ACTIONS
}

/// The outcome of moving in `direction`, which happens with probability `p`.
fn outcome(state: usize, direction: usize, p: f64) -> LakeTransition {
    if is_terminal(state) {
        return LakeTransition {
            p,
            next: state,
            reward: 0.0,
            terminated: true,
        };
    }
    let next = neighbour(state, direction);
    LakeTransition {
        p,
        next,
        reward: f64::from(u8::from(MAP[next] == b'G')),
        terminated: is_terminal(next),
    }
}

fn is_terminal(state: usize) -> bool {
    matches!(MAP[state], b'H' | b'G')
}

/// The cell one step away; at the edge of the lake, the cell itself.
fn neighbour(state: usize, direction: usize) -> usize {
    let (row, column) = (state / SIDE, state % SIDE);
    let (row, column) = match direction {
        0 => (row, column.saturating_sub(1)),
        1 => ((row + 1).min(SIDE - 1), column),
        2 => (row, (column + 1).min(SIDE - 1)),
        _ => (row.saturating_sub(1), column),
    };
    row * SIDE + column
}

/// A grid of slippery ice. Observation and action are indices. It terminates at the goal, with reward 1, and in a hole,
/// without reward.
#[derive(Clone, Debug)]
pub struct FrozenLake {
    parameters: FrozenLakeParameters,
    state: usize,
}

impl FrozenLake {
    /// At the start.
    pub fn new(parameters: FrozenLakeParameters) -> Result<Self, OutOfRange> {
        check_time_limit(parameters.time_limit)?;
        Ok(Self { parameters, state: 0 })
    }
}

impl Environment for FrozenLake {
    fn spec(&self) -> EnvironmentSpec {
        EnvironmentSpec {
            observation: Space::discrete(STATES as u32),
            action: Space::discrete(ACTIONS as u32),
            time_limit: self.parameters.time_limit,
            state_width: 1,
        }
    }

    fn reset(&mut self, _: &mut Stream) {
        self.state = 0;
    }

    fn reset_to(&mut self, state: &[f64]) -> Result<(), RequestError> {
        match *state {
            [cell] if cell.fract() == 0.0 && (0.0..STATES as f64).contains(&cell) => {
                self.state = cell as usize;
                Ok(())
            }
            _ => Err(RequestError::State {
                state: state.to_vec(),
                expected: "one whole number from 0 to 15",
            }),
        }
    }

    fn observe(&self, observation: &mut [f32]) {
        observation[0] = self.state as f32;
    }

    fn step(&mut self, action: &[f64], rng: &mut Stream) -> Step {
        let action = (action[0] as usize).min(ACTIONS - 1);
        let LakeTransition {
            next,
            reward,
            terminated,
            ..
        } = outcome(self.state, slipped(action, rng.random_range(0..3)), 1.0 / 3.0);
        self.state = next;
        Step { reward, terminated }
    }

    fn save(&self, state: &mut [f64]) {
        state[0] = self.state as f64;
    }

    fn signals(&self) -> Vec<Signal> {
        vec![
            Signal::observation(0, "field", ""),
            Signal::action(0, "direction", "").label("intended direction (0 ←, 1 ↓, 2 →, 3 ↑)"),
        ]
    }

    /// The lake from above, its first row at the top; the arrow is the action, and the agent may slip.
    fn draw(&self, action: &[f64]) -> Option<Drawing> {
        let corner = |cell: usize| [(cell % SIDE) as f64, (SIDE - 1 - cell / SIDE) as f64];
        let side = SIDE as f64;
        let mut drawing = Drawing::new([-0.05, -0.05], [side + 0.05, side + 0.05]);
        for (cell, kind) in MAP.iter().enumerate() {
            let [x, y] = corner(cell);
            let (class, name) = match kind {
                b'H' => (Class::Hazard, " hole"),
                b'G' => (Class::Target, " goal"),
                b'S' => (Class::Ground, " start"),
                _ => (Class::Ground, ""),
            };
            drawing = drawing
                .rectangle(class, [x, y], [x + 1.0, y + 1.0])
                .text([x + 0.06, y + 0.8], &format!("{cell}{name}"));
        }
        let [x, y] = corner(self.state).map(|low| low + 0.5);
        let drawing = drawing.circle(Class::Body, [x, y], 0.16).trail([x, y]);
        let arrow = |(dx, dy): (f64, f64)| {
            let along = |length: f64| [x + length * dx, y + length * dy];
            drawing.clone().arrow(Class::Force, along(0.2), along(0.5))
        };
        let ways = [(-1.0, 0.0), (0.0, -1.0), (1.0, 0.0), (0.0, 1.0)];
        let way = action.first().and_then(|action| ways.get(*action as usize)).copied();
        Some(way.map_or_else(|| drawing.clone(), arrow))
    }

    fn picture(&self) -> Picture {
        Picture::Grid {
            map: MAP.iter().map(|cell| char::from(*cell)).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_base::stream::{Purpose, stream};

    #[test]
    fn the_outcomes_are_those_of_equation_4_1() {
        let third = 1.0 / 3.0;
        let outcome = |next, terminated| LakeTransition {
            p: third,
            next,
            reward: 0.0,
            terminated,
        };
        let down_in_1: Vec<_> = transitions(1, 1).collect();
        assert_eq!(down_in_1, [outcome(0, false), outcome(5, true), outcome(2, false)]);
        for (state, action) in (0..STATES).flat_map(|s| (0..ACTIONS).map(move |a| (s, a))) {
            assert!((transitions(state, action).map(|o| o.p).sum::<f64>() - 1.0).abs() < 1e-12);
        }
        let goals = transitions(14, 2).filter(|o| o.reward == 1.0 && o.terminated && o.next == 15);
        assert_eq!(goals.count(), 1);
    }

    #[test]
    fn steps_have_the_probabilities_of_the_outcomes() {
        let mut lake = FrozenLake::new(FrozenLakeParameters::default()).unwrap();
        let mut rng = stream(3, Purpose::Environment, 0, 0);
        let mut visits = [0; STATES];
        for _ in 0..3000 {
            lake.reset_to(&[14.0]).unwrap();
            let step = lake.step(&[2.0], &mut rng);
            assert_eq!(step.terminated, lake.state == 15);
            assert_eq!(step.reward, f64::from(u8::from(lake.state == 15)));
            visits[lake.state] += 1;
        }
        assert!(
            [10, 14, 15].iter().all(|s| (900..1100).contains(&visits[*s])),
            "{visits:?}"
        );
        assert_eq!(visits.iter().sum::<i32>(), visits[10] + visits[14] + visits[15]);
    }

    #[test]
    fn only_cells_of_the_lake_are_states() {
        let mut lake = FrozenLake::new(FrozenLakeParameters::default()).unwrap();
        for state in [&[16.0][..], &[-1.0], &[0.5], &[f64::NAN], &[], &[1.0, 2.0]] {
            assert!(lake.reset_to(state).is_err(), "{state:?}");
        }
    }
}
