//! Two network namespaces of this machine and a virtual cable between them: as far apart as one machine allows.

use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};

use anyhow::{Context, bail};

/// The ends of a cable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum End {
    Learner,
    Hosts,
}

impl End {
    const ALL: [Self; 2] = [Self::Learner, Self::Hosts];

    fn letter(self) -> char {
        match self {
            Self::Learner => 'a',
            Self::Hosts => 'b',
        }
    }
}

/// A cable. Its namespaces are removed when this is dropped.
#[derive(Debug)]
pub(super) struct Cable {
    /// Distinguishes it from other cables of this process.
    number: u32,
}

/// How many cables this process has made.
static MADE: AtomicU32 = AtomicU32::new(0);

impl Cable {
    /// A cable that carries `bits_per_second` in each direction, or as much as it can.
    ///
    /// # Errors
    /// When this machine makes none: root and iproute2 are needed.
    pub(super) fn new(bits_per_second: Option<u64>) -> anyhow::Result<Self> {
        let cable = Self {
            number: MADE.fetch_add(1, Ordering::Relaxed),
        };
        for end in End::ALL {
            ip(&["netns", "add", &cable.namespace(end)])?;
        }
        let [plug, socket] = End::ALL.map(|end| cable.device(end));
        let [learner, hosts] = End::ALL.map(|end| cable.namespace(end));
        ip(&[
            "link", "add", &plug, "netns", &learner, "type", "veth", "peer", "name", &socket, "netns", &hosts,
        ])?;
        for end in End::ALL {
            let (namespace, device) = (cable.namespace(end), cable.device(end));
            ip(&[
                "-n",
                &namespace,
                "addr",
                "add",
                &format!("{}/24", cable.address(end)),
                "dev",
                &device,
            ])?;
            ip(&["-n", &namespace, "link", "set", &device, "up"])?;
            if let Some(rate) = bits_per_second {
                let rate = rate.to_string();
                let queue = ["rate", &rate, "burst", "256kb", "latency", "50ms"];
                let limit = [
                    "netns", "exec", &namespace, "tc", "qdisc", "add", "dev", &device, "root", "tbf",
                ];
                ip(&[&limit[..], &queue].concat())?;
            }
        }
        Ok(cable)
    }

    /// The address of an end.
    pub(super) fn address(&self, end: End) -> String {
        let host = match end {
            End::Learner => 1,
            End::Hosts => 2,
        };
        format!("10.98.{}.{host}", self.number % 256)
    }

    /// The same program and arguments, at this end of the cable.
    pub(super) fn at(&self, end: End, command: &Command) -> anyhow::Result<Command> {
        // Inside `ip`, /proc/self/exe is another program.
        let program = std::env::current_exe().context("cannot find this program")?;
        let mut there = Command::new("ip");
        there.args(["netns", "exec", &self.namespace(end)]);
        there.arg(program).args(command.get_args());
        Ok(there)
    }

    /// Unplugs the cable, which both ends notice, or plugs it in.
    pub(super) fn set_plugged(&self, plugged: bool) -> anyhow::Result<()> {
        let state = if plugged { "up" } else { "down" };
        ip(&[
            "-n",
            &self.namespace(End::Learner),
            "link",
            "set",
            &self.device(End::Learner),
            state,
        ])
    }

    fn namespace(&self, end: End) -> String {
        format!("shoal-bench-{}-{}{}", std::process::id(), self.number, end.letter())
    }

    fn device(&self, end: End) -> String {
        format!("bench{}{}", self.number, end.letter())
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        for end in End::ALL {
            // It fails for a namespace that was never made.
            let _ = ip(&["netns", "del", &self.namespace(end)]);
        }
    }
}

fn ip(arguments: &[&str]) -> anyhow::Result<()> {
    let output = Command::new("ip")
        .args(arguments)
        .output()
        .context("cannot start `ip`")?;
    if !output.status.success() {
        let why = String::from_utf8_lossy(&output.stderr);
        bail!("`ip {}` failed: {}", arguments.join(" "), why.trim());
    }
    Ok(())
}
