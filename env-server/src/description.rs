//! What an environment says of itself besides its spaces, for programs that watch it: docs/PROTOCOL.md, "Description".

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use shoal_base::space::EnvironmentSpec;
use shoal_base::versioned_file::VersionedFile;

use crate::environment::{Environment, Goal, Picture, Signal, SignalSource};

/// The environment variable that names the file into which a server writes its description.
pub const FILE_VARIABLE: &str = "SHOAL_DESCRIPTION";

/// At most this many signals, and characters of a name.
const MAX_SIGNALS: usize = 64;
const MAX_NAME_LENGTH: usize = 80;

/// Keys that the report gives to signals of its own.
const RESERVED: [&str; 2] = ["reward", "return"];

/// The meaning of an environment's numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// The meaning of its observations and actions.
    pub signals: Vec<Signal>,
    /// Δt of a step in s, if the environment models time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_step: Option<f64>,
    /// What success means, if the environment defines it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub goal: Option<Goal>,
    /// How an episode is drawn.
    #[serde(default)]
    pub picture: Picture,
}

impl VersionedFile for Description {
    const FORMAT: u32 = 1;
    const IF_DAMAGED: &'static str = "; delete it: signals are then named by their numbers";
}

impl Description {
    /// Describes this environment.
    pub fn of(environment: &dyn Environment) -> Self {
        Self {
            signals: environment.signals(),
            time_step: environment.time_step(),
            goal: environment.goal(),
            picture: environment.picture(),
        }
    }

    /// Describes an environment if only its spaces are known.
    pub fn by_number(spec: &EnvironmentSpec) -> Self {
        Self {
            signals: Signal::by_number(spec),
            time_step: None,
            goal: None,
            picture: Picture::None,
        }
    }

    /// The file into which this process is asked to write its description, if it is asked for one.
    pub(crate) fn wanted() -> Option<PathBuf> {
        let path = std::env::var_os(FILE_VARIABLE).filter(|path| !path.is_empty())?;
        Some(path.into())
    }

    /// Checks that this can describe an environment with these spaces.
    ///
    /// # Errors
    /// What is wrong, in a sentence without its full stop.
    pub fn check(&self, spec: &EnvironmentSpec) -> Result<(), String> {
        let count = self.signals.len();
        if count > MAX_SIGNALS {
            return Err(format!("it has {count} signals: name at most {MAX_SIGNALS}"));
        }
        for (i, signal) in self.signals.iter().enumerate() {
            check_signal(signal, spec)?;
            let key = &signal.key;
            if RESERVED.contains(&key.as_str()) {
                return Err(format!("the key `{key}` is reserved: choose another one"));
            }
            if self.signals[..i].iter().any(|other| other.key == *key) {
                return Err(format!("two signals have the key `{key}`: give each its own"));
            }
        }
        if let Some(goal) = &self.goal {
            check_signal(&goal.distance, spec)?;
            if !(goal.within > 0.0 && goal.within.is_finite()) {
                return Err(format!("its goal is within {}: give a number above 0", goal.within));
            }
        }
        if let Some(seconds) = self
            .time_step
            .filter(|seconds| !(*seconds > 0.0 && seconds.is_finite()))
        {
            return Err(format!("its time step is {seconds} s: give a number above 0"));
        }
        for key in self.picture.keys() {
            let Some(signal) = self.signals.iter().find(|signal| signal.key == *key) else {
                return Err(format!("its picture needs a signal with the key `{key}`"));
            };
            if self.picture.scales().contains(key) && signal.range(spec).is_none() {
                return Err(format!("its picture needs finite bounds of `{key}`"));
            }
        }
        Ok(())
    }
}

fn check_signal(signal: &Signal, spec: &EnvironmentSpec) -> Result<(), String> {
    let Signal {
        key,
        label,
        unit,
        source,
    } = signal;
    for (what, text) in [("key", key), ("label", label), ("unit", unit)] {
        if text.chars().any(char::is_control) || text.chars().count() > MAX_NAME_LENGTH {
            return Err(format!(
                "the {what} {text:?} must be one line of at most {MAX_NAME_LENGTH} characters"
            ));
        }
    }
    if key.is_empty() || label.is_empty() {
        return Err("a signal has no key or no label: name it".into());
    }
    let (observation, action) = (spec.observation.width(), spec.action.width());
    let (of, index, width) = match *source {
        SignalSource::Observation(i) => ("observation", i, observation),
        SignalSource::Action(i) => ("action", i, action),
        SignalSource::Angle { cos, sin } => ("observation", cos.max(sin), observation),
    };
    if index >= width {
        return Err(format!(
            "the signal `{key}` is number {index}, counted from 0, of an {of} of {width} numbers"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_base::space::Space;

    fn spec() -> EnvironmentSpec {
        EnvironmentSpec {
            observation: Space::boxed(&[(-1.0, 1.0), (f32::NEG_INFINITY, 1.0)]),
            action: Space::discrete(3),
            time_limit: 10,
            state_width: 0,
        }
    }

    fn cart() -> Description {
        Description {
            signals: vec![
                Signal::observation(0, "position", "m"),
                Signal::angle(0, 1, "angle").label("angle from upright"),
                Signal::action(0, "push", ""),
            ],
            time_step: Some(0.05),
            goal: Some(Goal {
                distance: Signal::observation(0, "position", "m"),
                within: 0.1,
            }),
            picture: Picture::Cart { track: 2.0, pole: 1.0 },
        }
    }

    #[test]
    fn it_is_written_as_the_protocol_says() {
        let text = r#"{"format":1,"signals":[{"key":"position","label":"position","unit":"m","observation":0},
            {"key":"angle","label":"angle from upright","unit":"rad","angle":{"cos":0,"sin":1}},
            {"key":"push","label":"push","action":0}],"time_step":0.05,
            "goal":{"distance":{"key":"position","label":"position","unit":"m","observation":0},"within":0.1},
            "picture":{"kind":"cart","track":2.0,"pole":1.0}}"#;
        let read = Description::parse("it", text.as_bytes()).unwrap();
        assert_eq!(read, cart());
        assert_eq!(read.check(&spec()), Ok(()));
        let again = serde_json::to_string(&read).unwrap().replacen('{', "{\"format\":1,", 1);
        assert_eq!(Description::parse("it", again.as_bytes()).unwrap(), read);
        let least = Description::parse("it", b"{\"format\":1,\"signals\":[]}").unwrap();
        assert_eq!(
            (least.time_step, least.goal, least.picture),
            (None, None, Picture::None)
        );
    }

    #[test]
    fn what_does_not_fit_the_spaces_or_the_page_is_refused_in_one_line() {
        let with = |change: fn(&mut Description)| {
            let mut changed = cart();
            change(&mut changed);
            let refused = changed.check(&spec()).unwrap_err();
            assert!(!refused.contains('\n') && !refused.ends_with('.'), "{refused}");
            refused
        };
        assert!(with(|it| it.signals[0].source = SignalSource::Observation(2)).contains("observation of 2 numbers"));
        assert!(with(|it| it.signals[2].source = SignalSource::Action(1)).contains("action of 1 numbers"));
        assert!(with(|it| it.signals[1].source = SignalSource::Angle { cos: 5, sin: 0 }).contains("number 5"));
        assert!(with(|it| it.signals[1].key = "position".into()).contains("two signals"));
        assert!(with(|it| it.signals[1].key = "reward".into()).contains("reserved"));
        assert!(with(|it| it.signals[1].key.clear()).contains("name it"));
        assert!(with(|it| it.signals[1].label = "a\nb".into()).contains("one line"));
        assert!(with(|it| it.signals[1].unit = "m".repeat(81)).contains("at most 80"));
        assert!(with(|it| drop(it.signals.pop())).contains("needs a signal with the key `push`"));
        assert!(with(|it| it.time_step = Some(0.0)).contains("time step"));
        assert!(with(|it| it.goal.as_mut().unwrap().within = -1.0).contains("its goal"));
        assert!(with(|it| it.signals = vec![it.signals[0].clone(); 65]).contains("65 signals"));
        let rod = |it: &mut Description| {
            it.picture = Picture::Rod;
            it.signals[2] = Signal::observation(1, "torque", "N m");
        };
        assert!(with(rod).contains("finite bounds of `torque`"));
    }
}
