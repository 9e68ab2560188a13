//! What the keys of a run allow on the network, without any role behind it.

#![cfg(feature = "network")]
#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use shoal_remote::endpoint::Endpoint;
use shoal_remote::files::KeyFile;
use shoal_remote::keys::{self, Keys, VALIDITY};
use shoal_remote::network::{connect, listen, restart_with_one_thread};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

const RUN: &str = "1a2b";

fn endpoint() -> Endpoint {
    "tls/127.0.0.1:0"
        .parse::<Endpoint>()
        .unwrap()
        .with_port(Duration::ZERO)
        .unwrap()
}

fn fresh() -> Keys {
    keys::make(RUN, SystemTime::now() + VALIDITY).unwrap()
}

/// How often this payload is received with this key.
fn counting(session: &Session, key: &str, payload: &'static str) -> Arc<AtomicUsize> {
    let count = Arc::new(AtomicUsize::new(0));
    let counted = count.clone();
    let count_one = move |sample: Sample| {
        if sample.payload().to_bytes() == payload.as_bytes() {
            counted.fetch_add(1, Ordering::Relaxed);
        }
    };
    session
        .declare_subscriber(key.to_owned())
        .callback(count_one)
        .background()
        .wait()
        .unwrap();
    count
}

/// Repeats something until a condition holds, and returns whether it did within a time.
fn within(seconds: u64, mut holds: impl FnMut() -> bool) -> bool {
    let begun = Instant::now();
    while begun.elapsed() < Duration::from_secs(seconds) {
        if holds() {
            return true;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    false
}

/// Whether a host with this key can send a chunk to a gate with that one.
fn gets_through(gate: &KeyFile, host: &KeyFile, seconds: u64) -> bool {
    let endpoint = endpoint();
    let gate = listen(&endpoint, Some(gate)).unwrap();
    let received = counting(&gate, "shoal/1a2b/up/**", "chunk");
    let host = connect(&endpoint, Some(host)).unwrap();
    within(seconds, || {
        host.put("shoal/1a2b/up/7/chunks", "chunk").wait().unwrap();
        received.load(Ordering::Relaxed) > 0
    })
}

#[test]
fn a_foreign_or_expired_key_or_that_of_the_gate_opens_nothing() {
    restart_with_one_thread().unwrap();
    let keys = fresh();
    assert!(gets_through(&keys.gate, &keys.join, 60), "the right key");
    assert!(!gets_through(&keys.gate, &fresh().join, 2), "that of another run");
    let year = Duration::from_secs(366 * 24 * 3600);
    let expired = keys::make(RUN, SystemTime::now() - 2 * year).unwrap();
    assert!(!gets_through(&expired.gate, &expired.join, 2), "an expired one");
    // A host cannot pass for the gate.
    assert!(!gets_through(&keys.join, &keys.join, 2), "that of a host as the gate's");
}

#[test]
fn a_host_may_send_chunks_and_receive_acknowledgements_and_nothing_else() {
    restart_with_one_thread().unwrap();
    let keys = fresh();
    let endpoint = endpoint();
    let gate = listen(&endpoint, Some(&keys.gate)).unwrap();
    let up = counting(&gate, "shoal/1a2b/up/**", "chunk");
    let [forged_acknowledgements, other_run] =
        ["shoal/1a2b/down/**", "shoal/other/**"].map(|key| counting(&gate, key, "forged"));
    let host = connect(&endpoint, Some(&keys.join)).unwrap();
    let acknowledgements = counting(&host, "shoal/1a2b/down/7/marks", "acknowledgement");
    let second = connect(&endpoint, Some(&keys.join)).unwrap();
    let [of_others, everything] = ["shoal/1a2b/up/**", "**"].map(|key| counting(&second, key, "secret"));
    let allowed = within(60, || {
        host.put("shoal/1a2b/up/7/chunks", "chunk").wait().unwrap();
        gate.put("shoal/1a2b/down/7/marks", "acknowledgement").wait().unwrap();
        up.load(Ordering::Relaxed) > 0 && acknowledgements.load(Ordering::Relaxed) > 0
    });
    assert!(allowed);
    let before = up.load(Ordering::Relaxed);
    for _ in 0..40 {
        host.put("shoal/1a2b/down/7/marks", "forged").wait().unwrap();
        host.put("shoal/other/up/7/chunks", "forged").wait().unwrap();
        host.put("shoal/1a2b/up/7/chunks", "secret").wait().unwrap();
        second.put("shoal/1a2b/up/8/chunks", "chunk").wait().unwrap();
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(up.load(Ordering::Relaxed) > before, "the second host is connected");
    assert_eq!(
        forged_acknowledgements.load(Ordering::Relaxed),
        0,
        "forged acknowledgements arrive"
    );
    assert_eq!(other_run.load(Ordering::Relaxed), 0, "chunks of another run arrive");
    let read = of_others.load(Ordering::Relaxed) + everything.load(Ordering::Relaxed);
    assert_eq!(read, 0, "a host reads what another sends");
}

/// Carries bytes between each connection and the gate, and breaks the connection after a moment.
fn breaking_proxy(gate: &Endpoint) -> Endpoint {
    let ours = endpoint();
    let address = |endpoint: &Endpoint| endpoint.to_string().trim_start_matches("tls/").to_owned();
    let (listener, gate) = (TcpListener::bind(address(&ours)).unwrap(), address(gate));
    std::thread::spawn(move || {
        for (number, host) in listener.incoming().flatten().enumerate() {
            let gate = TcpStream::connect(&gate).unwrap();
            let (up, down) = (copying(&host, &gate), copying(&gate, &host));
            std::thread::sleep(Duration::from_millis(100 + number as u64 * 37 % 200));
            for stream in [&host, &gate] {
                let _ = stream.shutdown(Shutdown::Both);
            }
            drop((up.join(), down.join()));
        }
    });
    ours
}

fn copying(from: &TcpStream, to: &TcpStream) -> JoinHandle<()> {
    let (mut from, mut to) = (from.try_clone().unwrap(), to.try_clone().unwrap());
    std::thread::spawn(move || drop(std::io::copy(&mut from, &mut to)))
}

/// Reading and writing at the same time corrupts the memory of a TLS connection.
#[test]
fn connections_that_break_under_traffic_in_both_directions_harm_nothing() {
    restart_with_one_thread().unwrap();
    let keys = fresh();
    let endpoint = endpoint();
    let gate = listen(&endpoint, Some(&keys.gate)).unwrap();
    let payload: &'static str = "chunk".repeat(20_000).leak();
    let up = counting(&gate, "shoal/1a2b/up/**", payload);
    let host = connect(&breaking_proxy(&endpoint), Some(&keys.join)).unwrap();
    let down = counting(&host, "shoal/1a2b/down/7/marks", payload);
    for _ in 0..20 {
        let before = [&up, &down].map(|count| count.load(Ordering::Relaxed));
        let both = within(60, || {
            for _ in 0..20 {
                host.put("shoal/1a2b/up/7/chunks", payload).wait().unwrap();
                gate.put("shoal/1a2b/down/7/marks", payload).wait().unwrap();
            }
            [&up, &down]
                .iter()
                .zip(before)
                .all(|(count, before)| count.load(Ordering::Relaxed) > before + 100)
        });
        assert!(both, "messages no longer arrive");
    }
}
