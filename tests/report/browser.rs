//! A page in headless Chromium, controlled by `--remote-debugging-pipe`: JSON messages of the DevTools protocol, each
//! ended by a zero byte. This needs no further crate and opens no port.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process_group};
use serde_json::{Value, json};

use crate::suite::Need;

/// Longest wait for a message of Chromium.
const TIMEOUT: Duration = Duration::from_secs(120);

const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "chrome"];

/// A Chromium in the search path.
pub(crate) static CHROMIUM: Need = Need::new(
    "found no Chromium",
    || program().is_some(),
    Some("SHOAL_REQUIRE_BROWSER"),
);

/// A browser with one page.
pub(crate) struct Browser {
    child: Child,
    to: ChildStdin,
    from: Receiver<Value>,
    sent: u64,
    session: Option<Value>,
    events: Vec<Value>,
    _profile: tempfile::TempDir,
}

/// The name of the Chromium that is in the search path.
fn program() -> Option<&'static str> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let is_there = |name: &&str| std::env::split_paths(&path).any(|directory| directory.join(name).is_file());
    NAMES.into_iter().find(is_there)
}

impl Browser {
    /// Starts Chromium. Panics if [`CHROMIUM`] is missing.
    pub(crate) fn start() -> Self {
        let name = program().unwrap();
        let profile = tempfile::tempdir().unwrap();
        // Chromium reads from descriptor 3 and writes to 4.
        let mut child = Command::new("sh")
            .args(["-c", "exec \"$@\" 3<&0 4>&1 </dev/null >/dev/null 2>&1", "sh", name])
            .args([
                "--remote-debugging-pipe",
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-dev-shm-usage",
            ])
            .args([
                "--no-first-run",
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-sync",
                "--hide-scrollbars",
            ])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg("about:blank")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .process_group(0)
            .spawn()
            .unwrap();
        let to = child.stdin.take().unwrap();
        let messages = BufReader::new(child.stdout.take().unwrap()).split(0);
        let (sender, from) = channel();
        std::thread::spawn(move || {
            for message in messages.map_while(Result::ok) {
                if sender.send(serde_json::from_slice(&message).unwrap()).is_err() {
                    break;
                }
            }
        });
        let mut browser = Self {
            child,
            to,
            from,
            sent: 0,
            session: None,
            events: Vec::new(),
            _profile: profile,
        };
        let target = browser.call("Target.createTarget", json!({ "url": "about:blank" }))["targetId"].clone();
        let attached = browser.call("Target.attachToTarget", json!({ "targetId": target, "flatten": true }));
        browser.session = Some(attached["sessionId"].clone());
        for domain in ["Page", "Network", "Runtime", "Log"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        browser
    }

    /// Loads a file in a window of the given width.
    pub(crate) fn open(&mut self, page: &Path, width: u32, dark: bool) {
        let size = json!({ "width": width, "height": 800, "deviceScaleFactor": 1, "mobile": false });
        self.call("Emulation.setDeviceMetricsOverride", size);
        let scheme = json!({ "name": "prefers-color-scheme", "value": if dark { "dark" } else { "light" } });
        self.call("Emulation.setEmulatedMedia", json!({ "features": [scheme] }));
        self.events.clear();
        self.call("Page.navigate", json!({ "url": format!("file://{}", page.display()) }));
        while self.events_called("Page.loadEventFired").next().is_none() {
            let event = self.receive();
            self.events.push(event);
        }
    }

    /// Evaluates a JavaScript expression in the page and awaits its value.
    pub(crate) fn value(&mut self, expression: &str) -> Value {
        let request = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let answer = self.call("Runtime.evaluate", request);
        assert_eq!(answer["exceptionDetails"], Value::Null, "{expression}");
        answer["result"]["value"].clone()
    }

    /// Presses a key in the focused element.
    pub(crate) fn key(&mut self, key: &str) {
        let code = match key {
            " " => 32,
            "End" => 35,
            "Home" => 36,
            "ArrowLeft" => 37,
            "ArrowRight" => 39,
            "ArrowDown" => 40,
            "Escape" => 27,
            "Tab" => 9,
            other => panic!("no code for {other:?}"),
        };
        let text = if key == " " { key } else { "" };
        let event =
            |kind| json!({ "type": kind, "key": key, "code": key, "windowsVirtualKeyCode": code, "text": text });
        self.call("Input.dispatchKeyEvent", event("keyDown"));
        self.call(
            "Input.dispatchKeyEvent",
            json!({ "type": "keyUp", "key": key, "windowsVirtualKeyCode": code }),
        );
    }

    /// Clicks into an element, at the fraction `share` of its width.
    pub(crate) fn click(&mut self, selector: &str, share: f64) {
        // The page may still be moving: layout and scrolling take some frames on a busy machine.
        let place = self.value(&format!(
            "(async () => {{ const e = document.querySelector({selector:?}); e.scrollIntoView({{ block: 'center', behavior: 'instant' }}); \
             const frames = () => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))); \
             let before, b; \
             do {{ before = b; await frames(); b = e.getBoundingClientRect(); }} while (!before || b.top !== before.top || b.left !== before.left); \
             return [b.left + {share} * b.width, b.top + b.height / 2]; }})()"
        ));
        for kind in ["mousePressed", "mouseReleased"] {
            let event =
                json!({ "type": kind, "x": place[0], "y": place[1], "button": "left", "buttons": 1, "clickCount": 1 });
            self.call("Input.dispatchMouseEvent", event);
        }
    }

    /// Exceptions, errors and warnings of the page since it was opened.
    pub(crate) fn problems(&mut self) -> Vec<String> {
        // Events precede this answer, so all of them are received.
        self.value("0");
        let kinds = ["Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"];
        let events = self.events.iter();
        events
            .filter(|event| kinds.iter().any(|kind| event["method"] == *kind))
            .map(|event| event["params"].to_string())
            .collect()
    }

    /// URLs that the page has requested since it was opened, including its own.
    pub(crate) fn requests(&self) -> Vec<String> {
        let sent = self.events_called("Network.requestWillBeSent");
        let url = |event: &Value| event["params"]["request"]["url"].as_str().unwrap().to_owned();
        sent.map(url).filter(|url| !url.starts_with("data:")).collect()
    }

    fn events_called(&self, method: &str) -> impl Iterator<Item = &Value> {
        self.events.iter().filter(move |event| event["method"] == method)
    }

    fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.sent += 1;
        let mut message = json!({ "id": self.sent, "method": method, "params": parameters });
        if let Some(session) = &self.session {
            message["sessionId"] = session.clone();
        }
        self.to.write_all(format!("{message}\0").as_bytes()).unwrap();
        loop {
            let mut message = self.receive();
            if message["id"] == self.sent {
                assert_eq!(message["error"], Value::Null, "{method}");
                return message["result"].take();
            }
            self.events.push(message);
        }
    }

    fn receive(&self) -> Value {
        self.from
            .recv_timeout(TIMEOUT)
            .unwrap_or_else(|_| panic!("Chromium has ended or hangs"))
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // Its process group contains all of its processes.
        let _ = kill_process_group(Pid::from_child(&self.child), Signal::KILL);
        let _ = self.child.wait();
    }
}
