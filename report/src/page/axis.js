/* Axes: ticks, number formats, scales, and zoom shared by several diagrams. */

/** About `count` round numbers from `low` to `high`. */
function ticks(low, high, count) {
  const rough = (high - low) / Math.max(1, count);
  if (!(rough > 0) || !Number.isFinite(rough)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough * 0.999);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9 && found.length < 50; i += 1) {
    found.push(Number((i * step).toPrecision(12)));
  }
  return found;
}

/** The format of an axis in units of `unit`; `suffix` follows its label. */
function inUnits(unit, suffix) {
  return { unit, write: (value) => `${Number((value / unit).toPrecision(6)).toLocaleString("en-GB").replace("-", "−")}`, suffix };
}

/** Environment steps. */
const STEPS = {
  label: "environment steps",
  scale: (high) => (high < 2e4 ? inUnits(1, "") : high < 2e7 ? inUnits(1e3, " (thousands)") : inUnits(1e6, " (millions)")),
  format: (value) => `step ${whole(Math.round(value))}`,
};

/** Time since the start of the run, in s. */
const TIME = {
  label: "time",
  scale: (high) => (high < 180 ? inUnits(1, " (s)") : high < 10800 ? inUnits(60, " (min)") : inUnits(3600, " (h)")),
  format: duration,
};

/** A range that contains the values, with a margin as a share of its width. A single value is centred. */
function rangeOf(values, margin = 0.06) {
  let low = Infinity;
  let high = -Infinity;
  for (const value of values) {
    if (!isNumber(value)) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  if (low > high) return [0, 1];
  const width = high - low || Math.abs(low) * 0.1 || 1;
  return high === low ? [low - width / 2, high + width / 2] : [low - margin * width, high + margin * width];
}

/** A linear map of [a, b] onto [c, d], with its `inverse`. */
function scale([a, b], [c, d]) {
  const factor = (d - c) / (b - a || 1);
  const map = (value) => c + (value - a) * factor;
  map.inverse = (place) => a + (place - c) / factor;
  return map;
}

/** The index of the number nearest to `value`; `numbers` are sorted. */
function nearest(numbers, value) {
  let [low, high] = [0, numbers.length - 1];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (numbers[middle] < value) low = middle + 1;
    else high = middle;
  }
  return low > 0 && value - numbers[low - 1] < numbers[low] - value ? low - 1 : low;
}

/** Diagrams that share an x axis and are zoomed together. */
class SharedAxis {
  constructor() {
    this.members = [];
    this.shown = null;
  }

  /** The range of all points of all diagrams, including 0. */
  get whole() {
    const ends = this.members.flatMap((member) => member.extent());
    const [low, high] = rangeOf(ends, 0);
    return [Math.min(low, 0), high];
  }

  get domain() {
    return this.shown ?? this.whole;
  }

  show(domain) {
    const [first, last] = this.whole;
    if (domain) {
      const low = Math.max(first, Math.min(...domain));
      const high = Math.min(last, Math.max(...domain));
      this.shown = high - low > (last - first) * 1e-4 ? [low, high] : this.shown;
      if (low <= first && high >= last) this.shown = null;
    } else {
      this.shown = null;
    }
    for (const member of this.members) member.draw();
  }

  /** Zooms in (`factor` below 1) or out around `centre`. */
  zoom(factor, centre) {
    const [low, high] = this.domain;
    const middle = centre ?? (low + high) / 2;
    this.show([middle - (middle - low) * factor, middle + (high - middle) * factor]);
  }

  move(share) {
    const [low, high] = this.domain;
    const [first, last] = this.whole;
    const by = Math.max(first - low, Math.min(last - high, share * (high - low)));
    this.show([low + by, high + by]);
  }
}
