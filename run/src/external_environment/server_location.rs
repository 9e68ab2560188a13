//! Where the environment server of a run is started, if it is another program: `server.json` in the run's directory,
//! written when the run is made. With it `eval`, `resume` and `report` start the program that `train` has started, from
//! any directory and with any `PATH`.

use std::ffi::OsString;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use shoal_common::config::{Config, Mode};
use shoal_common::run_dir::RunDir;
use shoal_common::versioned_file::VersionedFile;

/// A directory and a program, both absolute. Symbolic links are kept: Python finds its virtual environment by them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServerLocation {
    directory: PathText,
    program: PathText,
    /// The file that it was read from.
    #[serde(skip)]
    file: Option<PathBuf>,
}

/// A path in JSON: text, or a list of bytes if it is not UTF-8.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
enum PathText {
    Text(String),
    Bytes(Vec<u8>),
}

impl PathText {
    fn of(path: PathBuf) -> Self {
        match path.into_os_string().into_string() {
            Ok(text) => Self::Text(text),
            Err(other) => Self::Bytes(other.as_bytes().into()),
        }
    }

    fn path(&self) -> PathBuf {
        match self {
            Self::Text(text) => text.into(),
            Self::Bytes(bytes) => OsString::from_vec(bytes.clone()).into(),
        }
    }
}

impl VersionedFile for ServerLocation {
    const FORMAT: u32 = 1;
    const IF_DAMAGED: &'static str = "; without it the environment server is started from the current directory";
}

impl ServerLocation {
    /// The current directory, and the program of this command as a shell would find it. `None` for an empty command.
    ///
    /// # Errors
    /// When there is no such program.
    pub fn here(command: &[String]) -> anyhow::Result<Option<Self>> {
        let Some(program) = command.first() else {
            return Ok(None);
        };
        let directory = std::env::current_dir().context("cannot ask for the current directory")?;
        let path = std::env::var_os("PATH").unwrap_or_default();
        let Some(program) = found(Path::new(program), &directory, &path) else {
            bail!("cannot start the environment server {program}: there is no such file");
        };
        Ok(Some(Self {
            directory: PathText::of(directory),
            program: PathText::of(program),
            file: None,
        }))
    }

    /// The location of the run's server; `None` if the environment is built in, or the run is older than this file.
    ///
    /// # Errors
    /// When the file cannot be read, is damaged or has another format, or when the directory or the program no longer
    /// exists.
    pub fn of_run(run: &RunDir) -> anyhow::Result<Option<Self>> {
        let file = run.server_file();
        let Some(location) = Self::load_if_any(&file)? else {
            return Ok(None);
        };
        let location = Self {
            file: Some(file),
            ..location
        };
        location.check()?;
        Ok(Some(location))
    }

    /// Writes the file atomically.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, run: &RunDir) -> anyhow::Result<()> {
        Ok(self.store(&run.server_file())?)
    }

    /// The directory it is started in.
    pub fn directory(&self) -> PathBuf {
        self.directory.path()
    }

    /// The program.
    pub fn program(&self) -> PathBuf {
        self.program.path()
    }

    fn check(&self) -> anyhow::Result<()> {
        let (directory, program) = (self.directory(), self.program());
        let missing = if !directory.is_dir() {
            format!("the run was begun in the directory {}", directory.display())
        } else if !is_program(&program) {
            format!("the run was begun with the environment server {}", program.display())
        } else {
            return Ok(());
        };
        let file = self.file.as_deref().unwrap_or(Path::new("server.json")).display();
        bail!("{missing}, which is not there any more: put it back, or name another one in {file}")
    }
}

/// The absolute path of a program, without following links.
fn found(program: &Path, directory: &Path, path: &std::ffi::OsStr) -> Option<PathBuf> {
    if program.components().count() > 1 {
        // Whether it can be executed is shown when it is started.
        let absolute = directory.join(program);
        return absolute.is_file().then_some(absolute);
    }
    std::env::split_paths(path)
        .map(|place| directory.join(place).join(program))
        .find(|candidate| is_program(candidate))
}

fn is_program(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|metadata| metadata.is_file() && metadata.permissions().mode() & 0o111 != 0)
}

/// Where an environment server that is another program is started, and with which environment variables.
#[derive(Clone, Debug, Default)]
pub struct LaunchContext {
    /// Its directory and program. `None`: the current directory, and the program that `PATH` leads to.
    pub location: Option<ServerLocation>,
    /// The environment variable `PYTHONHASHSEED`, which decides the order of Python's sets. `None`: unchanged.
    pub hash_seed: Option<u32>,
    /// The greatest height in pixels of the pictures that it is asked for. `None`: it is asked for none.
    pub picture_height: Option<u32>,
}

impl LaunchContext {
    /// The launch context of a run's server.
    ///
    /// # Errors
    /// As for [`ServerLocation::of_run`].
    pub fn of_run(run: &RunDir, config: &Config) -> anyhow::Result<Self> {
        Ok(Self {
            location: ServerLocation::of_run(run)?,
            hash_seed: hash_seed(config.run.mode, config.run.seed),
            picture_height: None,
        })
    }
}

/// In lockstep the order of Python's sets follows from the run's seed.
pub fn hash_seed(mode: Mode, seed: u64) -> Option<u32> {
    // Python takes 32 of the seed's 64 bits.
    (mode == Mode::Lockstep).then_some(seed as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn program_in(directory: &Path, name: &str) -> PathBuf {
        let file = directory.join(name);
        std::fs::write(&file, "#!/bin/sh\n").unwrap();
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o755)).unwrap();
        file
    }

    #[test]
    fn a_program_is_found_in_path_and_links_are_kept() {
        let place = tempfile::tempdir().unwrap();
        let here = place.path();
        for directory in ["real", "venv", "plain"] {
            std::fs::create_dir(here.join(directory)).unwrap();
        }
        let real = program_in(&here.join("real"), "python3.12");
        std::os::unix::fs::symlink(real, here.join("venv/python3")).unwrap();
        std::fs::write(here.join("plain/python3"), "no program").unwrap();
        let path = std::env::join_paths([here.join("plain"), "venv".into(), here.join("real")]).unwrap();
        let search = |program: &str| found(Path::new(program), here, &path);
        assert_eq!(search("python3"), Some(here.join("venv/python3")));
        assert_eq!(search("./venv/python3"), Some(here.join("./venv/python3")));
        assert_eq!(search("python2"), None);
        assert_eq!(search("./python3"), None);
    }

    #[test]
    fn what_is_written_is_read_and_what_is_gone_is_named_in_one_line() {
        let place = tempfile::tempdir().unwrap();
        let run = RunDir::create(&place.path().join("run")).unwrap();
        assert_eq!(
            ServerLocation::of_run(&run).unwrap(),
            None,
            "a run of an earlier version"
        );
        for name in ["pläce", "other"]
            .map(OsString::from)
            .into_iter()
            .chain([OsString::from_vec(vec![b'x', 0xff])])
        {
            let directory = place.path().join(name);
            std::fs::create_dir(&directory).unwrap();
            let program = program_in(&directory, "serve");
            let location = ServerLocation {
                directory: PathText::of(directory.clone()),
                program: PathText::of(program.clone()),
                file: None,
            };
            location.write(&run).unwrap();
            let read = ServerLocation::of_run(&run).unwrap().unwrap();
            assert_eq!((read.directory(), read.program()), (directory.clone(), program.clone()));
            for (what, remove) in [(&program, true), (&directory, false)] {
                if remove {
                    std::fs::remove_file(what).unwrap();
                } else {
                    std::fs::remove_dir(what).unwrap();
                }
                let said = ServerLocation::of_run(&run).unwrap_err().to_string();
                assert!(said.contains(&what.display().to_string()), "{said}");
                assert!(said.contains("server.json") && !said.contains('\n'), "{said}");
            }
        }
        std::fs::write(run.server_file(), r#"{"format":2,"directory":"/","program":"/bin/sh"}"#).unwrap();
        let said = ServerLocation::of_run(&run).unwrap_err().to_string();
        assert!(said.contains("has format 2"), "{said}");
    }

    #[test]
    fn only_lockstep_orders_pythons_sets() {
        assert_eq!(hash_seed(Mode::Free, 7), None);
        assert_eq!(hash_seed(Mode::Lockstep, 7), Some(7));
        assert_eq!(hash_seed(Mode::Lockstep, (1 << 62) + 5), Some(5));
    }
}
