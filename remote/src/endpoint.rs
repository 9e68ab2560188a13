//! The address at which a gate listens, as in `tls/10.0.0.1:7447`.

use std::fmt;
use std::io::ErrorKind;
use std::net::{IpAddr, TcpListener, ToSocketAddrs};
use std::str::FromStr;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// The address of a gate. Data that leaves the machine is encrypted: `tcp` is for addresses of the machine itself.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Endpoint {
    protocol: Protocol,
    /// A name, an IPv4 address, or an IPv6 address in brackets.
    host: String,
    port: u16,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Protocol {
    Tcp,
    Tls,
}

/// Why an endpoint cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EndpointError {
    /// It is not written as one.
    #[error("{0} is not an endpoint: write tls/HOST:PORT, or tcp/127.0.0.1:PORT within one machine")]
    Form(String),
    /// Data would cross a network unencrypted.
    #[error("{0} is not an address of this machine alone: without encryption, only 127.0.0.1 and [::1] are allowed")]
    Unencrypted(String),
    /// The system gives no port.
    #[error("cannot listen at {0}: {1}")]
    Port(String, String),
}

impl Endpoint {
    /// The endpoint of a run for which the user names none: a free port of all addresses of the machine.
    pub const DEFAULT: &str = "tls/0.0.0.0:0";

    /// Whether it needs keys.
    pub fn is_encrypted(&self) -> bool {
        self.protocol == Protocol::Tls
    }

    /// The same endpoint, with a free port if its port is 0. Waits at most `timeout` for a port that is taken.
    ///
    /// # Errors
    /// When the port stays taken, none is free, or the address is not one of this machine.
    pub fn with_port(&self, timeout: Duration) -> Result<Self, EndpointError> {
        let failed = |cause: std::io::Error| EndpointError::Port(self.to_string(), cause.to_string());
        let address = format!("{}:{}", self.host, self.port);
        let addresses: Vec<_> = address.to_socket_addrs().map_err(failed)?.collect();
        let begun = Instant::now();
        let listener = loop {
            match TcpListener::bind(&addresses[..]) {
                Err(cause) if cause.kind() == ErrorKind::AddrInUse && begun.elapsed() < timeout => {
                    std::thread::sleep(Duration::from_millis(50));
                }
                bound => break bound.map_err(failed)?,
            }
        };
        Ok(Self {
            port: listener.local_addr().map_err(failed)?.port(),
            ..self.clone()
        })
    }

    /// The endpoint that other hosts connect to if the gate listens at this one. If it listens at all addresses, they
    /// use the machine's name.
    pub fn seen_from_elsewhere(&self, machine: &str) -> Self {
        let all = self.address().is_some_and(|address| address.is_unspecified());
        Self {
            host: if all { machine.into() } else { self.host.clone() },
            ..self.clone()
        }
    }

    /// Its address, if its host is not a name.
    fn address(&self) -> Option<IpAddr> {
        let inner = self.host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
        inner.unwrap_or(&self.host).parse().ok()
    }
}

impl FromStr for Endpoint {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        let form = || EndpointError::Form(text.into());
        let (protocol, address) = text.split_once('/').ok_or_else(form)?;
        let protocol = match protocol {
            "tcp" => Protocol::Tcp,
            "tls" => Protocol::Tls,
            _ => return Err(form()),
        };
        let (host, port) = address.rsplit_once(':').ok_or_else(form)?;
        let is_plain = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c);
        let endpoint = Self {
            protocol,
            host: host.into(),
            port: port.parse().map_err(|_| form())?,
        };
        let is_name = !host.is_empty() && host.chars().all(is_plain);
        match (protocol, endpoint.address()) {
            (Protocol::Tcp, Some(address)) if !address.is_loopback() => Err(EndpointError::Unencrypted(text.into())),
            (Protocol::Tcp, None) => Err(form()),
            (_, Some(IpAddr::V6(_))) if !host.starts_with('[') => Err(form()),
            (_, Some(_)) => Ok(endpoint),
            (Protocol::Tls, None) if is_name => Ok(endpoint),
            (Protocol::Tls, None) => Err(form()),
        }
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let protocol = match self.protocol {
            Protocol::Tcp => "tcp",
            Protocol::Tls => "tls",
        };
        write!(f, "{protocol}/{}:{}", self.host, self.port)
    }
}

impl TryFrom<String> for Endpoint {
    type Error = EndpointError;

    fn try_from(text: String) -> Result<Self, EndpointError> {
        text.parse()
    }
}

impl From<Endpoint> for String {
    fn from(endpoint: Endpoint) -> Self {
        endpoint.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_read_as_they_are_written() {
        for good in [
            "tcp/127.0.0.1:7447",
            "tcp/[::1]:1",
            "tcp/127.9.9.9:0",
            "tls/10.0.0.1:7447",
            "tls/node-7.cluster:1",
            "tls/[fe80::1]:2",
            Endpoint::DEFAULT,
        ] {
            assert_eq!(good.parse::<Endpoint>().unwrap().to_string(), good);
        }
        for bad in [
            "",
            "127.0.0.1:7447",
            "udp/127.0.0.1:1",
            "tcp/localhost:1",
            "tls/127.0.0.1",
            "tls/127.0.0.1:70000",
            "tls/:1",
            "tls/a b:1",
            "tls/a#b:1",
            "tls/fe80::1:2",
        ] {
            assert_eq!(bad.parse::<Endpoint>(), Err(EndpointError::Form(bad.into())));
        }
        for open in ["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447", "tcp/[::]:1"] {
            assert_eq!(open.parse::<Endpoint>(), Err(EndpointError::Unencrypted(open.into())));
        }
    }

    #[test]
    fn port_0_becomes_a_free_one_and_all_addresses_become_the_name_of_the_machine() {
        let endpoint = Endpoint::DEFAULT
            .parse::<Endpoint>()
            .unwrap()
            .with_port(Duration::ZERO)
            .unwrap();
        assert_ne!(endpoint.to_string(), Endpoint::DEFAULT);
        let seen = endpoint.seen_from_elsewhere("node-7").to_string();
        assert!(seen.starts_with("tls/node-7:"), "{seen}");
        let local: Endpoint = "tcp/127.0.0.1:7".parse().unwrap();
        assert_eq!(local.seen_from_elsewhere("node-7"), local);
        let elsewhere: Endpoint = "tls/192.0.2.1:0".parse().unwrap();
        assert!(
            elsewhere
                .with_port(Duration::ZERO)
                .unwrap_err()
                .to_string()
                .contains("cannot listen at")
        );
    }
}
