//! The claims of section 5.3 and appendix A.

use shoal_run::evaluation::analysis::point_mass::{Measures, NEAR_STARTS, REACHED};

use super::super::claim::{Claim, percent, spread};
use super::super::result::SeedResult;
use super::Measurements;

type Seed = SeedResult<Measurements>;

/// A measure of one test run.
type Measure = fn(&Measures) -> f64;

const DISTANCE: Measure = |it| it.final_distance;
const TURNING: Measure = |it| it.turning;
const TURNING_AT_REST: Measure = |it| it.turning_at_rest;
const FORCE_AT_REST: Measure = |it| it.force_at_rest;
const FORCE_ON_THE_WAY: Measure = |it| it.force_on_the_way;

/// The test runs from the starts of section 5.3.
fn near(measures: &[Measures]) -> &[Measures] {
    &measures[..NEAR_STARTS.len().min(measures.len())]
}

/// The test runs from the starts of appendix A.2.
fn far(measures: &[Measures]) -> &[Measures] {
    &measures[NEAR_STARTS.len().min(measures.len())..]
}

fn mean(measures: &[Measures], measure: Measure) -> f64 {
    measures.iter().map(measure).sum::<f64>() / measures.len() as f64
}

fn greatest(measures: &[Measures], measure: Measure) -> f64 {
    measures.iter().map(measure).fold(0.0, f64::max)
}

/// The best policy's mean over the starts of section 5.3.
fn near_mean(seed: &Seed, measure: Measure) -> f64 {
    mean(near(&seed.measurements.best), measure)
}

/// The spread over the seeds of the best policy's and the last policy's means over the starts of section 5.3.
fn best_and_last(seeds: &[Seed], measure: Measure, decimals: usize, unit: &str) -> String {
    if seeds.is_empty() {
        return "no results".into();
    }
    format!(
        "{} {unit} (last policy {} {unit})",
        spread(seeds.iter().map(|seed| near_mean(seed, measure)), decimals),
        spread(
            seeds.iter().map(|seed| mean(near(&seed.measurements.last), measure)),
            decimals
        )
    )
}

/// Pairs of results with the same seed.
fn pairs<'a>(a: &'a [Seed], b: &'a [Seed]) -> impl Iterator<Item = (&'a Seed, &'a Seed)> {
    a.iter()
        .filter_map(|one| Some((one, b.iter().find(|other| other.header.seed == one.header.seed)?)))
}

/// The distances to the goal in the final evaluation.
fn final_distances_text(seeds: &[Seed]) -> String {
    let shares = seeds.iter().filter_map(|seed| seed.best.evaluation.reached_fraction);
    let distances = seeds.iter().filter_map(|seed| seed.best.evaluation.final_distance_mean);
    format!(
        "from 100 random starts {} m, with {} % ending within {REACHED} m",
        spread(distances, 3),
        spread(shares.map(|share| 100.0 * share), 0)
    )
}

fn arrival_claim(seeds: &[Seed], statement: &'static str) -> Claim {
    let farthest = |seed: &Seed| greatest(near(&seed.measurements.best), DISTANCE);
    Claim::each_seed(
        statement,
        "from each of the four starts of section 5.3 it ends within 0.05 m of the goal",
        format!(
            "largest of the four distances at the end: {} m; {}",
            spread(seeds.iter().map(farthest), 3),
            final_distances_text(seeds)
        ),
        seeds.iter().map(|seed| farthest(seed) < REACHED),
    )
}

pub(super) fn of_r1(seeds: &[Seed]) -> Vec<Claim> {
    vec![
        arrival_claim(
            seeds,
            "The vehicle learns to move from its start position to the goal; the position error converges to zero",
        ),
        Claim::each_seed(
            "Once the vehicle has stopped at the goal, the applied force does not go to zero",
            "the mean force at rest is above 0.1 N (its range is 0 to 2)",
            format!("force at rest {}", best_and_last(seeds, FORCE_AT_REST, 3, "N")),
            seeds.iter().map(|seed| near_mean(seed, FORCE_AT_REST) > 0.1),
        ),
        Claim::each_seed(
            "… and the direction is shaky",
            "at rest the direction changes by more than 0.1 rad a step (5 rad in 50 steps)",
            format!("turning at rest {}", best_and_last(seeds, TURNING_AT_REST, 1, "rad")),
            seeds.iter().map(|seed| near_mean(seed, TURNING_AT_REST) > 5.0),
        ),
    ]
}

/// See [`SeedResult::learned_by`]; `None` unless the best policy reaches the goal from at least half of the starts of
/// section 5.3.
fn converged_by(seed: &Seed) -> Option<u64> {
    let starts = near(&seed.measurements.best);
    let arrived = starts.iter().filter(|it| it.final_distance < REACHED).count();
    seed.learned_by().filter(|_| 2 * arrived >= starts.len())
}

pub(super) fn of_r2(r1: &[Seed], r2: &[Seed]) -> Vec<Claim> {
    let steady: Measure = |it| it.drift_at_rest;
    let converged = |seeds: &[Seed]| {
        let steps = seeds.iter().filter_map(converged_by);
        let never = seeds.iter().filter(|seed| converged_by(seed).is_none()).count();
        let episodes = spread(steps.map(|steps| steps as f64 / 200.0), 0);
        if never > 0 {
            format!("{episodes} (never: {never})")
        } else {
            episodes
        }
    };
    let sooner = |(r1, r2): (&Seed, &Seed)| match (converged_by(r1), converged_by(r2)) {
        (Some(r1), Some(r2)) => r2 < r1,
        (_, r2) => r2.is_some(),
    };
    vec![
        Claim::each_seed(
            "Reward r2 causes the solution to converge after only 2000 episodes, significantly less than with r1",
            "fewer episodes than with r1 and the same seed until an evaluation has covered nine tenths of the way from \
             the run's first return to its best (never, if the best policy arrives from fewer than two of the four \
             starts)",
            format!("episodes with r2: {}; with r1: {}", converged(r2), converged(r1)),
            pairs(r1, r2).map(sooner),
        ),
        Claim::each_seed(
            "F_u approaches a steady value close to zero",
            "the mean force at rest is below 0.2 N, a tenth of its range",
            format!("force at rest {}", best_and_last(r2, FORCE_AT_REST, 3, "N")),
            r2.iter().map(|seed| near_mean(seed, FORCE_AT_REST) < 0.2),
        ),
        Claim::each_seed(
            "The vehicle remains stationary, which leads to a steady state error in position",
            "at rest the distance to the goal changes by less than 0.01 m, and at the end it is between 0.005 m and \
             0.5 m",
            format!(
                "distance at the end {}; change at rest {}; {}",
                best_and_last(r2, DISTANCE, 3, "m"),
                best_and_last(r2, steady, 3, "m"),
                final_distances_text(r2)
            ),
            r2.iter()
                .map(|seed| near_mean(seed, steady) < 0.01 && (0.005..0.5).contains(&near_mean(seed, DISTANCE))),
        ),
    ]
}

pub(super) fn of_r3(r1: &[Seed], r2: &[Seed], r3: &[Seed]) -> Vec<Claim> {
    let less_than = |others: &[Seed]| -> Vec<(u64, bool)> {
        let less = |(other, r3): (&Seed, &Seed)| near_mean(r3, FORCE_ON_THE_WAY) < near_mean(other, FORCE_ON_THE_WAY);
        pairs(others, r3).map(|pair| (pair.1.header.seed, less(pair))).collect()
    };
    let farthest = |seed: &Seed| greatest(far(&seed.measurements.best), DISTANCE);
    let least_arrived = r3.iter().map(|seed| {
        let far = far(&seed.measurements.best);
        far.iter().filter(|it| it.final_distance < REACHED).count() as f64 / far.len() as f64
    });
    let least_arrived = least_arrived.fold(1.0, f64::min);
    vec![
        arrival_claim(r3, "The position error converges to zero"),
        Claim::each_seed(
            "F_u becomes zero when the vehicle is stopping",
            "the mean force at rest is below 0.1 N (its range is 0 to 2)",
            format!("force at rest {}", best_and_last(r3, FORCE_AT_REST, 3, "N")),
            r3.iter().map(|seed| near_mean(seed, FORCE_AT_REST) < 0.1),
        ),
        Claim::each_seed(
            "The agent applies less force than previously",
            "the mean force until the goal is reached is smaller than with r1 and with r2 for the same seed",
            format!(
                "force on the way with r3: {}; with r1: {}; with r2: {}",
                best_and_last(r3, FORCE_ON_THE_WAY, 2, "N"),
                best_and_last(r1, FORCE_ON_THE_WAY, 2, "N"),
                best_and_last(r2, FORCE_ON_THE_WAY, 2, "N")
            ),
            less_than(r1).into_iter().filter_map(|(seed, less)| {
                let than_r2 = less_than(r2).into_iter().find(|(other, _)| *other == seed)?.1;
                Some(less && than_r2)
            }),
        ),
        Claim::each_seed(
            "Paths taken when the starting position is further from the goal (appendix A.2) end at the goal too",
            "from each of the eight starts of appendix A.2 it ends within 0.05 m of the goal",
            format!(
                "largest of the eight distances at the end: {} m; the worst seed arrives from {} of the eight",
                spread(r3.iter().map(farthest), 3),
                percent(least_arrived)
            ),
            r3.iter().map(|seed| farthest(seed) < REACHED),
        ),
    ]
}

pub(super) fn of_comparison(r1: &[Seed], r2: &[Seed], r3: &[Seed]) -> Vec<Claim> {
    let turning = |seed: &Seed| mean(&seed.measurements.best, TURNING);
    let turnings = |seeds: &[Seed]| spread(seeds.iter().map(turning), 1);
    let calmer = |statement, criterion, than: &[Seed], seeds: &[Seed], names: [&str; 2]| {
        let measured = format!(
            "turning from all twelve starts: {} rad with {}, {} rad with {}",
            turnings(seeds),
            names[0],
            turnings(than),
            names[1]
        );
        let held = pairs(than, seeds).map(|(than, it)| turning(it) < turning(than));
        Claim::each_seed(statement, criterion, measured, held)
    };
    vec![
        calmer(
            "With r2, θ is less erratic than with r1",
            "less turning than with r1 and the same seed",
            r1,
            r2,
            ["r2", "r1"],
        ),
        calmer(
            "With r3, the direction is less erratic than with r1",
            "less turning than with r1 and the same seed",
            r1,
            r3,
            ["r3", "r1"],
        ),
        calmer(
            "With r3, the direction is less erratic than with r2",
            "less turning than with r2 and the same seed",
            r2,
            r3,
            ["r3", "r2"],
        ),
    ]
}

/// `before` are the results at the end of the first training, `after` the results at the end of the additional
/// training.
pub(super) fn of_longer(before: &[Seed], after: &[Seed]) -> Vec<Claim> {
    let value = |before: &Seed, after: &Seed, measure: Measure| {
        (
            near_mean(before, measure),
            mean(near(&after.measurements.last), measure),
        )
    };
    let check = |statement, criterion, what: &str, measure: Measure, decimals, holds: fn(f64, f64) -> bool| {
        let measured = format!(
            "{what}: best policy of the first training {}; last policy of the additional training {}",
            spread(pairs(before, after).map(|(b, a)| value(b, a, measure).0), decimals),
            spread(pairs(before, after).map(|(b, a)| value(b, a, measure).1), decimals)
        );
        let held = pairs(before, after)
            .map(|(b, a)| value(b, a, measure))
            .map(|(b, a)| holds(b, a));
        Claim::each_seed(statement, criterion, measured, held)
    };
    vec![
        check(
            "With additional training the agent has learned to reduce the position error",
            "the last policy of the additional training ends nearer to the goal than the best policy of the first \
             training",
            "distance at the end in m",
            DISTANCE,
            3,
            |before, after| after < before,
        ),
        check(
            "… but it no longer understands how to reduce the derivative of the input",
            "the last policy of the additional training turns more than the best policy of the first training",
            "turning in rad",
            TURNING,
            1,
            |before, after| after > before,
        ),
        Claim::each_seed(
            "Early stopping is the most important regularisation: an agent that trains for too long gets worse",
            "in the final evaluation, the last policy of the additional training has a lower return than the best \
             policy of the first training",
            format!(
                "first training: best policy {}, last policy {}; after the additional training: last policy {}, best \
                 policy of both {}",
                spread(before.iter().map(|seed| seed.best.evaluation.return_mean), 1),
                spread(before.iter().map(|seed| seed.last.evaluation.return_mean), 1),
                spread(after.iter().map(|seed| seed.last.evaluation.return_mean), 1),
                spread(after.iter().map(|seed| seed.best.evaluation.return_mean), 1)
            ),
            pairs(before, after)
                .map(|(before, after)| after.last.evaluation.return_mean < before.best.evaluation.return_mean),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::super::tests::seed;
    use super::*;

    fn held(claims: Vec<Claim>) -> Vec<Vec<bool>> {
        claims.into_iter().map(|claim| claim.held()).collect()
    }

    #[test]
    fn the_claims_about_r1_are_checked_for_each_seed() {
        let seeds = [seed(1, 0.01, 0.5, 1.8, 0.5), seed(2, 2.0, 0.01, 0.5, 0.01)];
        assert_eq!(held(of_r1(&seeds)), [[true, false]; 3]);
        assert!(held(of_r1(&[])).iter().all(Vec::is_empty));
    }

    #[test]
    fn the_claims_about_r2_are_checked_for_each_seed() {
        let mut late = [seed(1, 0.01, 0.5, 1.8, 0.5), seed(2, 0.01, 0.5, 1.8, 0.5)];
        late[1].evaluations.truncate(4);
        let r2 = [seed(1, 0.03, 0.05, 1.0, 0.02), seed(2, 0.001, 0.05, 1.0, 0.5)];
        // The synthetic curves rise at the same steps; this makes the first seed of r1 slower.
        for it in &mut late[0].evaluations {
            it.steps *= 2;
        }
        assert_eq!(held(of_r2(&late, &r2)), [[true, false]; 3]);
        assert!(held(of_r2(&[], &r2))[0].is_empty(), "nothing to compare with");
        let never = [seed(1, 2.0, 0.5, 1.8, 0.5)];
        assert_eq!(
            held(of_r2(&never, &r2))[0],
            [true],
            "a run that never converges is slower"
        );
        let never_r2 = [seed(1, 2.0, 0.05, 1.0, 0.02)];
        assert_eq!(held(of_r2(&late, &never_r2))[0], [false]);
    }

    #[test]
    fn the_claims_about_r3_are_checked_for_each_seed() {
        let r1 = [seed(1, 0.01, 0.5, 1.8, 0.5), seed(2, 0.01, 0.5, 1.8, 0.5)];
        let r2 = [seed(1, 0.03, 0.1, 1.5, 0.0), seed(2, 0.03, 0.1, 0.5, 0.0)];
        let r3 = [seed(1, 0.01, 0.05, 1.0, 0.0), seed(2, 0.2, 0.05, 1.0, 0.5)];
        assert_eq!(held(of_r3(&r1, &r2, &r3)), [[true, false]; 4]);
        assert_eq!(
            held(of_r3(&r1, &r2[1..], &r3))[2],
            [false],
            "only seeds with results for all three rewards"
        );
        assert_eq!(held(of_comparison(&r1, &r2, &r3)), [[true, true]; 3]);
        assert_eq!(held(of_comparison(&r2, &r1, &r3))[0], [false, false]);
    }

    #[test]
    fn the_claims_about_additional_training_are_checked_for_each_seed() {
        let before = [seed(1, 0.05, 0.1, 1.0, 0.0), seed(2, 0.05, 0.1, 1.0, 0.0)];
        let mut after = [seed(1, 0.01, 1.0, 1.0, 0.5), seed(2, 0.1, 0.05, 1.0, 0.5)];
        after[1].last.evaluation.return_mean = 200.0;
        assert_eq!(held(of_longer(&before, &after)), [[true, false]; 3]);
    }
}
