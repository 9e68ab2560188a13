/* Plays episodes: a picture with a slider, and the signals beside it. */

const SPEEDS = [0.25, 0.5, 1, 2, 4];
/** Seconds per frame if a step of the environment has no duration. */
const SECONDS_PER_FRAME = 0.5;
/** Elements in which the space key has another meaning. */
const TAKES_SPACE = "input, select, textarea, button, summary, [contenteditable]";

class Player {
  constructor(runs) {
    this.runs = runs;
    this.stage = html("div", { class: "stage" });
    this.signals = html("div", { class: "signals" });
    this.policy = html("p", { class: "aside" });
    this.time = html("output", { class: "time" });
    this.play = html("button", { type: "button", class: "play", onclick: () => this.toggle() }, "");
    const step = (sign, by, name) => html("button", { type: "button", "aria-label": name, title: name, onclick: () => this.step(by) }, sign);
    this.slider = html("input", { type: "range", min: 0, step: 1, "aria-label": "Step of the episode", oninput: () => this.go(Number(this.slider.value)) });
    this.speed = 1;
    this.episodes = html("span", {});
    this.element = html(
      "div",
      { class: "player", tabindex: 0, role: "group", "aria-label": "Player: space plays and pauses, arrows step, Home and End jump", onkeydown: (event) => this.key(event) },
      html(
        "div",
        { class: "choices" },
        runs.length > 1 ? choice("Run", runs.map((run, i) => [i, run.name]), 0, (i) => this.load(this.runs[i], 0)) : null,
        this.episodes,
        choice("Speed", SPEEDS.map((speed) => [speed, `${speed}×`]), 1, (speed) => (this.speed = speed)),
      ),
      html(
        "div",
        { class: "show" },
        html("div", { class: "watch" }, this.stage, html("div", { class: "controls" }, step("|◀", -1, "one step back"), this.play, step("▶|", 1, "one step forward"), this.slider), this.time),
        this.signals,
      ),
      this.policy,
      html("p", { class: "aside" }, "Space plays and pauses, from anywhere on the page. In the player, the arrow keys step, and Home and End jump. Click a signal's line to jump to that step."),
    );
    document.addEventListener("keydown", (event) => this.keyOfPage(event));
    this.load(runs[0], 0);
  }

  load(run, number) {
    this.pause();
    this.run = run;
    const { played } = run;
    const { picture } = played;
    this.episode = played.episodes[number];
    this.frames = this.episode.signals[0].values.length;
    this.dt = played.time_step;
    const option = (episode, i) => [i, `${episode.number + 1}: return ${text(episode.return)}, ${plural(episode.steps, "step")}${episode.terminated ? ", terminated" : ""}`];
    this.episodes.replaceChildren(choice("Episode", played.episodes.map(option), number, (i) => this.load(run, i)));
    const byKey = Object.fromEntries(this.episode.signals.map((signal) => [signal.key, signal]));
    const own = this.episode.pictures !== null;
    const { element, draw } = own ? ownScene(this.episode) : SCENES[picture.kind](picture, byKey, played);
    this.drawScene = draw;
    this.stage.replaceChildren(element);
    this.element.classList.toggle("without-picture", !own && picture.kind === "none");
    this.cursors = this.episode.signals.map((signal) => this.strip(signal));
    this.policy.textContent = `${run.name}: ${played.policy}, without exploration, from the start states of the evaluations.`;
    set(this.slider, { max: this.frames - 1 });
    this.go(0);
  }

  /** A signal's line, its current value, and a line at the current frame. */
  strip(signal) {
    const range = rangeOf(signal.values, 0.08);
    const across = scale([0, Math.max(1, this.frames - 1)], [0, 1000]);
    const up = scale(range, [60, 0]);
    let path = "";
    let pen = "M";
    signal.values.forEach((value, i) => {
      if (!isNumber(value)) return (pen = "M");
      path += `${pen}${across(i).toFixed(1)} ${up(value).toFixed(2)}`;
      return (pen = "L");
    });
    const now = svg("line", { class: "now", y1: 0, y2: 60 });
    const zero = range[0] < 0 && range[1] > 0 ? svg("line", { class: "zero", x1: 0, x2: 1000, y1: up(0), y2: up(0) }) : null;
    const value = html("b", {});
    const choose = (event) => {
      if (event.type !== "pointerdown" && !event.buttons) return;
      const box = event.currentTarget.getBoundingClientRect();
      this.go(Math.round(across.inverse(((event.clientX - box.left) / box.width) * 1000)));
    };
    const drawing = svg("svg", { viewBox: "0 0 1000 60", preserveAspectRatio: "none", "aria-hidden": "true", onpointerdown: choose, onpointermove: choose }, zero, svg("path", { class: "line c0", d: path }), now);
    const known = signal.values.filter(isNumber);
    const [least, most] = known.length ? [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))] : [];
    const unit = signal.unit ? ` ${signal.unit}` : "";
    const element = html(
      "div",
      { class: "strip" },
      html("p", {}, html("span", {}, signal.label + (signal.unit ? ` (${signal.unit})` : "")), value),
      drawing,
      html("p", { class: "ends" }, `${text(least)} to ${text(most)}${unit}`),
    );
    const move = (i) => {
      set(now, { x1: across(i), x2: across(i) });
      value.textContent = text(signal.values[i]);
    };
    return { element, move };
  }

  /** Shows a frame; a number outside the episode is clamped. */
  go(frame) {
    this.frame = Math.max(0, Math.min(this.frames - 1, frame));
    if (this.signals.firstChild !== this.cursors[0].element) this.signals.replaceChildren(...this.cursors.map(({ element }) => element));
    this.slider.value = this.frame;
    const step = Math.min(this.frame * this.episode.stride, this.episode.steps);
    const seconds = this.dt === null ? "" : `, ${(step * this.dt).toFixed(2)} s`;
    this.time.textContent = `step ${whole(step)} of ${whole(this.episode.steps)}${seconds}`;
    set(this.slider, { "aria-valuetext": this.time.textContent });
    this.drawScene(this.frame);
    for (const { move } of this.cursors) move(this.frame);
  }

  step(by) {
    this.pause();
    this.go(this.frame + by);
  }

  toggle() {
    if (this.playing) return this.pause();
    if (this.frame === this.frames - 1) this.go(0);
    this.playing = true;
    this.name();
    let [before, due] = [null, 0];
    const tick = (now) => {
      if (!this.playing) return;
      const step = this.dt ?? this.run.played.pace;
      const seconds = step === null ? SECONDS_PER_FRAME : step * this.episode.stride;
      due += before === null ? 0 : (Math.min(250, now - before) / 1000 / seconds) * this.speed;
      before = now;
      const frames = Math.floor(due);
      due -= frames;
      if (frames) this.go(this.frame + frames);
      if (this.frame === this.frames - 1) this.pause();
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
    return undefined;
  }

  pause() {
    this.playing = false;
    this.name();
  }

  name() {
    this.play.textContent = this.playing ? "❚❚ Pause" : "▶ Play";
    set(this.play, { "data-playing": String(Boolean(this.playing)) });
  }

  /** A key in the player. */
  key(event) {
    const { target } = event;
    if (event.ctrlKey || event.altKey || event.metaKey || target.matches("select")) return;
    // Space activates the focused button, as usual.
    if (event.key === " " && target.matches("button")) return;
    const actions = { " ": () => this.toggle(), ArrowLeft: () => this.step(-1), ArrowRight: () => this.step(1), Home: () => this.step(-this.frames), End: () => this.step(this.frames) };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
  }

  /** A key outside the player: space plays and pauses; without focus, the arrows step as long as its picture is in sight. */
  keyOfPage(event) {
    const { target } = event;
    if (event.defaultPrevented || event.ctrlKey || event.altKey || event.metaKey || event.shiftKey || this.element.contains(target)) return;
    if (event.key === " " && !target.closest(TAKES_SPACE)) {
      event.preventDefault();
      // A key that is held down repeats.
      if (!event.repeat) this.toggle();
      if (this.playing && !this.isInSight()) this.stage.scrollIntoView({ block: "center" });
    } else if (target === document.body && (event.key === "ArrowLeft" || event.key === "ArrowRight") && this.isInSight()) {
      this.key(event);
    }
  }

  /** Whether the whole picture is in the window. */
  isInSight() {
    const box = this.stage.getBoundingClientRect();
    return box.top >= 0 && box.bottom <= innerHeight;
  }
}
