//! The reward functions of section 5.2, each with its own parameters.

/// A reward function and its parameters. The defaults are those of its part of section 5.3.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reward {
    /// Amplitude a of the Gaussian of the distance.
    pub amplitude: f64,
    /// Its variance σ², in m².
    pub variance: f64,
    /// c_d: in r1 the bonus within the goal radius; in r2 and r3 the weight of ḋ outside it.
    pub c_d: f64,
    /// The terms, with the parameters that only some rewards have.
    pub terms: RewardTerms,
}

/// The terms of a reward function.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RewardTerms {
    /// Equation (5.10): a Gaussian of the distance, and a bonus at the goal.
    R1,
    /// Equation (5.11): progress, a Gaussian at the goal, and penalties on quickly changing inputs.
    R2 {
        /// Weight of θ̇².
        c_theta_dot: f64,
        /// Weight of Ḟ_u².
        c_force_dot: f64,
    },
    /// Equation (5.12): as r2, with a penalty on the force instead of its change.
    R3 {
        /// Weight of θ̇².
        c_theta_dot: f64,
        /// Weight of F_u².
        c_force: f64,
    },
}

/// What a reward depends on: the state after a step, and the inputs of the step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Distance d to the goal, in m.
    pub d: f64,
    /// ḋ in m/s.
    pub d_dot: f64,
    /// θ̇ within [−20, 20]: the wrapped change of direction in half turns, over Δt (section 5.3.2).
    pub theta_dot: f64,
    /// F_u in N.
    pub force: f64,
    /// Ḟ_u in N/s.
    pub force_dot: f64,
}

impl Reward {
    /// The reward of a step. The vehicle is at the goal if `d < goal_radius` (0.05 in the thesis).
    pub fn of(&self, motion: &Motion, goal_radius: f64) -> f64 {
        let Motion {
            d,
            d_dot,
            theta_dot,
            force,
            force_dot,
        } = *motion;
        let Self {
            amplitude,
            variance,
            c_d,
            terms,
        } = *self;
        let at_goal = d < goal_radius;
        let gaussian = || amplitude * (-d.powi(2) / (2.0 * variance)).exp();
        let progress = || if at_goal { gaussian() } else { -c_d * d_dot };
        match terms {
            RewardTerms::R1 => gaussian() + if at_goal { c_d } else { 0.0 },
            RewardTerms::R2 {
                c_theta_dot,
                c_force_dot,
            } => -c_force_dot * force_dot.powi(2) - c_theta_dot * theta_dot.powi(2) + progress(),
            RewardTerms::R3 { c_theta_dot, c_force } => {
                -c_force * force.powi(2) - c_theta_dot * theta_dot.powi(2) + progress()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOTION: Motion = Motion {
        d: 0.5,
        d_dot: -0.6,
        theta_dot: 10.0,
        force: 1.5,
        force_dot: 4.0,
    };

    fn assert_reward(reward: Reward, motion: Motion, by_hand: f64) {
        let ours = reward.of(&motion, 0.05);
        assert!(
            (ours - by_hand).abs() < 1e-12,
            "{reward:?} gave {ours}, by hand {by_hand}"
        );
    }

    #[test]
    fn r1_by_hand() {
        let r1 = Reward {
            amplitude: 1.0,
            variance: 0.4,
            c_d: 1.0,
            terms: RewardTerms::R1,
        };
        assert_reward(r1, MOTION, (-0.3125f64).exp());
        assert_reward(r1, Motion { d: 0.04, ..MOTION }, (-0.002f64).exp() + 1.0);
        assert_reward(r1, Motion { d: 0.05, ..MOTION }, (-0.003125f64).exp());
        assert_reward(r1, Motion { d: 0.0, ..MOTION }, 2.0);
    }

    #[test]
    fn r2_by_hand() {
        let c_d = 0.5f64.sqrt();
        let r2 = |c_force_dot| Reward {
            amplitude: 2.0,
            variance: 0.1,
            c_d,
            terms: RewardTerms::R2 {
                c_theta_dot: 0.0015,
                c_force_dot,
            },
        };
        assert_reward(r2(0.0), MOTION, -0.15 + 0.6 * c_d);
        assert_reward(r2(0.01), MOTION, -0.16 - 0.15 + 0.6 * c_d);
        assert_reward(r2(0.0), Motion { d: 0.04, ..MOTION }, -0.15 + 2.0 * (-0.008f64).exp());
        assert_reward(
            r2(0.0),
            Motion {
                theta_dot: 20.0,
                d_dot: 2.0f64.sqrt(),
                ..MOTION
            },
            -0.6 - 1.0,
        );
    }

    #[test]
    fn r3_by_hand() {
        let c_d = 0.5f64.sqrt();
        let r3 = Reward {
            amplitude: 2.0,
            variance: 0.1,
            c_d,
            terms: RewardTerms::R3 {
                c_theta_dot: 0.0015,
                c_force: 0.03,
            },
        };
        assert_reward(r3, MOTION, -0.0675 - 0.15 + 0.6 * c_d);
        assert_reward(
            r3,
            Motion {
                d: 0.0,
                theta_dot: 0.0,
                force: 0.0,
                ..MOTION
            },
            2.0,
        );
        assert_reward(
            r3,
            Motion {
                force_dot: 1e3,
                ..MOTION
            },
            -0.0675 - 0.15 + 0.6 * c_d,
        );
    }
}
