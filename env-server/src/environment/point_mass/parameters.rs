//! Parameters of the point mass. They are flat in TOML, so that one key changes one number. In Rust, each reward has
//! only its own parameters.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{
    super::{OutOfRange, check, check_time_limit},
    reward::{Reward, RewardTerms},
};

/// Parameters of the point mass. In TOML, `reward` is `"r1"`, `"r2"` or `"r3"`, and the reward's parameters are keys
/// beside it; parameters of another reward are refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "PointMassTable", into = "PointMassTable")]
pub struct PointMassParameters {
    /// m in kg.
    pub mass: f64,
    /// Friction coefficient μ of equation (5.6).
    pub friction: f64,
    /// F_s / F_c, at least 1.
    pub stiction_ratio: f64,
    /// g in m/s².
    pub gravity: f64,
    /// Distance in m below which the vehicle is at the goal.
    pub goal_radius: f64,
    /// Steps after which an episode is truncated.
    pub time_limit: u32,
    /// The reward function.
    pub reward: Reward,
}

impl PointMassParameters {
    /// Refuses values out of range.
    pub(super) fn check(&self) -> Result<(), OutOfRange> {
        check("mass", self.mass, 1e-3..=1e3)?;
        check("friction", self.friction, 0.0..=1.0)?;
        check("stiction_ratio", self.stiction_ratio, 1.0..=10.0)?;
        check("gravity", self.gravity, 0.0..=100.0)?;
        check("goal_radius", self.goal_radius, 0.0..=10.0)?;
        check_time_limit(self.time_limit)?;
        let Reward {
            amplitude,
            variance,
            c_d,
            terms,
        } = self.reward;
        check("amplitude", amplitude, 0.0..=1e3)?;
        check("variance", variance, 1e-6..=1e3)?;
        check("c_d", c_d, 0.0..=1e3)?;
        match terms {
            RewardTerms::R1 => Ok(()),
            RewardTerms::R2 {
                c_theta_dot,
                c_force_dot,
            } => {
                check("c_theta_dot", c_theta_dot, 0.0..=1e3)?;
                check("c_force_dot", c_force_dot, 0.0..=1e3)
            }
            RewardTerms::R3 { c_theta_dot, c_force } => {
                check("c_theta_dot", c_theta_dot, 0.0..=1e3)?;
                check("c_force", c_force, 0.0..=1e3)
            }
        }
    }
}

#[derive(Clone, Copy, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
enum Name {
    /// Equation 5.10.
    R1,
    /// Equation 5.11.
    R2,
    /// Equation 5.12.
    R3,
}

/// The TOML form.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct PointMassTable {
    /// m, the vehicle's mass.
    #[schemars(extend("unit" = "kg", "source" = "ours (docs/POINT_MASS.md)"))]
    mass: f64,
    /// μ, the friction coefficient.
    #[schemars(extend("unit" = "–", "source" = "ours (docs/POINT_MASS.md)"))]
    friction: f64,
    /// F_s / F_c, the ratio of the force to start moving to the friction while moving; at least 1.
    #[schemars(extend("unit" = "–", "source" = "ours (docs/POINT_MASS.md)"))]
    stiction_ratio: f64,
    /// g, the gravity of earth.
    #[schemars(extend("unit" = "m/s²", "source" = "section 5.1"))]
    gravity: f64,
    /// The vehicle is at the goal within this distance of it.
    #[schemars(extend("unit" = "m", "source" = "equations 5.10 to 5.12"))]
    goal_radius: f64,
    /// Steps after which an episode is truncated.
    #[schemars(extend("unit" = "steps", "source" = "section 5.1"))]
    time_limit: u32,
    /// The reward function.
    #[schemars(extend("unit" = "–", "source" = "section 5.2"))]
    reward: Name,
    /// a, the amplitude of the Gaussian.
    #[schemars(extend("unit" = "–", "source" = "section 5.3"))]
    amplitude: Option<f64>,
    /// σ², the variance of the Gaussian.
    #[schemars(extend("unit" = "m²", "source" = "section 5.3"))]
    variance: Option<f64>,
    /// c_d: in r1 the bonus at the goal; in r2 and r3 the weight of ḋ outside the goal radius.
    #[schemars(extend("unit" = "r1: –; r2, r3: s/m", "source" = "section 5.3"))]
    c_d: Option<f64>,
    /// Weight of θ̇² (r2 and r3).
    #[schemars(extend("unit" = "s² / half turns²", "source" = "section 5.3.2"))]
    c_theta_dot: Option<f64>,
    /// Weight of Ḟ_u² (r2).
    #[schemars(extend("unit" = "s²/N²", "source" = "equation 5.11"))]
    c_force_dot: Option<f64>,
    /// Weight of F_u² (r3).
    #[schemars(extend("unit" = "1/N²", "source" = "section 5.3.3"))]
    c_force: Option<f64>,
}

impl Default for PointMassTable {
    /// The thesis does not print m, μ or F_s; these values fit its figures.
    fn default() -> Self {
        Self {
            mass: 1.0,
            friction: 0.01,
            stiction_ratio: 1.2,
            gravity: 9.81,
            goal_radius: 0.05,
            time_limit: 200,
            reward: Name::R3,
            amplitude: None,
            variance: None,
            c_d: None,
            c_theta_dot: None,
            c_force_dot: None,
            c_force: None,
        }
    }
}

impl TryFrom<PointMassTable> for PointMassParameters {
    type Error = String;

    fn try_from(mut flat: PointMassTable) -> Result<Self, String> {
        let given_or = |given: &mut Option<f64>, default| given.take().unwrap_or(default);
        let (name, [amplitude, variance, c_d], terms) = match flat.reward {
            Name::R1 => ("r1", [1.0, 0.4, 1.0], RewardTerms::R1),
            Name::R2 => (
                "r2",
                [2.0, 0.1, std::f64::consts::FRAC_1_SQRT_2],
                RewardTerms::R2 {
                    c_theta_dot: given_or(&mut flat.c_theta_dot, 0.0015),
                    c_force_dot: given_or(&mut flat.c_force_dot, 0.0),
                },
            ),
            Name::R3 => (
                "r3",
                [2.0, 0.1, std::f64::consts::FRAC_1_SQRT_2],
                RewardTerms::R3 {
                    c_theta_dot: given_or(&mut flat.c_theta_dot, 0.0015),
                    c_force: given_or(&mut flat.c_force, 0.03),
                },
            ),
        };
        let reward = Reward {
            amplitude: given_or(&mut flat.amplitude, amplitude),
            variance: given_or(&mut flat.variance, variance),
            c_d: given_or(&mut flat.c_d, c_d),
            terms,
        };
        let others = [
            ("c_theta_dot", flat.c_theta_dot, "r2 or r3"),
            ("c_force_dot", flat.c_force_dot, "r2"),
            ("c_force", flat.c_force, "r3"),
        ];
        if let Some((key, _, owner)) = others.iter().find(|(_, given, _)| given.is_some()) {
            return Err(format!(
                "`{key}` is not a parameter of reward {name}: remove it, or set reward to {owner}"
            ));
        }
        let PointMassTable {
            mass,
            friction,
            stiction_ratio,
            gravity,
            goal_radius,
            time_limit,
            ..
        } = flat;
        Ok(Self {
            mass,
            friction,
            stiction_ratio,
            gravity,
            goal_radius,
            time_limit,
            reward,
        })
    }
}

impl From<PointMassParameters> for PointMassTable {
    fn from(parameters: PointMassParameters) -> Self {
        let PointMassParameters {
            mass,
            friction,
            stiction_ratio,
            gravity,
            goal_radius,
            time_limit,
            reward,
        } = parameters;
        let Reward {
            amplitude,
            variance,
            c_d,
            terms,
        } = reward;
        let (name, c_theta_dot, c_force_dot, c_force) = match terms {
            RewardTerms::R1 => (Name::R1, None, None, None),
            RewardTerms::R2 {
                c_theta_dot,
                c_force_dot,
            } => (Name::R2, Some(c_theta_dot), Some(c_force_dot), None),
            RewardTerms::R3 { c_theta_dot, c_force } => (Name::R3, Some(c_theta_dot), None, Some(c_force)),
        };
        Self {
            mass,
            friction,
            stiction_ratio,
            gravity,
            goal_radius,
            time_limit,
            reward: name,
            amplitude: Some(amplitude),
            variance: Some(variance),
            c_d: Some(c_d),
            c_theta_dot,
            c_force_dot,
            c_force,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::{make, resolve};
    use super::*;

    fn parameters(text: &str) -> PointMassParameters {
        toml::from_str(text).unwrap()
    }

    #[test]
    fn each_reward_has_the_defaults_of_its_section() {
        assert_eq!(
            parameters("reward = 'r1'").reward,
            Reward {
                amplitude: 1.0,
                variance: 0.4,
                c_d: 1.0,
                terms: RewardTerms::R1
            }
        );
        let (amplitude, variance, c_d, c_theta_dot) = (2.0, 0.1, 0.5f64.sqrt(), 0.0015);
        let of = |terms| Reward {
            amplitude,
            variance,
            c_d,
            terms,
        };
        let r2 = of(RewardTerms::R2 {
            c_theta_dot,
            c_force_dot: 0.0,
        });
        assert_eq!(parameters("reward = 'r2'").reward, r2);
        let r3 = of(RewardTerms::R3 {
            c_theta_dot,
            c_force: 0.03,
        });
        assert_eq!(parameters("reward = 'r3'").reward, r3);
        assert_eq!(parameters("").reward, r3);
    }

    #[test]
    fn one_key_changes_one_number() {
        let changed = parameters("friction = 0.03\nreward = 'r2'\nc_force_dot = 1");
        assert_eq!((changed.friction, changed.mass), (0.03, 1.0));
        assert!(matches!(
            changed.reward.terms,
            RewardTerms::R2 {
                c_force_dot: 1.0,
                c_theta_dot: 0.0015,
            }
        ));
    }

    #[test]
    fn the_resolved_table_has_only_the_parameters_of_its_reward() {
        let resolved = |text: &str| resolve("point-mass", &text.parse().unwrap()).unwrap();
        for (reward, count) in [("r1", 10), ("r2", 12), ("r3", 12)] {
            let table = resolved(&format!("reward = '{reward}'"));
            assert_eq!(table.len(), count, "{table}");
            assert_eq!(resolved(&table.to_string()), table);
        }
    }

    #[test]
    fn wrong_parameters_are_named() {
        let refusal = |text: &str| make("point-mass", &text.parse().unwrap()).err().unwrap().to_string();
        let foreign = refusal("reward = 'r1'\nc_force = 0.1");
        assert!(
            foreign.contains("`c_force` is not a parameter of reward r1"),
            "{foreign}"
        );
        let unknown = refusal("reward = 'r4'");
        assert!(
            unknown.contains("reward = \"r4\": unknown variant `r4`") && unknown.contains("`r3`"),
            "{unknown}"
        );
        for key in [
            "amplitude",
            "c_d",
            "c_theta_dot",
            "c_force",
            "mass",
            "gravity",
            "goal_radius",
        ] {
            let message = refusal(&format!("{key} = -1.0"));
            assert!(message.contains(&format!("{key} = -1: must be from ")), "{message}");
        }
        assert!(refusal("variance = 0.0").contains("variance = 0:"));
    }
}
