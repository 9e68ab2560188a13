/* Pictures of an episode, by the `kind` of the environment's `Picture` (env-server). Each reads the episode's signals by their
   keys. `draw(i)` shows frame i. */

/** Draws an arrow from (x, y) by (dx, dy), or nothing if it is too short to be seen. */
function arrow(shape, x, y, dx, dy, head) {
  const length = Math.hypot(dx, dy);
  if (!(length > head * 0.2)) return set(shape, { d: "" });
  head = Math.min(head, length * 0.6);
  const [ux, uy] = [dx / length, dy / length];
  const tip = [x + dx, y + dy];
  const wing = (side) => `${tip[0] - head * ux + side * head * 0.6 * uy} ${tip[1] - head * uy - side * head * 0.6 * ux}`;
  return set(shape, { d: `M${x} ${y}L${tip.join(" ")}M${wing(1)}L${tip.join(" ")}L${wing(-1)}` });
}

const line = (points) => (points.length ? `M${points.map(([x, y]) => `${x.toFixed(3)} ${y.toFixed(3)}`).join("L")}` : "");

function drawing(box, label, ...parts) {
  const width = Number(box.split(" ")[2]);
  return svg("svg", { viewBox: box, role: "img", "aria-label": label, class: "scene", "font-size": width * 0.035 }, ...parts);
}

const SCENES = {
  rod(picture, signals) {
    const angles = signals.angle.values;
    const torques = signals.torque.values;
    const greatest = signals.torque.range[1];
    // Upright is 0; angles increase counterclockwise.
    const bob = (i) => [-Math.sin(angles[i]), -Math.cos(angles[i])];
    const trail = svg("path", { class: "trail" });
    const rod = svg("line", { class: "rod", x1: 0, y1: 0 });
    const weight = svg("circle", { class: "body", r: 0.11, "data-part": "moves" });
    const torque = svg("path", { class: "force" });
    const caption = svg("text", { class: "note", x: -1.55, y: 1.5 });
    const element = drawing(
      "-1.6 -1.3 3.2 2.9",
      "The pendulum; the arc at the joint is the torque",
      svg("circle", { class: "guide", r: 1 }),
      svg("line", { class: "guide", x1: 0, y1: -1.2, x2: 0, y2: -1.05 }),
      trail,
      rod,
      weight,
      torque,
      svg("circle", { class: "joint", r: 0.05 }),
      caption,
    );
    const draw = (i) => {
      const [x, y] = bob(i);
      set(rod, { x2: x, y2: y });
      set(weight, { cx: x, cy: y });
      set(trail, { d: line(Array.from({ length: Math.min(i, 25) + 1 }, (_, back) => bob(i - back))) });
      const share = (torques[i] ?? 0) / greatest;
      const [radius, turn] = [0.32, Math.min(1, Math.abs(share)) * 2.4];
      const at = (angle) => [-Math.sin(angle) * radius, -Math.cos(angle) * radius];
      const end = at(Math.sign(share) * turn);
      const along = Math.sign(share) * turn;
      const tangent = [-Math.cos(along) * Math.sign(share), Math.sin(along) * Math.sign(share)];
      if (turn < 0.05) set(torque, { d: "" });
      else {
        // The arrowhead follows the arc and is never longer than it.
        const length = Math.min(0.16, radius * turn);
        arrow(torque, end[0] - tangent[0] * length, end[1] - tangent[1] * length, tangent[0] * length, tangent[1] * length, 0.12);
        set(torque, { d: torque.getAttribute("d").replace(/^M[^L]*L[^M]*/, "") });
        const arc = `M${at(0).join(" ")}A${radius} ${radius} 0 0 ${share > 0 ? 0 : 1} ${end.join(" ")}`;
        set(torque, { d: arc + torque.getAttribute("d") });
      }
      caption.textContent = `torque ${text(torques[i])} N m`;
    };
    return { element, draw };
  },

  plane(picture, signals) {
    const [xs, ys] = [signals.x.values, signals.y.values];
    const [forces, directions] = [signals.force.values, signals.direction.values];
    const [wall, greatest] = [signals.x.range[1], signals.force.range[1]];
    const place = (i) => [xs[i], -ys[i]];
    const all = xs.map((_, i) => place(i));
    const grid = svg("g", { class: "grid" });
    for (const at of ticks(-wall, wall, 8)) {
      grid.append(svg("line", { x1: at, x2: at, y1: -wall, y2: wall }), svg("line", { x1: -wall, x2: wall, y1: at, y2: at }));
    }
    const label = (x, y, words, anchor) => svg("text", { class: "note", x, y, "text-anchor": anchor }, words);
    const vehicle = svg("circle", { class: "body", r: wall * 0.045, "data-part": "moves" });
    const done = svg("path", { class: "trail" });
    const force = svg("path", { class: "force" });
    const caption = label(-wall, wall * 1.1, "", "start");
    const element = drawing(
      `${-wall * 1.03} ${-wall * 1.03} ${wall * 2.06} ${wall * 2.2}`,
      "The vehicle from above; the cross is the goal, the arrow the force",
      grid,
      svg("rect", { class: "wall", x: -wall, y: -wall, width: 2 * wall, height: 2 * wall }),
      label(wall * 0.97, -wall * 0.92, `walls at ±${text(wall)} m`, "end"),
      svg("path", { class: "plan", d: line(all) }),
      done,
      svg("path", { class: "goal", d: "M-.16 0H.16M0-.16V.16" }),
      label(wall * 0.05, wall * 0.07, "goal", "start"),
      vehicle,
      force,
      caption,
    );
    const draw = (i) => {
      const [x, y] = place(i);
      set(vehicle, { cx: x, cy: y });
      set(done, { d: line(all.slice(0, i + 1)) });
      const length = ((forces[i] ?? 0) / greatest) * wall * 0.3;
      const angle = directions[i] ?? 0;
      arrow(force, x, y, Math.cos(angle) * length, -Math.sin(angle) * length, wall * 0.05);
      const degrees = Math.round(((angle * 180) / Math.PI + 360) % 360);
      caption.textContent = isNumber(forces[i]) ? `force ${text(forces[i])} N towards ${degrees}°` : "end of the episode";
    };
    return { element, draw };
  },

  cart(picture, signals) {
    const [xs, angles, pushes] = [signals.position.values, signals.angle.values, signals.push.values];
    const { track, pole } = picture;
    const cart = svg("rect", { class: "cart", width: 0.5, height: 0.26, y: -0.26, rx: 0.04 });
    const rod = svg("line", { class: "rod", y1: -0.26 });
    const tip = svg("circle", { class: "body", r: 0.07, "data-part": "moves" });
    const push = svg("path", { class: "force" });
    const caption = svg("text", { class: "note", x: -track, y: 0.45 });
    const end = (x) => svg("line", { class: "wall", x1: x, x2: x, y1: -0.12, y2: 0.12 });
    const element = drawing(
      `${-track - 0.3} ${-pole - 0.5} ${2 * track + 0.6} ${pole + 1.1}`,
      "The cart on its track with the pole; the arrow is the push",
      svg("line", { class: "wall", x1: -track, x2: track, y1: 0, y2: 0 }),
      end(-track),
      end(track),
      cart,
      rod,
      tip,
      push,
      caption,
    );
    const draw = (i) => {
      const x = xs[i];
      set(cart, { x: x - 0.25 });
      const top = [x + pole * Math.sin(angles[i]), -0.26 - pole * Math.cos(angles[i])];
      set(rod, { x1: x, x2: top[0], y2: top[1] });
      set(tip, { cx: top[0], cy: top[1] });
      const side = isNumber(pushes[i]) ? (pushes[i] < 0.5 ? -1 : 1) : 0;
      arrow(push, x + side * 0.27, -0.13, side * 0.4, 0, 0.12);
      caption.textContent = ["push to the left", "end of the episode", "push to the right"][side + 1];
    };
    return { element, draw };
  },

  grid(picture, signals) {
    const [fields, directions] = [signals.field.values, signals.direction.values];
    const side = Math.round(Math.sqrt(picture.map.length));
    const middle = (field) => [(field % side) + 0.5, Math.floor(field / side) + 0.5];
    const names = { S: "start", F: "", H: "hole", G: "goal" };
    const lake = [...picture.map].flatMap((kind, field) => {
      const [x, y] = middle(field);
      return [
        svg("rect", { class: `field ${kind}`, x: x - 0.5, y: y - 0.5, width: 1, height: 1 }),
        svg("text", { class: `note ${kind}`, x: x - 0.44, y: y - 0.3 }, `${field} ${names[kind] ?? ""}`),
      ];
    });
    const trail = svg("path", { class: "trail" });
    const agent = svg("circle", { class: "body", r: 0.16, "data-part": "moves" });
    const intended = svg("path", { class: "force" });
    const caption = svg("text", { class: "note", x: 0, y: side + 0.28 });
    const label = "The lake from above; the dot is the agent, the arrow its action, and it may slip";
    const element = drawing(`-0.05 -0.05 ${side + 0.1} ${side + 0.45}`, label, lake, trail, agent, intended, caption);
    const ways = [[-1, 0, "left"], [0, 1, "down"], [1, 0, "right"], [0, -1, "up"]];
    const draw = (i) => {
      const [x, y] = middle(fields[i]);
      set(agent, { cx: x, cy: y });
      set(trail, { d: line(fields.slice(0, i + 1).map(middle)) });
      const [dx, dy, word] = ways[directions[i]] ?? [0, 0, ""];
      arrow(intended, x + dx * 0.2, y + dy * 0.2, dx * 0.3, dy * 0.3, 0.12);
      caption.textContent = word ? `action: ${word}` : "end of the episode";
    };
    return { element, draw };
  },

  none(picture, signals, { no_pictures }) {
    const reason = no_pictures ?? "This environment has no picture.";
    return { element: html("p", {}, `${reason} The signals are the policy's observations and actions.`), draw() {} };
  },
};
