/* The page, section by section. */

const report = JSON.parse(document.getElementById("data").textContent);
const { runs } = report;
const COLOURS = 6;
const several = runs.length > 1;
/** The table of the results is collapsed if there are more runs, so that the curves are in view. */
const MANY = 8;

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

/** The name of a run with its colour. */
const runName = (run, i) => [html("i", { class: `swatch c${i % COLOURS}` }), run.name];

/** A table with a row for each property and a column for each run. */
function table(label, rows) {
  const head = html("tr", {}, html("td", {}), ...runs.map((run, i) => html("th", { scope: "col" }, runName(run, i))));
  const row = ([name, values, differs]) => html("tr", { class: differs ? "differs" : "" }, html("th", { scope: "row" }, name), ...values.map((value) => html("td", {}, value)));
  return scrollable(label, html("table", {}, html("thead", {}, head), html("tbody", {}, rows.map(row))));
}

/** A table with these columns, each a name and a function that gives a row's cell. */
function listed(label, columns, rows, caption = null) {
  const head = html("tr", {}, columns.map(([name]) => html("th", { scope: "col" }, name)));
  const body = rows.map((row, i) => html("tr", {}, columns.map(([, of]) => html("td", {}, of(row, i)))));
  return scrollable(label, html("table", {}, caption && html("caption", {}, caption), html("thead", {}, head), html("tbody", {}, body)));
}

const interval = (of) => (of ? `${text(of[0])} … ${text(of[1])}` : "–");

/** A run's state with the reason, if it did not simply finish. */
function stateOf({ state, why }) {
  const words = { training: "training", finished: "finished", unfinished: "not finished" }[state];
  return why ? `${words}: ${why}` : words;
}

/** How far a run is, in what limits it. */
function progressOf(run) {
  if (run.planned_episodes !== null) return `${whole(run.episodes)} of ${plural(run.planned_episodes, "episode")}`;
  return `${whole(run.env_steps)} of ${plural(run.planned_steps, "step")}`;
}

/** The final evaluation of a run, if it has one with a result. */
const finalOf = ({ final_evaluation: found }) => (found && found.return_mean !== null ? found : null);

/** The result of the only run: a number, what it is, and how certain it is. */
function onlyResult(run) {
  const found = finalOf(run);
  const number = (mean, what) => html("p", { class: "result" }, html("b", {}, text(mean)), what);
  const state = html("p", {}, `State: ${stateOf(run)}, ${progressOf(run)}.`);
  if (found) {
    const certainty = found.interval ? `95 % interval of the mean: ${interval(found.interval)}. ` : "";
    const spread = `Standard deviation: ${text(found.return_std)}, over ${plural(found.episodes, "episode")} without exploration. `;
    return [number(found.return_mean, "mean return of the final evaluation"), html("p", {}, `${certainty}${spread}Its policy learned from ${plural(found.env_steps, "environment step")}.`), state];
  }
  const { last } = run;
  if (!last) return [html("p", {}, "No policy has been evaluated yet."), state];
  const spread = `Standard deviation: ${text(last.std)}, over ${plural(last.episodes, "episode")} without exploration. There is no final evaluation.`;
  return [number(last.mean, `mean return of the last evaluation, at step ${whole(last.env_steps)}`), html("p", {}, spread), state];
}

/** The results of several runs: which settings are best, and each run's own result. */
function resultsOfAll() {
  const columns = [
    ["run", runName],
    ["state", stateOf],
    ["final evaluation", (run) => (finalOf(run) ? `${text(finalOf(run).return_mean)} ± ${text(finalOf(run).return_std)} (${plural(finalOf(run).episodes, "episode")})` : "none")],
    ["95 % interval of its mean", (run) => interval(finalOf(run)?.interval)],
    ["last evaluation", (run) => (run.last ? text(run.last.mean) : "none")],
    ["progress", progressOf],
  ];
  const list = listed("The results of the runs", columns, runs);
  const words = `Results of the ${runs.length} runs`;
  const each = runs.length > MANY ? html("details", {}, html("summary", {}, words), list) : list;
  return [...ranking(), each, aside("Returns are means over the episodes of an evaluation, without exploration. The number after ± is their standard deviation.")];
}

function result() {
  section("Result", ...(several ? resultsOfAll() : onlyResult(runs[0])));
}

/** What else is known of the runs. */
function details() {
  const evaluated = (of) => (of ? `${text(of.mean)} ± ${text(of.std)} (${plural(of.episodes, "episode")}, step ${whole(of.env_steps)})` : "not evaluated yet");
  const planned = (run) => `${whole(run.env_steps)} of ${whole(run.planned_steps)}`;
  const episodes = (run) => (run.planned_episodes === null ? whole(run.episodes) : `${whole(run.episodes)} of ${whole(run.planned_episodes)}`);
  const incidents = ({ incidents }) => (incidents ? `${plural(incidents.kills, "kill")}, ${plural(incidents.restarts, "restart")}` : "not recorded");
  const started = (of) => (run) => (run.start ? of(run) : "not recorded");
  const facts = [
    ["environment", (run) => run.environment],
    ["algorithm", (run) => `${run.algorithm}, ${run.mode}`],
    ["seed", (run) => String(run.seed)],
    ["environment steps", planned],
    ["episodes", episodes],
    ["updates", (run) => whole(run.updates)],
    ["time", (run) => duration(run.wall_seconds)],
    ["best return", (run) => evaluated(run.best)],
    ["last return", (run) => evaluated(run.last)],
    ["processes", incidents],
  ];
  if (runs.some((run) => run.origin)) facts.splice(2, 0, ["began with", (run) => run.origin ?? "new networks"]);
  // The head shows these of a single run.
  if (several && runs.some((run) => run.start)) {
    facts.push(
      ["start", started((run) => date(run.start.started))],
      ["machine", started((run) => machineOf(run) ?? "unknown")],
      ["version", started((run) => run.start.version)],
      ["command", started((run) => commandLine(run.start.command))],
    );
  }
  section("Details", table("Details of the runs", facts.map(([name, of]) => [name, runs.map(of)])));
}

/** The curves of one environment's runs: repetitions with their median and spread. */
function returns(comparison, axis, smoothing) {
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
      const curve = { name: own || set.runs.length === 1 ? runs[i].name : "", colour: (own ? i : at) % COLOURS, x: x(evaluations), y: evaluations.mean, sums: evaluations.sums, counts: evaluations.counts };
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
  return new Chart({ title: `Evaluation return, ${comparison.environment}`, unit: "", axis, sharedAxis: new SharedAxis(), series, marks, height: 340, smoothing });
}

/** Marks of a run, which say whose they are where there are several runs. */
const named = (run, marks) => marks.map((mark) => ({ ...mark, text: several ? `${run.name}: ${mark.text}` : mark.text }));

/** A section of charts with a choice of their axis and of the smoothing. `make` returns the charts. */
function curves(title, make, ...after) {
  const place = html("div", {});
  let [charts, smoothing] = [[], 0];
  const draw = (axis) => {
    charts = make(axis, smoothing);
    place.replaceChildren(...charts.map((chart) => chart.element));
  };
  const smooth = (index) => {
    smoothing = SMOOTHINGS[index];
    for (const chart of charts) chart.smooth(smoothing);
  };
  const name = freshId();
  const axisChoice = (words, axis, checked) => html("label", {}, html("input", { type: "radio", name, checked, onchange: () => draw(axis) }), words);
  const axes = html("fieldset", {}, html("legend", {}, "over"), axisChoice("environment steps", STEPS, true), axisChoice("time", TIME, false));
  const shares = SMOOTHINGS.map((share, i) => [i, share ? `moving mean over ${Math.round(100 * share)} %` : "off"]);
  section(title, html("div", { class: "choices" }, axes, choice("Smoothing", shares, 0, smooth)), place, ...after);
  draw(STEPS);
}

function learning() {
  const make = (axis, smoothing) => report.comparisons.map((comparison) => returns(comparison, axis, smoothing));
  curves(
    several ? "Learning curves" : "Learning curve",
    make,
    ...(runs.some((run) => run.changes.length) ? [aside("Vertical lines mark changes of the configuration.")] : []),
    aside("Drag over a diagram to zoom in and double-click it to see everything. Click a name in the legend to hide or show its curve. Smoothing draws a centred moving mean over a share of the axis, and over at least three points. The original curve stays visible in a pale colour."),
  );
}

function exploration() {
  const make = (axis, smoothing) => report.comparisons.flatMap((comparison) => explored(comparison, axis, smoothing));
  if (make(STEPS, 0).length) curves("Exploration", make, aside("Returns of the actors' episodes, with their exploration."));
}

/** One curve for each run with values. */
function perRun(of, which = runs.map((_, i) => i)) {
  const series = which.map((i) => ({ name: runs[i].name, colour: i % COLOURS, look: "fine", ...of(runs[i]) }));
  return series.filter((series) => series.y.some(isNumber));
}

function explored(comparison, axis, smoothing) {
  const returns = ({ exploration }) => ({ x: axis === STEPS ? exploration.steps : exploration.time, y: exploration.mean });
  const series = perRun(returns, comparison.sets.flatMap((set) => set.runs));
  const title = `Return while exploring, ${comparison.environment}`;
  return series.length ? [new Chart({ title, unit: "", axis, sharedAxis: new SharedAxis(), series, height: 240, smoothing })] : [];
}

function episodes() {
  const playable = runs.filter((run) => run.played.episodes.length);
  section("Episodes", playable.length ? new Player(playable).element : null, ...remarks((run) => run.played.why_not));
}

function time() {
  const sharedAxis = new SharedAxis();
  const parts = runs.filter((run) => run.incidents?.rows.length).map((run) => new Timeline(run, sharedAxis, several).element);
  parts.push(...remarks((run) => (run.incidents ? null : "This run was made by an older version, which recorded no incidents.")));
  parts.push(...remarks((run) => (run.incidents?.rows.length === 0 ? "No incidents were recorded." : null)));
  const marks = runs.length <= COLOURS ? runs.flatMap((run) => named(run, [...marksOf(run), ...changesOf(run, TIME)])) : [];
  const chart = (title, key, more = {}) => {
    const series = perRun(({ learner }) => ({ x: learner.time, y: learner[key] }));
    if (series.length) parts.push(new Chart({ title, axis: TIME, sharedAxis, series, marks, height: 220, unit: "", ...more }).element);
  };
  const configured = [...new Set(runs.map((run) => run.updates_per_step))];
  chart("Ratio: updates per step after the warm-up", "ratio", configured.length === 1 ? { line: configured[0] } : {});
  chart("Environment steps per second", "env_steps_per_second", { unit: "steps/s" });
  chart("Updates per second", "updates_per_second", { unit: "updates/s" });
  chart("Loss of the critic", "critic_loss");
  chart("Loss of the actor", "actor_loss");
  chart("Mean value of the sampled actions (Q)", "q_mean");
  chart("Temperature", "temperature");
  section("Over time", ...parts, aside("The diagrams of this section are zoomed together. Vertical lines mark incidents and changes of the configuration. A horizontal dashed line is the configured ratio."));
}

/** The hosts that have joined, if there were any. */
function hosts() {
  const rows = runs.flatMap((run) => run.hosts.map((host) => ({ ...host, run: run.name })));
  if (!rows.length) return;
  const columns = [
    ...(several ? [["run", (row) => row.run]] : []),
    ["host", (row) => row.name],
    ["actors", (row) => whole(row.actors)],
    ["joined", (row) => duration(row.joined)],
    ["gone", (row) => (row.gone === null ? "–" : duration(row.gone))],
    ["rows/s", (row) => text(row.rows_per_second)],
    ["round trip", (row) => (row.round_trip === null ? "–" : `${text(row.round_trip)} ms`)],
    ["policy behind", (row) => text(row.policy_lag)],
    ["resent chunks", (row) => whole(row.resent_chunks)],
    ["cut-offs", (row) => whole(row.cut_offs)],
  ];
  section("Other hosts", listed("Other hosts of the runs", columns, rows), aside("Times are those of the run. Rows per second, round trip and how many versions the policy was behind are medians over the time while the host was connected."));
}

/** Which settings are best, where settings were repeated with several seeds; empty if none were. */
function ranking() {
  if (!report.rankings.length) return [];
  const percent = (share) => (share === null ? "–" : `${Math.round(100 * share)} %`);
  const columns = [
    ["setting", (place) => place.label],
    ["runs", (place) => `${whole(place.runs)}${place.unfinished ? ` (${whole(place.unfinished)} not finished)` : ""}`],
    ["interquartile mean", (place) => text(place.mean)],
    ["95 % interval", (place) => interval(place.interval)],
    // Only of several settings is one the best.
    ...(report.rankings.some(({ verdict }) => verdict) ? [["best in", (place) => percent(place.best)]] : []),
  ];
  const parts = report.rankings.flatMap(({ environment, places, verdict }) => {
    const list = listed(`Settings of ${environment}, the best first`, columns, places, environment);
    return verdict ? [html("p", {}, `${verdict}.`), list] : [list];
  });
  return [...parts, aside("Each run counts with the mean return of its final evaluation, or of its last evaluation if it has no final one. The interquartile mean leaves out the best and the worst quarter of the seeds, if there are at least four. Intervals and shares come from 5,000 bootstrap resamples of the seeds.")];
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
  section("Changes", listed("Changes of the configuration", columns, rows), aside("The settings below are those after the last change."));
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

head(report);
for (const part of [result, learning, episodes, details, exploration, time, hosts, changes, settings]) part();
