//! The policy outlives its learner, reaches those who come late, and is followed by the next learner's.

use shoal_common::channel::Domain;
use shoal_common::channel::policy::{Policy, PolicyReader};

use crate::children::{FINGERPRINT, PARAMETERS};
use crate::process::Process;
use crate::run::{Run, eventually};

fn reader(domain: &Domain) -> PolicyReader {
    PolicyReader::open(domain, FINGERPRINT, PARAMETERS).unwrap()
}

fn publishes(learner: &mut Process, version: u64) {
    learner.told(&format!("publish {version}"));
    learner.says("published");
}

fn is(policy: &Policy, incarnation: u64, version: u64) -> bool {
    let header = policy.header();
    let parameters = policy.parameters();
    let whole = parameters.iter().all(|parameter| *parameter == header.version as f32);
    assert!(
        whole && parameters.len() == PARAMETERS,
        "a policy's parameters are those it was published with"
    );
    (header.incarnation, header.version) == (incarnation, version)
}

fn reads(reader: &mut PolicyReader, incarnation: u64, version: u64) {
    eventually(&format!("version {version} of learner {incarnation} arrives"), || {
        reader
            .latest()
            .unwrap()
            .is_some_and(|policy| is(&policy, incarnation, version))
    });
}

#[test]
fn a_policy_stays_as_it_is_when_its_learner_is_killed_and_the_next_learners_follows() {
    let run = Run::new();
    let domain = run.join();
    let mut early = reader(&domain);
    assert!(early.latest().unwrap().is_none());
    let mut learner = run.start("policy-publisher 0");
    for version in 1..=7 {
        publishes(&mut learner, version);
    }
    reads(&mut early, 0, 7);
    // Comes after the publication, and is given it without another one.
    let mut late = reader(&domain);
    reads(&mut late, 0, 7);
    learner.kill();
    for reader in [&mut early, &mut late] {
        assert!(is(&reader.latest().unwrap().unwrap(), 0, 7));
    }

    let held = early.latest().unwrap().unwrap();
    let mut learner = run.start("policy-publisher 1");
    assert!(is(&held, 0, 7));
    drop(held);
    // A learner goes on from its checkpoint: its version may be an older one.
    publishes(&mut learner, 5);
    for reader in [&mut early, &mut late] {
        reads(reader, 1, 5);
    }
    learner.ends();
    assert!(is(&early.latest().unwrap().unwrap(), 1, 5));
}

#[test]
fn a_policy_published_between_a_readers_looks_is_found_though_its_learner_died() {
    let run = Run::new();
    let domain = run.join();
    let mut learner = run.start("policy-publisher 0");
    let mut reader = reader(&domain);
    publishes(&mut learner, 1);
    reads(&mut reader, 0, 1);
    publishes(&mut learner, 2);
    learner.kill();
    reads(&mut reader, 0, 2);
    for incarnation in 1..=4 {
        let mut learner = run.start(&format!("policy-publisher {incarnation}"));
        publishes(&mut learner, 2 + incarnation);
        learner.kill();
    }
    // Those that died unread are older than the last one, and never read after it.
    let mut learner = run.start("policy-publisher 5");
    publishes(&mut learner, 9);
    reads(&mut reader, 5, 9);
    assert!(is(&reader.latest().unwrap().unwrap(), 5, 9));
}
