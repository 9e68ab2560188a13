/* Functions that create elements and format numbers. */

const SVG = "http://www.w3.org/2000/svg";

function build(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== null && value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null));
  return element;
}

/** Creates an HTML element with attributes, listeners (`onclick` and so on) and children. */
function html(name, attributes = {}, ...children) {
  return build(document.createElement(name), attributes, children);
}

/** Creates an SVG element in the same way. */
function svg(name, attributes = {}, ...children) {
  return build(document.createElementNS(SVG, name), attributes, children);
}

function set(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
}

/** An id that is unique within the page. */
const freshId = ((count) => () => `part-${(count += 1)}`)(0);

/** A list to choose from, with its label. `values` are pairs of a number and its words; `onchange` receives the number. */
function choice(label, values, selected, onchange) {
  const id = freshId();
  const options = values.map(([value, words]) => html("option", { value, selected: value === selected }, words));
  const select = html("select", { id, onchange: (event) => onchange(Number(event.target.value)) }, options);
  return html("span", { class: "choice" }, html("label", { for: id }, label), select);
}

/** A table in a box of its own, which scrolls where the table is too wide, and shows at its edges that there is more. */
function scrollable(label, table) {
  const mark = () => {
    outer.classList.toggle("more-left", inner.scrollLeft > 1);
    outer.classList.toggle("more-right", inner.scrollWidth - inner.clientWidth - inner.scrollLeft > 1);
  };
  const inner = html("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": label, onscroll: mark }, table);
  const outer = html("div", { class: "box" }, inner);
  const observer = new ResizeObserver(mark);
  for (const part of [inner, table]) observer.observe(part);
  return outer;
}

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);

/** A value with about four digits and a true minus sign. */
function text(value) {
  if (!isNumber(value)) return "–";
  const size = Math.abs(value);
  const plain = size === 0 || (size >= 1e-3 && size < 1e6);
  const digits = size >= 1000 ? 0 : size >= 100 ? 1 : size >= 1 ? 2 : 4;
  const number = plain ? Number(value.toFixed(digits)).toLocaleString("en-GB", { maximumFractionDigits: 4 }) : value.toExponential(2);
  return number.replace("-", "−");
}

const whole = (value) => (isNumber(value) ? value.toLocaleString("en-GB") : "–");

/** Seconds as a duration, such as "3 min 20 s". */
function duration(seconds) {
  if (!isNumber(seconds)) return "–";
  if (seconds >= 59.95) seconds = Math.round(seconds);
  if (seconds < 60) return `${Number(seconds.toFixed(seconds < 10 ? 2 : 1))} s`;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 60) return `${minutes} min ${Math.round(seconds % 60)} s`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

const plural = (count, noun) => `${whole(count)} ${noun}${count === 1 ? "" : "s"}`;
