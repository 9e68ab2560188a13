/* A diagram of curves and bands over steps or time, with zoom and a pointer that shows values. */

const MARGIN = { left: 62, right: 14, top: 12, bottom: 44 };
/** At most this many curves are described in text at once. */
const DESCRIBED = 8;
/** A legend with more names is collapsed. */
const LONG_LEGEND = 12;

/**
 * options: `title`, `unit` (of y), `axis` (STEPS or TIME), `sharedAxis`, `series`; optionally `marks`, `height`, `line`
 * (a target value), `smoothing` (the share of the axis over which a moving mean is drawn; 0 for none). A series has
 * `name`, `colour`, `x`, `y`; optionally `low`, `high`, `band` (what lies between them), `look` (thin, fine, thick). A
 * mark has `x`, `kind` and `text`.
 */
class Chart {
  constructor(options) {
    Object.assign(this, { marks: [], height: 300, smoothing: 0 }, options);
    this.hidden = new Set();
    this.cursor = null;
    this.picture = svg("svg", { role: "img", "aria-label": this.described() });
    this.readout = html("div", { class: "readout", hidden: true });
    this.announcement = html("p", { class: "visually-hidden", "aria-live": "polite" });
    this.plot = html(
      "div",
      {
        class: "plot",
        tabindex: 0,
        role: "group",
        "aria-label": `${this.title}: left and right arrows read values, plus and minus zoom, 0 shows everything`,
        onkeydown: (event) => this.key(event),
        onpointerdown: (event) => this.press(event),
        onpointermove: (event) => this.point(event),
        onpointerup: (event) => this.release(event),
        onpointercancel: () => this.leave(),
        onpointerleave: () => this.leave(),
        ondblclick: () => this.sharedAxis.show(null),
        onwheel: (event) => this.wheel(event),
        onblur: () => this.leave(),
      },
      this.picture,
      this.readout,
    );
    // The height is reserved, so that nothing moves when the chart is drawn.
    this.plot.style.minHeight = `${this.height}px`;
    const button = (sign, name, onclick) => html("button", { type: "button", "aria-label": `${this.title}: ${name}`, title: name, onclick }, sign);
    this.element = html(
      "figure",
      { class: "chart" },
      html(
        "figcaption",
        {},
        html("span", { class: "title" }, this.title),
        html(
          "span",
          { class: "tools" },
          button("−", "zoom out", () => this.sharedAxis.zoom(2)),
          button("+", "zoom in", () => this.sharedAxis.zoom(0.5)),
          button("All", "show all", () => this.sharedAxis.show(null)),
        ),
      ),
      this.plot,
      this.legend(),
      this.announcement,
    );
    this.sharedAxis.members.push(this);
    new ResizeObserver(() => this.draw()).observe(this.plot);
  }

  described() {
    const named = this.series.filter((series) => series.name && series.y.some(isNumber));
    const texts = named.slice(0, DESCRIBED).map((series) => {
      const values = series.y.filter(isNumber);
      return `${series.name} from ${text(values[0])} to ${text(values[values.length - 1])}`;
    });
    return `${this.title} over ${this.axis.label}: ${texts.join("; ") || "no data yet"}`;
  }

  legend() {
    const entry = (series) =>
      html(
        "button",
        {
          type: "button",
          class: `c${series.colour} ${series.look ?? ""}`,
          "aria-pressed": "true",
          onclick: (event) => {
            const shown = this.hidden.delete(series) || !this.hidden.add(series);
            event.currentTarget.setAttribute("aria-pressed", String(shown));
            this.draw();
          },
        },
        html("i", {}),
        series.band ? `${series.name} (band: ${series.band})` : series.name,
      );
    // A single curve needs no legend: the title describes it.
    const named = this.series.filter((series) => series.name);
    const legend = html("div", { class: "legend", hidden: named.length === 1 && !named[0].band }, named.map(entry));
    return named.length > LONG_LEGEND ? html("details", {}, html("summary", {}, `Names of the ${named.length} curves`), legend) : legend;
  }

  extent() {
    return this.series.flatMap(({ x }) => (x.length ? [x[0], x[x.length - 1]] : []));
  }

  shown() {
    return this.series.filter((series) => !this.hidden.has(series));
  }

  /** Draws the moving mean over this share of the axis; 0 for none. */
  smooth(share) {
    this.smoothing = share;
    this.draw();
  }

  draw() {
    const width = this.plot.clientWidth;
    if (!width) return;
    const { height } = this;
    const domain = this.sharedAxis.domain;
    this.x = scale(domain, [MARGIN.left, width - MARGIN.right]);
    const visible = this.shown().flatMap(({ x, y, low, high }) =>
      [y, low, high].filter(Boolean).flatMap((values) => values.filter((_, i) => x[i] >= domain[0] && x[i] <= domain[1])),
    );
    const range = rangeOf(this.line === undefined ? visible : [...visible, this.line]);
    this.y = scale(range, [height - MARGIN.bottom, MARGIN.top]);
    set(this.picture, { viewBox: `0 0 ${width} ${height}`, width, height });
    const clip = (this.clip ??= freshId());
    this.pointer = svg("g", { class: "pointer" });
    this.picture.replaceChildren(
      svg("clipPath", { id: clip }, svg("rect", { x: MARGIN.left, y: 0, width: Math.max(0, width - MARGIN.left - MARGIN.right), height: height - MARGIN.bottom })),
      this.axes(domain, range, width),
      svg(
        "g",
        { "clip-path": `url(#${clip})` },
        this.markLines(),
        this.shown().map((series) => this.curve(series)),
        this.smoothing ? this.shown().map((series) => this.smoothed(series)) : [],
      ),
      this.pointer,
    );
    if (!visible.some(isNumber)) {
      const middle = { class: "nothing", x: width / 2, y: (height - MARGIN.bottom) / 2, "text-anchor": "middle" };
      this.picture.append(svg("text", middle, "no data yet"));
    }
  }

  axes(domain, range, width) {
    const { height, x, y } = this;
    const bottom = height - MARGIN.bottom;
    const across = this.axis.scale(this.sharedAxis.whole[1]);
    const part = svg("g", { class: "axes" });
    for (const value of ticks(range[0], range[1], 5)) {
      part.append(svg("line", { x1: MARGIN.left, x2: width - MARGIN.right, y1: y(value), y2: y(value) }));
      part.append(svg("text", { x: MARGIN.left - 8, y: y(value) + 4, "text-anchor": "end" }, text(value)));
    }
    const units = domain.map((end) => end / across.unit);
    for (const value of ticks(units[0], units[1], Math.max(3, Math.min(8, width / 90)))) {
      const place = x(value * across.unit);
      part.append(svg("line", { class: "tick", x1: place, x2: place, y1: bottom, y2: bottom + 5 }));
      part.append(svg("text", { x: place, y: bottom + 19, "text-anchor": "middle" }, across.write(value * across.unit)));
    }
    part.append(svg("line", { class: "base", x1: MARGIN.left, x2: width - MARGIN.right, y1: bottom, y2: bottom }));
    part.append(svg("text", { class: "label", x: width - MARGIN.right, y: height - 6, "text-anchor": "end" }, this.axis.label + across.suffix));
    if (this.line !== undefined) {
      part.append(svg("line", { class: "target", x1: MARGIN.left, x2: width - MARGIN.right, y1: y(this.line), y2: y(this.line) }));
    }
    return part;
  }

  markLines() {
    const line = (mark) => svg("line", { class: `mark ${mark.kind}`, x1: this.x(mark.x), x2: this.x(mark.x), y1: 0, y2: this.height - MARGIN.bottom });
    return svg("g", {}, this.marks.map(line));
  }

  /** The moving mean of a curve, over the smoothing's share of the whole axis. */
  means(series) {
    const [low, high] = this.sharedAxis.whole;
    return movingMean(series, this.smoothing * (high - low));
  }

  smoothed(series) {
    return svg("g", { class: `smoothed c${series.colour} ${series.look ?? ""}` }, this.path(series, this.means(series)));
  }

  /** The line through these values of a curve, with gaps where there are none. */
  path(series, values) {
    let path = "";
    let pen = "M";
    values.forEach((value, i) => {
      if (!isNumber(value) || !isNumber(series.x[i])) return (pen = "M");
      path += pen + this.at(series, value, i);
      return (pen = "L");
    });
    return svg("path", { class: "line", d: path });
  }

  at(series, value, i) {
    return `${this.x(series.x[i]).toFixed(1)} ${this.y(value).toFixed(1)}`;
  }

  /** A curve with its band; pale beneath a smoothed one. */
  curve(series) {
    const group = svg("g", { class: `c${series.colour} ${series.look ?? ""} ${this.smoothing ? "pale" : ""}` });
    const place = (value, i) => this.at(series, value, i);
    if (series.low) {
      const known = series.low.map((_, i) => i).filter((i) => isNumber(series.low[i]) && isNumber(series.high[i]));
      const around = [...known.map((i) => place(series.high[i], i)), ...known.reverse().map((i) => place(series.low[i], i))];
      if (around.length) group.append(svg("path", { class: "band", d: `M${around.join("L")}Z` }));
    }
    group.append(this.path(series, series.y));
    const few = series.y.filter(isNumber).length <= 40;
    if (few && series.look !== "thick") {
      series.y.forEach((value, i) => {
        if (isNumber(value)) group.append(svg("circle", { r: 2.5, cx: this.x(series.x[i]), cy: this.y(value) }));
      });
    }
    return group;
  }

  /** Shows the values of the curves at `at` on the x axis: those nearest to `height` (in pixels) if it is given. */
  read(at, announce = false, height = null) {
    this.cursor = at;
    const found = this.shown().filter((series) => series.name && series.x.length).map((series) => ({ series, i: nearest(series.x, at) }));
    const values = found.filter(({ series, i }) => isNumber(series.y[i]));
    const distance = ({ series, i }) => (height === null ? 0 : Math.abs(this.y(series.y[i]) - height));
    const shown = values.sort((a, b) => distance(a) - distance(b)).slice(0, DESCRIBED);
    this.pointer.replaceChildren(
      svg("line", { x1: this.x(at), x2: this.x(at), y1: MARGIN.top, y2: this.height - MARGIN.bottom }),
      ...shown.map(({ series, i }) => svg("circle", { class: `c${series.colour}`, r: 4, cx: this.x(series.x[i]), cy: this.y(series.y[i]) })),
    );
    const marks = this.marks.filter((mark) => Math.abs(this.x(mark.x) - this.x(at)) < 6).slice(0, 4);
    const unit = this.unit ? ` ${this.unit}` : "";
    const lines = shown.map(({ series, i }) => {
      const smoothed = this.smoothing ? `, smoothed ${text(this.means(series)[i])}` : "";
      const band = series.low ? `, ${text(series.low[i])} to ${text(series.high[i])}` : "";
      return [series, `${series.name}: ${text(series.y[i])}${unit}${smoothed}${band}`];
    });
    this.readout.replaceChildren(
      html("b", {}, this.axis.format(at)),
      ...lines.map(([series, line]) => html("span", { class: `c${series.colour}` }, html("i", {}), line)),
      ...marks.map((mark) => html("span", { class: "c1" }, mark.text)),
    );
    this.readout.hidden = false;
    const right = this.x(at) > this.plot.clientWidth / 2;
    this.readout.style.left = right ? "auto" : `${this.x(at) + 12}px`;
    this.readout.style.right = right ? `${this.plot.clientWidth - this.x(at) + 12}px` : "auto";
    if (announce) this.announcement.textContent = `${this.axis.format(at)}. ${lines.map(([, line]) => line).join(". ")}`;
  }

  place(event) {
    const box = this.plot.getBoundingClientRect();
    return [Math.max(MARGIN.left, Math.min(box.width - MARGIN.right, event.clientX - box.left)), event.clientY - box.top];
  }

  press(event) {
    if (event.button !== 0) return;
    this.from = this.place(event)[0];
  }

  point(event) {
    if (!this.x) return;
    const [left, top] = this.place(event);
    this.read(this.x.inverse(left), false, top);
    if (this.from !== undefined && Math.abs(left - this.from) > 4) {
      const chosen = { class: "chosen", x: Math.min(left, this.from), y: MARGIN.top, width: Math.abs(left - this.from), height: this.height - MARGIN.top - MARGIN.bottom };
      this.pointer.append(svg("rect", chosen));
    }
  }

  release(event) {
    const left = this.place(event)[0];
    const from = this.from;
    this.from = undefined;
    if (from !== undefined && Math.abs(left - from) > 8) this.sharedAxis.show([this.x.inverse(from), this.x.inverse(left)]);
    else this.point(event);
  }

  leave() {
    this.from = undefined;
    this.readout.hidden = true;
    this.pointer?.replaceChildren();
  }

  wheel(event) {
    if (!event.ctrlKey) return;
    event.preventDefault();
    this.sharedAxis.zoom(event.deltaY > 0 ? 1.25 : 0.8, this.x.inverse(this.place(event)[0]));
  }

  key(event) {
    const [low, high] = this.sharedAxis.domain;
    const actions = {
      ArrowLeft: () => this.step(-1),
      ArrowRight: () => this.step(1),
      "+": () => this.sharedAxis.zoom(0.5, this.cursor),
      "-": () => this.sharedAxis.zoom(2, this.cursor),
      0: () => this.sharedAxis.show(null),
      Escape: () => this.leave(),
      PageUp: () => this.sharedAxis.move(-0.5),
      PageDown: () => this.sharedAxis.move(0.5),
    };
    const action = actions[event.key];
    if (!action || !(high > low) || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    action();
  }

  /** Moves the pointer to the next x value of a shown curve. */
  step(direction) {
    const [low, high] = this.sharedAxis.domain;
    const from = this.cursor ?? (direction > 0 ? low - 1 : high + 1);
    const least = (high - low) / 200;
    const places = this.shown().flatMap(({ x }) => x).filter((x) => x >= low && x <= high && (x - from) * direction > (this.cursor === null ? 0 : least));
    if (places.length) this.read(direction > 0 ? Math.min(...places) : Math.max(...places), true);
  }
}
