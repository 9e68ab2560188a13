/* Pictures of an episode of an environment that another program serves: images, or shapes in the environment's units. */

/** Shows images. `at(i)` is the number of the picture of frame i. */
function imageScene(images, at) {
  const element = html("img", { class: "seen", alt: "The environment, as it draws itself", decoding: "sync", "data-part": "image" });
  return { element, draw: (i) => set(element, { src: images[at(i)] }) };
}

/** Shows shapes: `Drawing` of shoal_env_server. Their y grows upwards. */
function drawingScene(drawings, at) {
  const [left, bottom, right, top] = drawings[0].view;
  const [width, height] = [right - left, top - bottom];
  const element = drawing(`${left} ${-top} ${width} ${height}`, "The environment, as it draws itself");
  const head = Math.min(width, height) * 0.035;
  const shown = ({ class: kind, ...form }) => {
    const part = kind === "body" ? { class: kind, "data-part": "moves" } : { class: kind };
    if (form.line) return svg("path", { ...part, d: line(form.line.map(([x, y]) => [x, -y])) });
    if (form.circle) return svg("circle", { ...part, cx: form.circle[0], cy: -form.circle[1], r: form.circle[2] });
    if (form.rectangle) {
      const [x0, y0, x1, y1] = form.rectangle;
      return svg("rect", { ...part, x: x0, y: -y1, width: Math.max(0, x1 - x0), height: Math.max(0, y1 - y0) });
    }
    if (form.arrow) {
      const [x0, y0, x1, y1] = form.arrow;
      const shape = svg("path", part);
      arrow(shape, x0, -y0, x1 - x0, y0 - y1, head);
      return shape;
    }
    if (form.text) return svg("text", { class: "note", x: form.text[0], y: -form.text[1] }, form.text[2]);
    return null;
  };
  const trailTo = (last) => {
    const points = drawings.slice(0, last + 1).flatMap(({ trail }) => (trail ? [[trail[0], -trail[1]]] : []));
    return svg("path", { class: "trail", d: line(points) });
  };
  const draw = (i) => {
    const { shapes } = drawings[at(i)];
    const body = shapes.findIndex((shape) => shape.class === "body");
    const parts = shapes.map(shown);
    parts.splice(body < 0 ? parts.length : body, 0, trailTo(at(i)));
    element.replaceChildren(...parts.filter((part) => part !== null));
  };
  return { element, draw };
}

/** The scene of an episode with pictures of its own. */
function ownScene({ pictures, steps, stride }) {
  const count = Math.max(pictures.images.length, pictures.drawings.length);
  const at = (i) => {
    const step = Math.min(i * stride, steps);
    return step === steps ? count - 1 : Math.min(count - 1, Math.floor(step / pictures.stride));
  };
  return pictures.images.length ? imageScene(pictures.images, at) : drawingScene(pictures.drawings, at);
}
