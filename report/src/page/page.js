/* The page, section by section. */

const report = JSON.parse(document.getElementById("data").textContent);
const { runs } = report;
const COLOURS = 6;
const several = runs.length > 1;

/** Adds a section with its heading, and a link to it at the top of the page. */
function section(title, ...parts) {
  const id = title.toLowerCase().replaceAll(" ", "-");
  document.querySelector("nav").append(html("a", { href: `#${id}` }, title));
  const heading = html("h2", { id: `${id}-title` }, title);
  document.querySelector("main").append(html("section", { id, "aria-labelledby": heading.id }, heading, ...parts));
}

/** Paragraphs about runs. `sentence` returns a sentence about a run, or null; runs with the same sentence share a paragraph. */
function remarks(sentence) {
  const names = new Map();
  for (const run of runs) {
    const words = sentence(run);
    if (words) names.set(words, [...(names.get(words) ?? []), run.name]);
  }
  return [...names].map(([words, of]) => aside(several ? `${of.join(", ")}: ${words}` : words));
}

const aside = (words) => html("p", { class: "aside" }, words);

/** A table with a row for each property and a column for each run. */
function table(label, rows) {
  const head = html("tr", {}, html("td", {}), ...runs.map((run, i) => html("th", { scope: "col" }, html("i", { class: `swatch c${i % COLOURS}` }), run.name)));
  const row = ([name, values, differs]) => html("tr", { class: differs ? "differs" : "" }, html("th", { scope: "row" }, name), ...values.map((value) => html("td", {}, value)));
  return html("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": label }, html("table", {}, html("thead", {}, head), html("tbody", {}, rows.map(row))));
}

function overview() {
  const evaluated = (of) => (of ? `${text(of.mean)} ± ${text(of.std)} (${plural(of.episodes, "episode")}, step ${whole(of.env_steps)})` : "not evaluated yet");
  const finalEvaluation = (of) => (of && of.return_mean !== null ? `${text(of.return_mean)} ± ${text(of.return_std)} (${plural(of.episodes, "episode")}${of.interval ? `, 95 % interval of the mean ${text(of.interval[0])} … ${text(of.interval[1])}` : ""})` : "none");
  const states = { training: "training", finished: "finished", unfinished: "not finished" };
  const planned = (run) => `${whole(run.env_steps)} of ${whole(run.planned_steps)}`;
  const episodes = (run) => (run.planned_episodes === null ? whole(run.episodes) : `${whole(run.episodes)} of ${whole(run.planned_episodes)}`);
  const incidents = ({ incidents }) => (incidents ? `${plural(incidents.kills, "kill")}, ${plural(incidents.restarts, "restart")}` : "not recorded");
  const facts = [
    ["state", (run) => states[run.state]],
    ["environment", (run) => run.environment],
    ["algorithm", (run) => `${run.algorithm}, ${run.mode}`],
    ["seed", (run) => String(run.seed)],
    ["environment steps", planned],
    ["episodes", episodes],
    ["updates", (run) => whole(run.updates)],
    ["time", (run) => duration(run.wall_seconds)],
    ["best return", (run) => evaluated(run.best)],
    ["last return", (run) => evaluated(run.last)],
    ["final evaluation", (run) => finalEvaluation(run.final_evaluation)],
    ["processes", incidents],
  ];
  if (runs.some((run) => run.origin)) facts.splice(3, 0, ["beginning", (run) => run.origin ?? "networks of its own"]);
  section(
    "At a glance",
    table("The runs at a glance", facts.map(([name, of]) => [name, runs.map(of)])),
    aside("Returns are means over the episodes of an evaluation ± their standard deviation, without exploration."),
  );
}

/** The curves of one environment's runs: repetitions with their median and spread. */
function returns(comparison, axis) {
  const x = (curve) => (axis === STEPS ? curve.steps : curve.time);
  const spreads = comparison.sets.filter((set) => set.by_steps);
  const all = comparison.sets.flatMap((set) => set.runs);
  // With few runs and at most one median, each run keeps its colour of the other diagrams.
  const own = spreads.length <= 1 && all.length <= COLOURS;
  const series = [];
  comparison.sets.forEach((set, at) => {
    const spread = axis === STEPS ? set.by_steps : set.by_time;
    for (const i of set.runs) {
      const { evaluations } = runs[i];
      const curve = { name: own || set.runs.length === 1 ? runs[i].name : "", colour: (own ? i : at) % COLOURS, x: x(evaluations), y: evaluations.mean };
      if (all.length === 1 && evaluations.std.length) {
        curve.low = curve.y.map((mean, n) => (isNumber(mean) ? mean - (evaluations.std[n] ?? 0) : null));
        curve.high = curve.y.map((mean, n) => (isNumber(mean) ? mean + (evaluations.std[n] ?? 0) : null));
        curve.band = "± standard deviation of the episodes";
      }
      if (set.runs.length > 1) curve.look = "thin";
      series.push(curve);
    }
    if (spread) {
      const { band, low, high, median } = spread;
      series.push({ name: `median of ${set.label}`, colour: own ? "ink" : at % COLOURS, x: spread.x, y: median, low, high, band, look: "thick" });
    }
  });
  const marks = all.length <= COLOURS ? all.flatMap((i) => named(runs[i], changesOf(runs[i], axis))) : [];
  return new Chart({ title: `Evaluation return, ${comparison.environment}`, unit: "", axis, link: new Link(), series, marks, height: 340 });
}

/** Marks of a run, which say whose they are where there are several runs. */
const named = (run, marks) => marks.map((mark) => ({ ...mark, text: several ? `${run.name}: ${mark.text}` : mark.text }));

function learning() {
  const place = html("div", {});
  const draw = (axis) => {
    place.replaceChildren(...report.comparisons.map((comparison) => returns(comparison, axis).element));
    place.append(...report.comparisons.flatMap((comparison) => explored(comparison, axis)));
  };
  const name = freshId();
  const choice = (words, axis, checked) => html("label", {}, html("input", { type: "radio", name, checked, onchange: () => draw(axis) }), words);
  section(
    "Learning curves",
    html("fieldset", {}, html("legend", {}, "over"), choice("environment steps", STEPS, true), choice("time", TIME, false)),
    place,
    ...(runs.some((run) => run.changes.length) ? [aside("Vertical lines mark changes of the configuration.")] : []),
    aside("Drag over a diagram to zoom in and double-click it to see everything. A click on a name in the legend hides or shows its curve."),
  );
  draw(STEPS);
}

/** One curve for each run with values. */
function perRun(of, which = runs.map((_, i) => i)) {
  const series = which.map((i) => ({ name: runs[i].name, colour: i % COLOURS, look: "fine", ...of(runs[i]) }));
  return series.filter((series) => series.y.some(isNumber));
}

function explored(comparison, axis) {
  const returns = ({ exploration }) => ({ x: axis === STEPS ? exploration.steps : exploration.time, y: exploration.mean });
  const series = perRun(returns, comparison.sets.flatMap((set) => set.runs));
  const title = `Return while exploring, ${comparison.environment}`;
  return series.length ? [new Chart({ title, unit: "", axis, link: new Link(), series, height: 240 }).element] : [];
}

function episodes() {
  const playable = runs.filter((run) => run.played.episodes.length);
  section("Episodes", playable.length ? new Player(playable).element : null, ...remarks((run) => run.played.why_not));
}

function time() {
  const link = new Link();
  const parts = runs.filter((run) => run.incidents?.rows.length).map((run) => new Timeline(run, link, several).element);
  parts.push(...remarks((run) => (run.incidents ? null : "This run was made by an older version, which recorded no incidents.")));
  parts.push(...remarks((run) => (run.incidents?.rows.length === 0 ? "No incidents were recorded." : null)));
  const marks = runs.length <= COLOURS ? runs.flatMap((run) => named(run, [...marksOf(run), ...changesOf(run, TIME)])) : [];
  const chart = (title, key, more = {}) => {
    const series = perRun(({ learner }) => ({ x: learner.time, y: learner[key] }));
    if (series.length) parts.push(new Chart({ title, axis: TIME, link, series, marks, height: 220, unit: "", ...more }).element);
  };
  const configured = [...new Set(runs.map((run) => run.updates_per_step))];
  chart("Ratio: updates per step after the warm-up", "ratio", configured.length === 1 ? { line: configured[0] } : {});
  chart("Environment steps per second", "env_steps_per_second", { unit: "steps/s" });
  chart("Updates per second", "updates_per_second", { unit: "updates/s" });
  chart("Loss of the critic", "critic_loss");
  chart("Loss of the actor", "actor_loss");
  chart("Mean value of the sampled actions (Q)", "q_mean");
  section("Over time", ...parts, aside("The diagrams of this section are zoomed together. Vertical lines mark incidents and changes of the configuration. A horizontal dashed line is the configured ratio."));
}

/** Which settings are best, where settings were repeated with several seeds. */
function ranking() {
  if (!report.rankings.length) return;
  const percent = (share) => (share === null ? "–" : `${Math.round(100 * share)} %`);
  const columns = ["setting", "runs", "interquartile mean", "95 % interval", "best in"];
  const parts = report.rankings.flatMap(({ environment, places, verdict }) => {
    const row = (place) => [place.label, `${whole(place.runs)}${place.unfinished ? ` (${whole(place.unfinished)} not finished)` : ""}`, text(place.mean), place.interval ? `${text(place.interval[0])} … ${text(place.interval[1])}` : "–", percent(place.best)];
    const head = html("tr", {}, columns.map((name) => html("th", { scope: "col" }, name)));
    const body = places.map((place) => html("tr", {}, row(place).map((value) => html("td", {}, value))));
    const list = html("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": `Settings of ${environment}, the best first` }, html("table", {}, html("caption", {}, environment), html("thead", {}, head), html("tbody", {}, body)));
    return verdict ? [html("p", {}, `${verdict}.`), list] : [list];
  });
  section("Ranking", ...parts, aside("The results are the mean returns of the final evaluations, or of the last evaluation of a run that has not finished. The interquartile mean leaves out the best and the worst quarter of the seeds, if there are at least four. Intervals and shares are of 5,000 resamples of the seeds (bootstrap)."));
}

/** The changes of the configuration, if there were any. */
function changes() {
  const rows = runs.flatMap((run) => run.changes.map((change) => ({ ...change, run: run.name })));
  if (!rows.length) return;
  const columns = [
    ...(several ? [["run", (row) => row.run]] : []),
    ["step", (row) => whole(row.env_steps)],
    ["time", (row) => duration(row.wall_seconds)],
    ["key", (row) => row.key],
    ["before", (row) => row.before || "none"],
    ["after", (row) => row.after || "none"],
    ["by", (row) => row.source],
  ];
  const head = html("tr", {}, columns.map(([name]) => html("th", { scope: "col" }, name)));
  const body = rows.map((row) => html("tr", {}, columns.map(([, of]) => html("td", {}, of(row)))));
  section("Changes", html("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Changes of the configuration" }, html("table", {}, html("thead", {}, head), html("tbody", {}, body))), aside("The settings below are those after the last change."));
}

function settings() {
  const keys = [...new Set(runs.flatMap((run) => run.settings.map(([key]) => key)))].sort();
  const values = runs.map((run) => new Map(run.settings));
  const rows = keys.map((key) => {
    const found = values.map((of) => of.get(key) ?? "–");
    return [key, found, several && new Set(found).size > 1];
  });
  const place = html("div", {});
  const show = (all) => place.replaceChildren(table("Settings", all ? rows : rows.filter(([, , differs]) => differs)));
  const only = html("label", {}, html("input", { type: "checkbox", onchange: (event) => show(!event.target.checked) }), "only those that differ");
  section("Settings", several ? html("p", {}, only) : null, place);
  show(true);
}

document.getElementById("made").textContent =
  `Made ${new Date(report.made * 1000).toISOString().slice(0, 16).replace("T", " ")} UTC by shoal ${report.version}` +
  (runs.some((run) => run.state === "training") ? "; training was still running." : ".");
for (const part of [overview, ranking, learning, episodes, time, changes, settings]) part();
