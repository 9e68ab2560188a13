/* The head of the page: what was run, how, when and where. What the runs have not recorded is left out. */

const date = (seconds) => `${new Date(seconds * 1000).toISOString().slice(0, 16).replace("T", " ")} UTC`;

/** The machine on which a run was started; null if that is unknown. */
function machineOf({ start }) {
  const parts = start ? [start.processor, start.cores && plural(start.cores, "core")] : [];
  return parts.filter(Boolean).join(", ") || null;
}

/** A command line, which breaks only between its words if they are short enough. */
const commandLine = (command) => html("code", {}, ...command.split(" ").flatMap((word) => [html("span", {}, word), " "]));

/** What the runs have, each value once; null if they have none. */
function ofAll(runs, of) {
  const values = [...new Set(runs.map(of).filter((value) => value !== null && value !== undefined))];
  if (!values.length) return null;
  return values.slice(0, 5).join(", ") + (values.length > 5 ? ` and ${plural(values.length - 5, "other")}` : "");
}

/** The least and the greatest number, each as `write` writes it; null if there are none. */
function range(numbers, write) {
  if (!numbers.length) return null;
  const [least, greatest] = [Math.min(...numbers), Math.max(...numbers)].map(write);
  return least === greatest ? least : `${least} to ${greatest}`;
}

/** The names and values that the head shows. */
function headFacts({ runs, suite }) {
  const starts = runs.flatMap((run) => (run.start ? [run.start.started] : []));
  const times = runs.map((run) => run.wall_seconds).filter((seconds) => seconds > 0);
  const command = suite?.command ?? (runs.length === 1 ? runs[0].start?.command : null);
  const facts = [
    ["Algorithm", ofAll(runs, (run) => `${run.algorithm} (${run.mode})`)],
    ["Environment", ofAll(runs, (run) => run.environment)],
    [runs.length > 1 ? "Seeds" : "Seed", ofAll(runs, (run) => String(run.seed))],
    ["Start", suite ? date(suite.started) : range(starts, date)],
    [runs.length > 1 ? "Duration of each" : "Duration", range(times, duration)],
    ["Machine", ofAll(runs, machineOf)],
    ["Version", ofAll(runs, (run) => (run.start ? `Shoal ${run.start.version}` : null))],
    ["Command", command ? commandLine(command) : null],
  ];
  return facts.filter(([, value]) => value !== null);
}

/** Fills the head of the page. */
function head(report) {
  const facts = headFacts(report).flatMap(([name, value]) => [html("dt", {}, name), html("dd", {}, value)]);
  document.getElementById("facts").append(...facts);
  const running = report.runs.some((run) => run.state === "training") ? "; training was still running." : ".";
  document.getElementById("made").textContent = `This page was made ${date(report.made)} by shoal ${report.version}${running}`;
}
