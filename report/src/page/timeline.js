/* The time line of incidents, such as kills and restarts: a line for each role, over the same time axis as the other
   diagrams. */

const ROLES = [
  ["launcher", "launcher"],
  ["learner", "learner"],
  ["evaluator", "evaluator"],
  ["actor", "actors"],
  ["env-server", "environment servers"],
  ["gate", "gate"],
];

/** The words, colour and sign of each kind of incident. */
const KINDS = {
  killed: ["killed", "bad", "M-5-5L5 5M-5 5L5-5"],
  failed: ["failed", "bad", "M-5-5L5 5M-5 5L5-5M-7 0H7"],
  stalled: ["stalled", "bad", "M-5-6H5L-5 6H5Z"],
  fault: ["invalid answer", "bad", "M0-6V2M0 4.5V6"],
  "given-up": ["given up", "bad", "M-6-6H6V6H-6Z"],
  "started-again": ["started again", "good", "M-5 4L0-5L5 4Z"],
  retired: ["retired", "calm", "M-5-4L0 5L5-4Z"],
  scaled: ["scaled", "calm", "M-6 0L0-6L6 0L0 6Z"],
  resumed: ["resumed", "calm", "M-4-6L6 0L-4 6Z"],
};

/** An incident in words. */
function describe(row) {
  const who = row.role === "launcher" ? "run" : `${row.role} ${row.index}`;
  const [words] = KINDS[row.what] ?? [row.what];
  return `${who} ${row.detail.startsWith(words) ? row.detail : [words, row.detail].filter(Boolean).join(": ")}`;
}

const describeChange = (change) => `${change.key} ${change.before || "none"} → ${change.after || "none"}`;

/** The changes of the configuration as marks for other diagrams, over steps or time. */
function changesOf(run, axis) {
  return run.changes.map((change) => ({ x: axis === STEPS ? change.env_steps : change.wall_seconds, kind: "calm", text: describeChange(change) }));
}

/** The incidents as marks for other diagrams, without restarts, which follow immediately, and retirements. */
function marksOf(run) {
  const rows = run.incidents?.rows ?? [];
  const shown = rows.filter((row) => row.what !== "started-again" && row.what !== "retired");
  return shown.map((row) => ({ x: row.wall_seconds, kind: KINDS[row.what]?.[1] ?? "calm", text: describe(row) }));
}

class Timeline {
  constructor(run, sharedAxis, named) {
    this.run = run;
    this.sharedAxis = sharedAxis;
    const { rows } = run.incidents;
    this.lanes = ROLES.filter(([role]) => rows.some((row) => row.role === role));
    this.height = this.lanes.length * 44 + 44;
    const counts = `${plural(run.incidents.kills, "kill")}, ${plural(run.incidents.restarts, "restart")}`;
    this.picture = svg("svg", { role: "img", "aria-label": `${run.name}: ${counts}; the table below lists them` });
    this.plot = html("div", { class: "plot timeline" }, this.picture);
    this.plot.style.minHeight = `${this.height}px`;
    const present = Object.entries(KINDS).filter(([kind]) => rows.some((row) => row.what === kind));
    const key = present.map(([, [words, look, sign]]) => html("span", { class: "key" }, svg("svg", { viewBox: "-8 -8 16 16", width: 16, height: 16, "aria-hidden": "true" }, svg("path", { class: `sign ${look}`, d: sign })), words));
    this.element = html(
      "figure",
      { class: "chart" },
      html("figcaption", {}, html("span", { class: "title" }, `${named ? `${run.name}: ` : ""}${counts}`)),
      this.plot,
      html("div", { class: "keys" }, key),
      this.table(),
    );
    sharedAxis.members.push(this);
    new ResizeObserver(() => this.draw()).observe(this.plot);
  }

  extent() {
    return this.run.incidents.rows.map((row) => row.wall_seconds);
  }

  table() {
    const { rows, more } = this.run.incidents;
    const cells = (row) => html("tr", {}, html("td", {}, duration(row.wall_seconds)), html("td", {}, whole(row.env_steps)), html("td", {}, describe(row)));
    const head = ["time", "environment steps", "what happened"].map((name) => html("th", { scope: "col" }, name));
    return html(
      "details",
      {},
      html("summary", {}, `All ${rows.length + more} incidents as a list`),
      scrollable(`Incidents of ${this.run.name}`, html("table", {}, html("thead", {}, html("tr", {}, head)), html("tbody", {}, rows.map(cells)))),
      more ? html("p", { class: "aside" }, `${whole(more)} later incidents are not listed: see incidents.csv`) : null,
    );
  }

  draw() {
    const width = this.plot.clientWidth;
    if (!width) return;
    const domain = this.sharedAxis.domain;
    const x = scale(domain, [MARGIN.left, width - MARGIN.right]);
    const across = TIME.scale(this.sharedAxis.whole[1]);
    set(this.picture, { viewBox: `0 0 ${width} ${this.height}`, width, height: this.height });
    const part = svg("g", { class: "axes" });
    const signs = svg("g", {});
    this.lanes.forEach(([role, name], lane) => {
      const y = lane * 44 + 28;
      part.append(svg("line", { x1: MARGIN.left, x2: width - MARGIN.right, y1: y, y2: y }));
      part.append(svg("text", { class: "lane", x: MARGIN.left, y: y - 13 }, name));
      for (const row of this.run.incidents.rows) {
        if (row.role !== role || row.wall_seconds < domain[0] || row.wall_seconds > domain[1]) continue;
        const [, look, sign] = KINDS[row.what] ?? KINDS.scaled;
        const words = svg("title", {}, `${duration(row.wall_seconds)}: ${describe(row)}`);
        signs.append(svg("path", { class: `sign ${look}`, d: sign, transform: `translate(${x(row.wall_seconds).toFixed(1)} ${look === "good" ? y + 11 : y})` }, words));
      }
    });
    const bottom = this.height - 38;
    for (const value of ticks(domain[0] / across.unit, domain[1] / across.unit, Math.max(3, Math.min(8, width / 90)))) {
      part.append(svg("text", { x: x(value * across.unit), y: bottom + 12, "text-anchor": "middle" }, across.write(value * across.unit)));
    }
    part.append(svg("text", { class: "label", x: width - MARGIN.right, y: this.height - 4, "text-anchor": "end" }, `time${across.suffix}`));
    this.picture.replaceChildren(part, signs);
  }
}
