//! TensorBoard event files: scalars, and the settings of the run for its tab HParams. Written here because the crates
//! that do this need `protoc` or depend on outdated image crates.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use prost::Message;

/// The part of TensorFlow's `event.proto` that scalars need.
#[derive(Clone, PartialEq, Message)]
struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
    #[prost(message, optional, tag = "7")]
    session_log: Option<SessionLog>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    #[prost(int32, tag = "1")]
    status: i32,
}

/// `SessionLog.START`: what was recorded at this step or later is not valid.
const START: i32 = 1;

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    /// Optional, because a plain zero would not be written.
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
    #[prost(message, optional, tag = "9")]
    metadata: Option<Metadata>,
}

/// `SummaryMetadata`: data of a plugin.
#[derive(Clone, PartialEq, Message)]
struct Metadata {
    #[prost(message, optional, tag = "1")]
    plugin_data: Option<PluginData>,
}

#[derive(Clone, PartialEq, Message)]
struct PluginData {
    #[prost(string, tag = "1")]
    plugin_name: String,
    #[prost(bytes = "vec", tag = "2")]
    content: Vec<u8>,
}

/// `HParamsPluginData` of `plugins/hparams/plugin_data.proto`, as far as it is used here.
#[derive(Clone, PartialEq, Message)]
struct HyperparameterData {
    #[prost(message, optional, tag = "3")]
    session_start: Option<SessionStart>,
    #[prost(message, optional, tag = "4")]
    session_end: Option<SessionEnd>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionStart {
    #[prost(btree_map = "string, message", tag = "1")]
    hyperparameters: BTreeMap<String, Setting>,
    /// Seconds since 1970.
    #[prost(double, tag = "5")]
    start_time: f64,
}

#[derive(Clone, PartialEq, Message)]
struct SessionEnd {
    #[prost(int32, tag = "1")]
    status: i32,
    /// Seconds since 1970.
    #[prost(double, tag = "2")]
    end_time: f64,
}

/// `Status.STATUS_SUCCESS`.
const SUCCESS: i32 = 1;

/// `google.protobuf.Value`.
#[derive(Clone, PartialEq, Message)]
struct Setting {
    #[prost(oneof = "SettingKind", tags = "2, 3, 4")]
    kind: Option<SettingKind>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
enum SettingKind {
    #[prost(double, tag = "2")]
    Number(f64),
    #[prost(string, tag = "3")]
    Text(String),
    #[prost(bool, tag = "4")]
    Truth(bool),
}

impl Setting {
    /// A value as `--set` takes it.
    fn read(text: &str) -> Self {
        let kind = match (text.parse::<bool>(), text.parse::<f64>()) {
            (Ok(truth), _) => SettingKind::Truth(truth),
            (_, Ok(number)) => SettingKind::Number(number),
            _ => SettingKind::Text(text.into()),
        };
        Self { kind: Some(kind) }
    }
}

fn now() -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.unwrap_or_default().as_secs_f64()
}

/// An event file of this process.
#[derive(Debug)]
pub(crate) struct EventFile {
    file: BufWriter<File>,
}

impl EventFile {
    /// Creates a new file in `directory`, and the directory if necessary. TensorBoard reads all files there as one run.
    /// The file of a resumed run begins at step `first_step`. TensorBoard then hides this step and later ones in
    /// earlier files; the run's tables do not have them either.
    pub(crate) fn create(directory: &Path, first_step: Option<u64>) -> io::Result<Self> {
        std::fs::create_dir_all(directory)?;
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        // TensorBoard reads the files in the order of their names.
        let name = format!(
            "events.out.tfevents.{:010}.{:09}.{}",
            now.as_secs(),
            now.subsec_nanos(),
            std::process::id()
        );
        let mut events = Self {
            file: BufWriter::new(File::create_new(directory.join(name))?),
        };
        events.write(&Event {
            file_version: Some("brain.Event:2".into()),
            ..Event::default()
        })?;
        if let Some(step) = first_step {
            events.write(&Event {
                step: step as i64,
                session_log: Some(SessionLog { status: START }),
                ..Event::default()
            })?;
        }
        Ok(events)
    }

    /// Writes the value of each tag at an environment step. Values that are not finite are left out.
    pub(crate) fn scalars(&mut self, step: u64, scalars: &[(&str, f64)]) -> io::Result<()> {
        let finite = scalars.iter().filter(|(_, value)| value.is_finite());
        let value = finite.map(|(tag, value)| Value {
            tag: (*tag).into(),
            simple_value: Some(*value as f32),
            metadata: None,
        });
        let summary = Some(Summary { value: value.collect() });
        self.write(&Event {
            step: step as i64,
            summary,
            ..Event::default()
        })
    }

    /// Writes the settings of the run: values as `--set` takes them, by key.
    pub(crate) fn hyperparameters(&mut self, settings: &BTreeMap<String, String>) -> io::Result<()> {
        let settings = settings.iter().map(|(key, value)| (key.clone(), Setting::read(value)));
        self.plugin(
            "_hparams_/session_start_info",
            &HyperparameterData {
                session_start: Some(SessionStart {
                    hyperparameters: settings.collect(),
                    start_time: now(),
                }),
                session_end: None,
            },
        )
    }

    /// Writes that the run with these settings is finished.
    pub(crate) fn finished(&mut self) -> io::Result<()> {
        self.plugin(
            "_hparams_/session_end_info",
            &HyperparameterData {
                session_start: None,
                session_end: Some(SessionEnd {
                    status: SUCCESS,
                    end_time: now(),
                }),
            },
        )
    }

    fn plugin(&mut self, tag: &str, data: &HyperparameterData) -> io::Result<()> {
        let plugin_data = Some(PluginData {
            plugin_name: "hparams".into(),
            content: data.encode_to_vec(),
        });
        let value = Value {
            tag: tag.into(),
            simple_value: None,
            metadata: Some(Metadata { plugin_data }),
        };
        self.write(&Event {
            summary: Some(Summary { value: vec![value] }),
            ..Event::default()
        })
    }

    /// Hands the buffered bytes to the kernel.
    pub(crate) fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }

    fn write(&mut self, event: &Event) -> io::Result<()> {
        let data = Event {
            wall_time: now(),
            ..event.clone()
        }
        .encode_to_vec();
        let length = (data.len() as u64).to_le_bytes();
        // One write, so that the buffer holds only whole records.
        let parts = [
            &length[..],
            &masked_crc(&length).to_le_bytes(),
            &data,
            &masked_crc(&data).to_le_bytes(),
        ];
        self.file.write_all(&parts.concat())
    }
}

/// The checksum of TensorFlow's record files: CRC-32C, masked because a CRC of data that contains CRCs is weak.
fn masked_crc(data: &[u8]) -> u32 {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_back(directory: &Path) -> Vec<Event> {
        let file = std::fs::read_dir(directory).unwrap().next().unwrap().unwrap().path();
        let bytes = std::fs::read(file).unwrap();
        let mut rest = &bytes[..];
        let mut events = Vec::new();
        let mut take = |n: usize| {
            let (taken, left) = rest.split_at(n);
            rest = left;
            (taken, left.is_empty())
        };
        loop {
            let (length, _) = take(8);
            assert_eq!(take(4).0, masked_crc(length).to_le_bytes(), "checksum of the length");
            let (data, _) = take(u64::from_le_bytes(length.try_into().unwrap()) as usize);
            let (crc, end) = take(4);
            assert_eq!(crc, masked_crc(data).to_le_bytes(), "checksum of the data");
            events.push(Event::decode(data).unwrap());
            if end {
                return events;
            }
        }
    }

    #[test]
    fn scalars_are_read_back_with_valid_checksums() {
        let dir = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(&dir.path().join("tensorboard"), None).unwrap();
        events.scalars(0, &[("episode/return", 0.0)]).unwrap();
        let loss = [
            ("learner/critic_loss", 1.5),
            ("learner/actor_loss", f64::NAN),
            ("learner/ratio", 1.0),
        ];
        events.scalars(120_000, &loss).unwrap();
        events.flush().unwrap();

        let events = read_back(&dir.path().join("tensorboard"));
        assert_eq!(events.len(), 3);
        assert_eq!(events[0].file_version.as_deref(), Some("brain.Event:2"));
        let values = |event: &Event| {
            let values = event.summary.clone().unwrap().value;
            values
                .into_iter()
                .map(|v| (v.tag, v.simple_value.unwrap()))
                .collect::<Vec<_>>()
        };
        assert_eq!(
            values(&events[1]),
            [("episode/return".into(), 0.0)],
            "a zero is written"
        );
        assert_eq!(events[2].step, 120_000);
        assert_eq!(
            values(&events[2]),
            [("learner/critic_loss".into(), 1.5), ("learner/ratio".into(), 1.0)]
        );
        assert!(events.iter().all(|event| event.wall_time > 1.7e9));
    }

    #[test]
    fn settings_have_the_types_that_tensorboard_sorts_by() {
        let dir = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(dir.path(), None).unwrap();
        let settings = [
            ("ddpg.tau", "0.005"),
            ("ddpg.activation", "relu"),
            ("observation.normalise", "false"),
        ];
        let settings = settings.map(|(key, value)| (key.to_owned(), value.to_owned()));
        events.hyperparameters(&settings.into()).unwrap();
        events.finished().unwrap();
        events.flush().unwrap();
        let events = read_back(dir.path());
        let data = events[1..].iter().map(|event| {
            let value = event.summary.clone().unwrap().value.remove(0);
            let data = value.metadata.unwrap().plugin_data.unwrap();
            assert_eq!(data.plugin_name, "hparams");
            (value.tag, HyperparameterData::decode(&data.content[..]).unwrap())
        });
        let [(start, begun), (end, ended)] = data.collect::<Vec<_>>().try_into().unwrap();
        assert_eq!(
            [start, end],
            ["_hparams_/session_start_info", "_hparams_/session_end_info"]
        );
        assert_eq!(ended.session_end.unwrap().status, SUCCESS);
        let kinds = begun.session_start.unwrap().hyperparameters;
        let kinds: Vec<_> = kinds.into_values().map(|setting| setting.kind.unwrap()).collect();
        let expected = [
            SettingKind::Text("relu".into()),
            SettingKind::Number(0.005),
            SettingKind::Truth(false),
        ];
        assert_eq!(kinds, expected);
    }

    #[test]
    fn the_file_of_a_resumed_run_begins_with_a_start() {
        let dir = tempfile::tempdir().unwrap();
        drop(EventFile::create(dir.path(), Some(2_001)).unwrap());
        let bytes = std::fs::read(std::fs::read_dir(dir.path()).unwrap().next().unwrap().unwrap().path()).unwrap();
        let events = read_back(dir.path());
        assert_eq!(events.len(), 2);
        assert_eq!(
            (events[1].step, events[1].session_log.clone()),
            (2_001, Some(SessionLog { status: START }))
        );
        // As protoc encodes `session_log { status: START }`: field 7 with two bytes, field 1 with 1.
        assert!(bytes.windows(4).any(|bytes| bytes == [0x3a, 2, 0x08, 1]));
    }

    #[test]
    fn the_checksum_is_that_of_tensorflow() {
        // CRC-32C of "123456789" is 0xe3069283 (RFC 3720's polynomial); masked as in tsl/lib/hash/crc32c.h.
        assert_eq!(crc32c::crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(masked_crc(b"123456789"), 0xc78a_b0e5);
    }

    #[test]
    fn every_launcher_writes_its_own_file() {
        let dir = tempfile::tempdir().unwrap();
        for _ in 0..3 {
            EventFile::create(dir.path(), None).unwrap();
        }
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 3);
    }
}
