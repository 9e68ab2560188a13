//! A CSV file of rows of one type, opened for appending.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;
use shoal_common::durable::write_atomically;
use shoal_common::message::one_line;

/// Why a record was not written or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The system refused to write.
    #[error("cannot write {path}: {cause}; free some space or check the permissions of the directory")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: io::Error,
    },
    /// The system refused to read.
    #[error("cannot read {path}: {cause}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: io::Error,
    },
    /// The file is not such a table.
    #[error("{path} is not a record of this program: {reason}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// More bytes than `csv::Writer` passes on at once.
const BUFFER: usize = 1 << 16;

/// A table open for appending.
#[derive(Debug)]
pub(super) struct Table {
    path: PathBuf,
    // After a failed write, `csv::Writer` repeats its whole buffer, even if a part of it is in the file already, as on a
    // full disk. `BufWriter` continues where the write ended.
    rows: csv::Writer<BufWriter<File>>,
}

impl Table {
    /// Opens the table at `path`, or creates it with its header. Removes a last line that a crash cut short. A table of
    /// an earlier version may lack columns that `Row` declares with `#[serde(default)]`: they are added, with the values
    /// of `Row::default()`. A file with any other header is refused and left unchanged.
    pub(super) fn open<Row: Serialize + DeserializeOwned + Default>(path: &Path) -> Result<Self, RecordError> {
        let write = |cause| RecordError::Write {
            path: path.to_owned(),
            cause,
        };
        let open = || {
            let mut options = OpenOptions::new();
            options.read(true).write(true).create(true).truncate(false);
            options.open(path).map_err(write)
        };
        let mut file = open()?;
        let default = default_table::<Row>(path)?;
        let header = default.iter().position(|byte| *byte == b'\n').map_or(0, |end| end + 1);
        let expected = &default[..header];
        let mut end = whole_lines(&file).map_err(write)?;
        let mut found = first_line(&file, expected.len()).map_err(write)?;
        if end > 0 && found != expected && add_columns::<Row>(path, &file, end, &default)? {
            file = open()?;
            end = whole_lines(&file).map_err(write)?;
            found = first_line(&file, expected.len()).map_err(write)?;
        }
        if (end > 0 && found != expected) || !expected.starts_with(&found) {
            let [found, expected] = [&found, expected].map(|line| String::from_utf8_lossy(line).trim_end().to_owned());
            let reason = format!("its first line is {found:?}, not {expected:?}");
            return Err(RecordError::Malformed {
                path: path.to_owned(),
                reason,
            });
        }
        file.set_len(end)
            .and_then(|()| file.seek(SeekFrom::End(0)))
            .map_err(write)?;
        if end == 0 {
            file.write_all(expected).map_err(write)?;
        }
        Ok(Self::onto(path, file))
    }

    /// Appends to a file that has its header.
    pub(super) fn onto(path: &Path, file: File) -> Self {
        let rows = csv::WriterBuilder::new()
            .has_headers(false)
            .from_writer(BufWriter::with_capacity(BUFFER, file));
        Self {
            path: path.to_owned(),
            rows,
        }
    }

    pub(super) fn write(&mut self, row: &impl Serialize) -> Result<(), RecordError> {
        self.rows
            .serialize(row)
            .map_err(|error| record_error(&self.path, error))?;
        Ok(())
    }

    pub(super) fn flush(&mut self) -> Result<(), RecordError> {
        self.rows.flush().map_err(|cause| RecordError::Write {
            path: self.path.clone(),
            cause,
        })
    }
}

/// Reads the table at `path` row by row: it may be larger than the memory. There are no rows if there is no file. A last
/// line without a newline does not count.
pub(super) fn for_each_row<Row: DeserializeOwned>(path: &Path, mut take: impl FnMut(Row)) -> Result<(), RecordError> {
    let read = |cause| RecordError::Read {
        path: path.to_owned(),
        cause,
    };
    let mut file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        file => file.map_err(read)?,
    };
    let end = whole_lines(&file)
        .and_then(|end| file.rewind().map(|()| end))
        .map_err(read)?;
    let rows = csv::Reader::from_reader(BufReader::with_capacity(BUFFER, file.take(end)));
    for row in rows.into_deserialize() {
        take(row.map_err(|error| match error.is_io_error() {
            true => read(io::Error::other(error)),
            false => malformed(path, &error),
        })?);
    }
    Ok(())
}

/// All rows of the table at `path`, as [`for_each_row`] reads them.
pub(super) fn rows<Row: DeserializeOwned>(path: &Path) -> Result<Vec<Row>, RecordError> {
    let mut rows = Vec::new();
    for_each_row(path, |row| rows.push(row))?;
    Ok(rows)
}

/// The last row of the table at `path`.
pub(super) fn last<Row: DeserializeOwned>(path: &Path) -> Result<Option<Row>, RecordError> {
    let mut last = None;
    for_each_row(path, |row| last = Some(row))?;
    Ok(last)
}

/// The length in bytes of the complete lines.
fn whole_lines(file: &File) -> io::Result<u64> {
    let (mut end, mut line) = (0, Vec::new());
    let mut reader = BufReader::with_capacity(1 << 16, file);
    loop {
        line.clear();
        let read = reader.read_until(b'\n', &mut line)?;
        if line.last() != Some(&b'\n') {
            return Ok(end);
        }
        end += read as u64;
    }
}

/// The first line with its newline, but at most `length` + 1 bytes of it.
fn first_line(mut file: &File, length: usize) -> io::Result<Vec<u8>> {
    let mut line = Vec::new();
    file.rewind()?;
    BufReader::new(file.take(length as u64 + 1)).read_until(b'\n', &mut line)?;
    Ok(line)
}

/// A table of one default row.
fn default_table<Row: Serialize + Default>(path: &Path) -> Result<Vec<u8>, RecordError> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer
        .serialize(Row::default())
        .map_err(|error| malformed(path, &error))?;
    Ok(writer.into_inner().unwrap_or_default())
}

/// Adds the columns that a table of an earlier version lacks, with the values of `default`, a table of one row. Returns
/// false, and changes nothing, if the table is of no earlier version. Only its first `end` bytes count.
fn add_columns<Row: DeserializeOwned>(
    path: &Path,
    mut file: &File,
    end: u64,
    default: &[u8],
) -> Result<bool, RecordError> {
    let write = |cause| RecordError::Write {
        path: path.to_owned(),
        cause,
    };
    let damaged = |error: csv::Error| malformed(path, &error);
    file.rewind().map_err(write)?;
    let mut old = csv::Reader::from_reader(BufReader::new(file.take(end)));
    let mut default = csv::Reader::from_reader(default);
    let names = default.byte_headers().map_err(damaged)?.clone();
    let mut value = csv::ByteRecord::new();
    default.read_byte_record(&mut value).map_err(damaged)?;
    let old_names = old.byte_headers().map_err(damaged)?.clone();
    let places: Vec<Option<usize>> = names
        .iter()
        .map(|name| old_names.iter().position(|old| old == name))
        .collect();
    let in_old = |of: &csv::ByteRecord| -> csv::ByteRecord {
        let columns = of.iter().zip(&places).filter(|(_, place)| place.is_some());
        columns.map(|(field, _)| field).collect()
    };
    let has_no_others = in_old(&names).len() == old_names.len();
    if !has_no_others || in_old(&value).deserialize::<Row>(Some(&in_old(&names))).is_err() {
        return Ok(false);
    }
    let rewritten = write_atomically(path, |file| {
        let mut new = csv::Writer::from_writer(file);
        new.write_byte_record(&names)?;
        for row in old.byte_records() {
            let row = row?;
            let fields = places.iter().zip(&value).map(|(place, value)| match place {
                Some(place) => row.get(*place).unwrap_or_default(),
                None => value,
            });
            new.write_record(fields)?;
        }
        new.flush()?;
        Ok::<_, csv::Error>(())
    });
    rewritten.map_err(|error| record_error(path, error))?;
    Ok(true)
}

fn record_error(path: &Path, error: csv::Error) -> RecordError {
    match error.into_kind() {
        csv::ErrorKind::Io(cause) => RecordError::Write {
            path: path.to_owned(),
            cause,
        },
        kind => RecordError::Malformed {
            path: path.to_owned(),
            reason: format!("{kind:?}"),
        },
    }
}

fn malformed(path: &Path, error: &csv::Error) -> RecordError {
    RecordError::Malformed {
        path: path.to_owned(),
        reason: one_line(error),
    }
}
