//! The bytes between gate and relay: recorded ones stay readable, and no bytes do harm.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

use proptest::prelude::*;
use shoal_common::channel::policy::PolicyHeader;
use shoal_common::channel::transitions::ChunkHeader;
use shoal_common::commit::ChunkId;
use shoal_common::role::{Activity, Role};
use shoal_remote::wire::{
    Acknowledgement, ActorAcknowledgement, Admission, Hello, HostReport, Message, PolicyId, PolicyRequest,
    RemoteEpisode, RemoteRole, ReportNumber, RunPhase, VERSION, WireChunk, WireError, WireLease, WirePolicy,
};

fn header() -> ChunkHeader {
    ChunkHeader {
        incarnation: 7,
        sequence: 5,
        policy_version: 3,
        rows: 1,
        actor: 2,
    }
}

fn chunk() -> Vec<u8> {
    WireChunk::encode(9, &header(), &[1.0, -2.0], &[0.5])
}

fn policy() -> Vec<u8> {
    let header = PolicyHeader {
        incarnation: 1,
        version: 2,
        env_steps: 3,
        updates: 4,
        fingerprint: 5,
    };
    WirePolicy::encode(&header, &[1.5])
}

fn hello() -> Hello {
    Hello {
        program: "0.1.0".into(),
        host: 9,
        name: "node".into(),
        instructions: "avx2".into(),
        actors: 4,
        cores: 8,
        held: vec![1, 2],
    }
}

fn admission() -> Admission {
    Admission::Admitted(WireLease {
        epoch: 6,
        config: "[run]\n".into(),
        actors: vec![1, 2],
        first_incarnation: 1000,
        limit: 2000,
    })
}

fn acknowledgement() -> Acknowledgement {
    Acknowledgement {
        epoch: 6,
        gate: 8,
        number: 3,
        phase: RunPhase::Running,
        rows: 640,
        report: ReportNumber { relay: 7, report: 2 },
        wanted_actors: 1,
        actors: vec![ActorAcknowledgement {
            actor: 1,
            committed: ChunkId {
                incarnation: 7,
                sequence: 4,
            },
            forwarded: ChunkId {
                incarnation: 7,
                sequence: 5,
            },
            rows: 256,
            snapshot: vec![1, 300],
        }],
    }
}

fn report() -> HostReport {
    HostReport {
        host: 9,
        number: ReportNumber { relay: 7, report: 3 },
        round_trip_us: Some(150),
        leaving: false,
        resent: 1,
        policy_version: 3,
        roles: vec![RemoteRole {
            role: Role::Actor,
            index: 1,
            activity: Activity::Working,
            faults: 0,
            incarnation: 7,
            steps: 640,
            policy_version: 3,
        }],
        episodes: vec![RemoteEpisode {
            actor: 1,
            environment: 0,
            steps: 200,
            terminated: false,
            episode_return: -140.5,
            policy_version: 3,
            env_steps: 640,
        }],
    }
}

fn request() -> PolicyRequest {
    PolicyRequest {
        host: 9,
        have: Some(PolicyId {
            incarnation: 1,
            version: 2,
        }),
    }
}

fn all() -> Vec<Vec<u8>> {
    vec![
        chunk(),
        policy(),
        hello().encode().unwrap(),
        admission().encode().unwrap(),
        acknowledgement().encode().unwrap(),
        report().encode().unwrap(),
        request().encode().unwrap(),
    ]
}

/// The first error, or none, of reading bytes as each kind of message.
fn read(bytes: &[u8]) -> [Option<WireError>; 7] {
    [
        WireChunk::decode(bytes).err(),
        WirePolicy::decode(bytes).err(),
        Hello::decode(bytes).err(),
        Admission::decode(bytes).err(),
        Acknowledgement::decode(bytes).err(),
        HostReport::decode(bytes).err(),
        PolicyRequest::decode(bytes).err(),
    ]
}

#[test]
fn every_message_arrives_unchanged_and_is_no_other() {
    let read_chunk = WireChunk::decode(&chunk()).unwrap();
    assert_eq!((read_chunk.host, read_chunk.header), (9, header()));
    assert_eq!(read_chunk.numbers, [1.0, -2.0, 0.5]);
    assert_eq!(WirePolicy::decode(&policy()).unwrap().parameters, [1.5]);
    assert_eq!(Hello::decode(&hello().encode().unwrap()), Ok(hello()));
    assert_eq!(Admission::decode(&admission().encode().unwrap()), Ok(admission()));
    assert_eq!(
        Acknowledgement::decode(&acknowledgement().encode().unwrap()),
        Ok(acknowledgement())
    );
    assert_eq!(HostReport::decode(&report().encode().unwrap()), Ok(report()));
    assert_eq!(PolicyRequest::decode(&request().encode().unwrap()), Ok(request()));
    for (i, bytes) in all().iter().enumerate() {
        for (j, error) in read(bytes).into_iter().enumerate() {
            assert_eq!(
                error,
                (i != j).then_some(WireError::MessageKind),
                "message {i} read as {j}"
            );
        }
    }
}

#[test]
fn the_bytes_are_those_of_this_format() {
    let recorded = [
        "010073680200000009000000000000000700000000000000050000000000000003000000000000000200000001000000\
         0000803f000000c00000003f",
        "0200736802000000010000000000000002000000000000000300000000000000040000000000000005000000000000000000c03f",
        "030073680200000005302e312e3009046e6f646504617678320408020102",
        "04007368020000000006065b72756e5d0a020102fbe803fbd007",
        "0500736802000000060803 00fb8002070201010107040705fb00010201fb2c01",
        "06007368020000000907030196000103010101000007fb800203010100c80000000000009061c003fb8002",
        "070073680200000009010102",
    ];
    for (bytes, recorded) in all().iter().zip(recorded) {
        let (body, checksum) = bytes.split_last_chunk::<4>().unwrap();
        let hex: String = body.iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(
            hex,
            recorded.replace(' ', ""),
            "increase the version of the format with every change"
        );
        assert_eq!(u32::from_le_bytes(*checksum), crc32fast::hash(body));
    }
}

#[test]
fn another_version_is_refused_by_its_number() {
    for mut bytes in all() {
        bytes[4] += 1;
        assert!(read(&bytes).contains(&Some(WireError::Version(VERSION + 1))));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        prop_assert!(read(&bytes).iter().all(Option::is_some));
    }

    #[test]
    fn changed_cut_and_longer_messages_are_refused(
        which in 0..7_usize,
        at in any::<prop::sample::Index>(),
        by in 1_u8..,
        more in prop::collection::vec(any::<u8>(), 1..9),
    ) {
        let bytes = all().swap_remove(which);
        let mut changed = bytes.clone();
        changed[at.index(bytes.len())] ^= by;
        prop_assert!(read(&changed).iter().all(Option::is_some));
        prop_assert!(read(&bytes[..at.index(bytes.len())]).iter().all(Option::is_some));
        prop_assert!(read(&[&bytes[..], &more].concat()).iter().all(Option::is_some));
    }

    #[test]
    fn a_wrong_body_with_a_right_checksum_does_no_harm(
        which in 0..7_usize,
        body in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        let start = &all().swap_remove(which)[..8];
        let mut bytes = [start, &body].concat();
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        // Some are valid messages by chance; none may panic or allocate without bound.
        read(&bytes);
    }
}
