//! A harness for suites in which some tests need something that a machine may lack, such as Python or root. The
//! standard harness cannot ignore a test at run time; this one can, and prints the reason.
//!
//! Such a suite has `harness = false` in `Cargo.toml`, and its `main` lists its tests. A test that is not listed is
//! dead code, and the compiler warns. A filter, `--list`, `--ignored`, `--exact`, `--skip` and `--test-threads` work as
//! usual. Output is not captured, and at most one filter is possible.

#![allow(dead_code, reason = "every suite uses a different part of this file")]

use std::process::{Command, ExitCode};
use std::sync::OnceLock;

use libtest_mimic::{Arguments, Completion, Trial};

/// Something that a test needs and that a machine may lack.
pub(crate) struct Need {
    missing: &'static str,
    look: fn() -> bool,
    required_by: Option<&'static str>,
    found: OnceLock<bool>,
}

/// The result of a test that does not fail.
pub(crate) trait Done {
    fn done(self) -> Completion;
}

/// Gymnasium's environments, served by `python3`.
pub(crate) static PYTHON: Need = Need::new(
    "python3 has no shoal_gym or shoal: pip install ./python",
    || succeeds(Command::new("python3").args(["-c", "import shoal_gym.server, shoal"])),
    Some("SHOAL_REQUIRE_PYTHON"),
);

/// The right to run as two users.
pub(crate) static ROOT: Need = Need::new(
    "only root can run as two users",
    || rustix::process::getuid().is_root(),
    None,
);

impl Need {
    /// `look` returns whether the machine has it; `missing` is the reason printed otherwise. If the environment
    /// variable `required_by` is set, a missing one is a failure.
    pub(crate) const fn new(missing: &'static str, look: fn() -> bool, required_by: Option<&'static str>) -> Self {
        Self {
            missing,
            look,
            required_by,
            found: OnceLock::new(),
        }
    }

    /// The reason if this machine lacks it, otherwise `None`. The machine is examined once.
    ///
    /// # Panics
    /// If it is missing and required.
    pub(crate) fn missing(&self) -> Option<&'static str> {
        if *self.found.get_or_init(self.look) {
            return None;
        }
        if let Some(variable) = self.required_by {
            assert!(
                std::env::var_os(variable).is_none(),
                "{variable} is set, and {}",
                self.missing
            );
        }
        Some(self.missing)
    }
}

impl Done for () {
    fn done(self) -> Completion {
        Completion::Completed
    }
}

impl Done for Completion {
    fn done(self) -> Completion {
        self
    }
}

/// A test from its function and its needs.
macro_rules! test {
    ($test:ident $(, $need:expr)*) => {
        $crate::suite::trial(stringify!($test), vec![$(&$need),*], $test)
    };
}
pub(crate) use test;

/// A test that is ignored if one of its needs is missing.
pub(crate) fn trial<D: Done + 'static>(name: &str, needs: Vec<&'static Need>, test: fn() -> D) -> Trial {
    Trial::ignorable_test(name, move || {
        Ok(match needs.iter().find_map(|need| need.missing()) {
            Some(missing) => Completion::ignored_with(missing),
            None => test().done(),
        })
    })
}

/// Runs the tests that the command line selects.
pub(crate) fn run(tests: Vec<Trial>) -> ExitCode {
    let mut arguments = Arguments::from_args();
    // The standard harness reads this variable too.
    let threads = std::env::var("RUST_TEST_THREADS").ok();
    let threads = threads.map(|threads| threads.parse().unwrap());
    arguments.test_threads = arguments.test_threads.or(threads);
    libtest_mimic::run(&arguments, tests).exit_code()
}

fn succeeds(command: &mut Command) -> bool {
    command.output().is_ok_and(|output| output.status.success())
}
