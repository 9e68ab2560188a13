//! A policy outlives its learner, reaches late readers, and is replaced by the next learner's.

use shoal_common::channel::Domain;
use shoal_common::channel::policy::{PolicyReader, PublishedPolicy};

use crate::children::{FINGERPRINT, PARAMETERS};
use crate::process::Process;
use crate::run::{Run, eventually};

fn reader(domain: &Domain) -> PolicyReader {
    PolicyReader::open(domain, FINGERPRINT, PARAMETERS).unwrap()
}

fn publish(learner: &mut Process, version: u64) {
    learner.tell(&format!("publish {version}"));
    learner.expect_line("published");
}

fn is(policy: &PublishedPolicy, incarnation: u64, version: u64) -> bool {
    let header = policy.header();
    let parameters = policy.parameters();
    let whole = parameters.iter().all(|parameter| *parameter == header.version as f32);
    assert!(
        whole && parameters.len() == PARAMETERS,
        "a policy's parameters are those it was published with"
    );
    (header.incarnation, header.version) == (incarnation, version)
}

fn expect_policy(reader: &mut PolicyReader, incarnation: u64, version: u64) {
    eventually(&format!("version {version} of learner {incarnation} arrives"), || {
        reader
            .latest()
            .unwrap()
            .is_some_and(|policy| is(&policy, incarnation, version))
    });
}

#[test]
fn a_policy_survives_its_learner_until_the_next_learner_publishes() {
    let run = Run::new();
    let domain = run.join();
    let mut early = reader(&domain);
    assert!(early.latest().unwrap().is_none());
    let mut learner = run.start("policy-publisher 0");
    for version in 1..=7 {
        publish(&mut learner, version);
    }
    expect_policy(&mut early, 0, 7);
    // This reader opens after the publication and still receives the policy.
    let mut late = reader(&domain);
    expect_policy(&mut late, 0, 7);
    learner.kill();
    for reader in [&mut early, &mut late] {
        assert!(is(&reader.latest().unwrap().unwrap(), 0, 7));
    }

    let held = early.latest().unwrap().unwrap();
    let mut learner = run.start("policy-publisher 1");
    assert!(is(&held, 0, 7));
    drop(held);
    // A learner continues from its checkpoint, so its version may be older.
    publish(&mut learner, 5);
    for reader in [&mut early, &mut late] {
        expect_policy(reader, 1, 5);
    }
    learner.end();
    assert!(is(&early.latest().unwrap().unwrap(), 1, 5));
}

#[test]
fn a_reader_finds_a_policy_whose_learner_died_in_the_meantime() {
    let run = Run::new();
    let domain = run.join();
    let mut learner = run.start("policy-publisher 0");
    let mut reader = reader(&domain);
    publish(&mut learner, 1);
    expect_policy(&mut reader, 0, 1);
    publish(&mut learner, 2);
    learner.kill();
    expect_policy(&mut reader, 0, 2);
    for incarnation in 1..=4 {
        let mut learner = run.start(&format!("policy-publisher {incarnation}"));
        publish(&mut learner, 2 + incarnation);
        learner.kill();
    }
    // The unread policies are older than the last one and must not be read after it.
    let mut learner = run.start("policy-publisher 5");
    publish(&mut learner, 9);
    expect_policy(&mut reader, 5, 9);
    assert!(is(&reader.latest().unwrap().unwrap(), 5, 9));
}
