//! Films as MP4, by the program `ffmpeg`.

use std::fs::File;
use std::io::{Read, Write};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use shoal_env_server::frame::Image;
use shoal_run::signals::{self, Interrupt};
use tempfile::TempDir;

use super::failure::FilmFailure;

/// The program's name.
const PROGRAM: &str = "ffmpeg";
/// How long it may take for a picture, and to end after the last one.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Checks that the program is there.
///
/// # Errors
/// When it is not in `PATH`.
pub(super) fn check() -> anyhow::Result<()> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    if std::env::split_paths(&path).any(|directory| directory.join(PROGRAM).is_file()) {
        return Ok(());
    }
    bail!("an .mp4 film needs the program {PROGRAM}, which is not in PATH: install it, or name a .gif file with --out")
}

/// A running `ffmpeg`. It is ended on drop.
pub(super) struct Ffmpeg {
    child: Child,
    /// Goes to the thread that writes to the program, so that a program that reads nothing does not block this thread.
    pictures: Option<SyncSender<Vec<u8>>>,
    directory: TempDir,
}

impl Ffmpeg {
    /// Starts it for pictures of this size, `fps` of them in a second.
    pub(super) fn start((width, height): (usize, usize), fps: f64) -> anyhow::Result<Self> {
        let directory = tempfile::tempdir().context("cannot make a temporary directory")?;
        let stderr = File::create(directory.path().join("stderr")).context("cannot write a temporary file")?;
        let mut child = Command::new(PROGRAM)
            .args(["-nostdin", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"])
            .args(["-s", &format!("{width}x{height}"), "-framerate", &format!("{fps:.6}")])
            // The usual players need even sides and these colours.
            .args([
                "-i",
                "pipe:0",
                "-vf",
                "pad=ceil(iw/2)*2:ceil(ih/2)*2",
                "-pix_fmt",
                "yuv420p",
            ])
            .args(["-movflags", "+faststart", "-f", "mp4"])
            .arg(directory.path().join("film"))
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(stderr)
            // Ctrl-C reaches only this process, which then ends ffmpeg.
            .process_group(0)
            .spawn()
            .context("cannot start ffmpeg")?;
        let stdin = child.stdin.take();
        let (pictures, receiver) = sync_channel::<Vec<u8>>(2);
        std::thread::Builder::new().name("film".into()).spawn(move || {
            let Some(mut stdin) = stdin else { return };
            // After a failed write the channel closes.
            while let Ok(bytes) = receiver.recv()
                && stdin.write_all(&bytes).is_ok()
            {}
        })?;
        let pictures = Some(pictures);
        Ok(Self {
            child,
            pictures,
            directory,
        })
    }

    /// Adds a picture.
    pub(super) fn add(&mut self, image: &Image, interrupt: &Interrupt) -> anyhow::Result<()> {
        let Some(pictures) = &self.pictures else {
            return Err(self.failure());
        };
        let since = Instant::now();
        let mut bytes = image.rgb.clone();
        loop {
            bytes = match pictures.try_send(bytes) {
                Ok(()) => return Ok(()),
                Err(TrySendError::Full(bytes)) => bytes,
                Err(TrySendError::Disconnected(_)) => return Err(self.failure()),
            };
            pause(since, interrupt)?;
        }
    }

    /// Waits for the film and copies it.
    pub(super) fn finish(mut self, to: &mut impl Write, interrupt: &Interrupt) -> Result<(), FilmFailure> {
        drop(self.pictures.take());
        let since = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().context("cannot wait for ffmpeg")? {
                break status;
            }
            pause(since, interrupt)?;
        };
        if !status.success() {
            return Err(self.failure().into());
        }
        let mut film = File::open(self.film()).context("ffmpeg wrote no film")?;
        std::io::copy(&mut film, to)?;
        Ok(())
    }

    fn film(&self) -> PathBuf {
        self.directory.path().join("film")
    }

    /// Ends ffmpeg. Returns an error with the last line that it wrote.
    fn failure(&mut self) -> anyhow::Error {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let mut stderr = Vec::new();
        let written = File::open(self.directory.path().join("stderr"));
        let _ = written.and_then(|file| file.take(1 << 16).read_to_end(&mut stderr));
        let stderr = String::from_utf8_lossy(&stderr);
        let last = stderr
            .lines()
            .rfind(|line| !line.trim().is_empty())
            .unwrap_or("it ended without a message");
        anyhow::anyhow!("ffmpeg failed: {}", last.trim())
    }
}

/// Sleeps briefly. Returns an error if a signal has arrived, or if [`TIMEOUT`] has passed since `since`.
fn pause(since: Instant, interrupt: &Interrupt) -> anyhow::Result<()> {
    if let Some(signal) = interrupt.signal() {
        bail!("ended by {}", signals::describe(signal));
    }
    if since.elapsed() > TIMEOUT {
        bail!(
            "ffmpeg has made no progress for {} s: try again, or name a .gif file with --out",
            TIMEOUT.as_secs()
        );
    }
    std::thread::sleep(Duration::from_millis(5));
    Ok(())
}

impl Drop for Ffmpeg {
    fn drop(&mut self) {
        // Neither matters if it has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
