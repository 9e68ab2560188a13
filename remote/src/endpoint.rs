//! The address at which a gate listens, as in `tcp/127.0.0.1:7447`.

use std::fmt;
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// The address of a gate. There is no encryption yet, so it is an address of the machine itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Endpoint(SocketAddr);

/// Why a text is no endpoint.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EndpointError {
    /// It is not written as one.
    #[error("{0} is no endpoint: write tcp/ADDRESS:PORT, as in tcp/127.0.0.1:7447")]
    Form(String),
    /// Data would cross a network unencrypted.
    #[error("{0} is not an address of this machine alone: without encryption, only 127.0.0.1 and [::1] are allowed")]
    Open(String),
    /// The system gives no port.
    #[error("cannot get a free port at {0}: {1}")]
    Port(String, String),
}

impl Endpoint {
    /// The endpoint of a run for which the user names none: a free port of the machine itself.
    pub const DEFAULT: &str = "tcp/127.0.0.1:0";

    /// The same endpoint, with a free port if its port is 0.
    ///
    /// # Errors
    /// When the port is taken, or none is free.
    pub fn with_port(self) -> Result<Self, EndpointError> {
        let failed = |cause: std::io::Error| EndpointError::Port(self.to_string(), cause.to_string());
        let listener = TcpListener::bind(self.0).map_err(failed)?;
        Ok(Self(listener.local_addr().map_err(failed)?))
    }
}

impl FromStr for Endpoint {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        let form = || EndpointError::Form(text.into());
        let address: SocketAddr = text
            .strip_prefix("tcp/")
            .ok_or_else(form)?
            .parse()
            .map_err(|_| form())?;
        let is_local = match address.ip() {
            IpAddr::V4(ip) => ip.is_loopback(),
            IpAddr::V6(ip) => ip.is_loopback(),
        };
        if is_local {
            Ok(Self(address))
        } else {
            Err(EndpointError::Open(text.into()))
        }
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "tcp/{}", self.0)
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
    fn only_addresses_of_this_machine_are_endpoints() {
        for good in ["tcp/127.0.0.1:7447", "tcp/[::1]:1", "tcp/127.9.9.9:0"] {
            assert_eq!(good.parse::<Endpoint>().unwrap().to_string(), good);
        }
        for bad in [
            "",
            "127.0.0.1:7447",
            "udp/127.0.0.1:1",
            "tcp/localhost:1",
            "tcp/127.0.0.1",
            "tcp/127.0.0.1:70000",
        ] {
            assert_eq!(bad.parse::<Endpoint>(), Err(EndpointError::Form(bad.into())));
        }
        for open in ["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447", "tcp/[::]:1"] {
            assert_eq!(open.parse::<Endpoint>(), Err(EndpointError::Open(open.into())));
        }
    }

    #[test]
    fn port_0_becomes_a_free_one() {
        let endpoint = Endpoint::DEFAULT.parse::<Endpoint>().unwrap().with_port().unwrap();
        assert_ne!(endpoint.to_string(), Endpoint::DEFAULT);
    }
}
