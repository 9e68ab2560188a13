//! How many actors each host gets.

use shoal_common::channel::control::ScaleRequest;
use shoal_common::config::ActorsConfig;

/// A host that has actors.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ActorHost {
    /// `None` for the learner's host.
    pub(super) name: Option<String>,
    pub(super) cores: u32,
    /// The actors that it has, or is about to have.
    pub(super) actors: u32,
}

/// The number of actors of each host after this request. A total is shared in proportion to the processor cores of
/// the hosts that the request does not name, and each of them gets at least one.
///
/// # Errors
/// Why there are no such numbers.
pub(super) fn shares(request: &ScaleRequest, hosts: &[ActorHost], max_actors: u32) -> Result<Vec<u32>, String> {
    let mut named = vec![None; hosts.len()];
    for (i, host) in hosts.iter().enumerate() {
        if host.name.is_none() {
            named[i] = request.here;
        }
    }
    for (name, actors) in &request.joined {
        let has_name = |(_, host): &(usize, &ActorHost)| host.name.as_ref() == Some(name);
        let found: Vec<usize> = hosts.iter().enumerate().filter(has_name).map(|(i, _)| i).collect();
        match found[..] {
            [i] => named[i] = Some(*actors),
            [] => {
                return Err(format!(
                    "no host {name:?} has joined the run; `shoal status` names those that have"
                ));
            }
            _ => {
                return Err(format!(
                    "{} hosts are called {name:?}; `shoal join --name` gives each its own",
                    found.len()
                ));
            }
        }
    }
    let shares: Vec<u32> = match request.total {
        None => hosts
            .iter()
            .zip(&named)
            .map(|(host, named)| named.unwrap_or(host.actors))
            .collect(),
        Some(total) if total > max_actors => return Err(too_many(total.into(), max_actors, hosts)),
        Some(total) => share_total(total, &named, hosts)?,
    };
    let most = max_actors.min(ActorsConfig::MAX_ON_A_HOST);
    if let [here] = shares[..]
        && !(1..=most).contains(&here)
    {
        return Err(format!(
            "this run can have 1 to {most} actors (actors.max, fixed when it was created)"
        ));
    }
    shares
        .iter()
        .try_for_each(|share| ActorsConfig::check_on_a_host(*share))?;
    let sum: u64 = shares.iter().map(|share| u64::from(*share)).sum();
    if sum <= u64::from(max_actors) {
        return Ok(shares);
    }
    Err(too_many(sum, max_actors, hosts))
}

fn too_many(sum: u64, max_actors: u32, hosts: &[ActorHost]) -> String {
    let joined = hosts.iter().filter(|host| host.name.is_some());
    let others: u32 = joined.map(|host| host.actors).sum();
    format!(
        "that would be {sum} actors: the run may have {max_actors} on all hosts together (actors.max, fixed when it was \
         created), and other hosts have {others}"
    )
}

fn share_total(total: u32, named: &[Option<u32>], hosts: &[ActorHost]) -> Result<Vec<u32>, String> {
    let fixed: u64 = named.iter().flatten().map(|actors| u64::from(*actors)).sum();
    let open = named.iter().filter(|named| named.is_none()).count() as u64;
    let rest = u64::from(total)
        .checked_sub(fixed)
        .filter(|rest| *rest >= open && (open > 0 || *rest == 0));
    let Some(rest) = rest else {
        return Err(format!(
            "{total} actors cannot be shared by {} hosts, of which {} are to have {fixed}: each has at least 1",
            hosts.len(),
            hosts.len() as u64 - open
        ));
    };
    let mut shares: Vec<u32> = named.iter().map(|named| named.unwrap_or(1)).collect();
    // Each further actor goes to the host with the most cores per actor, this actor counted (D'Hondt).
    for _ in 0..rest - open {
        let per_actor = |i: &usize| f64::from(hosts[*i].cores.max(1)) / f64::from(shares[*i] + 1);
        let next = (0..hosts.len())
            .filter(|i| named[*i].is_none())
            .max_by(|a, b| per_actor(a).total_cmp(&per_actor(b)).then(b.cmp(a)));
        if let Some(next) = next {
            shares[next] += 1;
        }
    }
    Ok(shares)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hosts() -> Vec<ActorHost> {
        let host = |name: Option<&str>, cores, actors| ActorHost {
            name: name.map(str::to_owned),
            cores,
            actors,
        };
        vec![host(None, 8, 2), host(Some("a"), 16, 4), host(Some("b"), 8, 1)]
    }

    fn request(here: Option<u32>, joined: &[(&str, u32)], total: Option<u32>) -> ScaleRequest {
        let joined = joined
            .iter()
            .map(|(name, actors)| ((*name).to_owned(), *actors))
            .collect();
        ScaleRequest { here, joined, total }
    }

    #[test]
    fn hosts_that_are_not_named_keep_their_actors() {
        let shares = |here, joined: &[_]| shares(&request(here, joined, None), &hosts(), 64);
        assert_eq!(shares(Some(5), &[]), Ok(vec![5, 4, 1]));
        assert_eq!(shares(None, &[("b", 6)]), Ok(vec![2, 4, 6]));
        assert_eq!(shares(Some(1), &[("b", 6), ("a", 2)]), Ok(vec![1, 2, 6]));
    }

    #[test]
    fn a_total_is_shared_by_cores() {
        let shares = |here, joined: &[_], total| shares(&request(here, joined, Some(total)), &hosts(), 64);
        assert_eq!(shares(None, &[], 32), Ok(vec![8, 16, 8]));
        assert_eq!(shares(None, &[], 3), Ok(vec![1, 1, 1]));
        assert_eq!(shares(None, &[], 4), Ok(vec![1, 2, 1]));
        assert_eq!(shares(Some(2), &[], 14), Ok(vec![2, 8, 4]));
        assert_eq!(shares(Some(2), &[("a", 3)], 14), Ok(vec![2, 3, 9]));
        for total in 3..=64 {
            assert_eq!(shares(None, &[], total).unwrap().iter().sum::<u32>(), total);
        }
    }

    #[test]
    fn impossible_numbers_are_refused_with_the_reason() {
        let why = |here, joined: &[_], total| shares(&request(here, joined, total), &hosts(), 20).unwrap_err();
        assert!(why(None, &[("c", 1)], None).contains("no host \"c\""));
        assert!(why(Some(0), &[], None).contains("at least 1 actor"));
        assert!(why(Some(16), &[], None).contains("20 on all hosts together"));
        assert!(why(None, &[], Some(2)).contains("cannot be shared by 3 hosts"));
        assert!(why(None, &[("a", 18)], Some(19)).contains("cannot be shared"));
        assert!(why(Some(1), &[("a", 1), ("b", 1)], Some(4)).contains("cannot be shared"));
        assert!(why(None, &[], Some(21)).contains("that would be 21 actors"));
        let twice = [hosts(), hosts()].concat();
        let same_name = shares(&request(None, &[("a", 1)], None), &twice, 20);
        assert!(same_name.unwrap_err().contains("2 hosts are called"));
    }
}
