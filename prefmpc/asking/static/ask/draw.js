// Pictures: curves over time with a moving cursor, and the three masses. All colours are classes.
(function (ask) {
  "use strict";

  function svg(tag, attributes = {}, ...children) {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  }

  // The signals between two samples, as a smooth curve through all (Catmull and Rom).
  function between(rows, place) {
    const last = rows.length - 1, k = Math.min(Math.floor(place), last), t = place - k;
    const [a, b, c, d] = [k - 1, k, k + 1, k + 2].map((i) => rows[Math.min(Math.max(i, 0), last)]);
    return b.map((value, i) => value + 0.5 * t * (c[i] - a[i] + t * (2 * a[i] - 5 * value
      + 4 * c[i] - d[i] + t * (3 * (value - c[i]) + d[i] - a[i]))));
  }

  // Between ticks: 1, 2, 5, 10, … so that there are at most six.
  function spacing(length) {
    const unit = 10 ** Math.floor(Math.log10(length / 5));
    return [1, 2, 5, 10].find((m) => m * unit * 5.000001 >= length) * unit;
  }

  const LEFT = 62, RIGHT = 474, WIDTH = 480, FINE = 5;

  // A long text is written in so much room.
  const squeezed = (text, room) =>
    (text.length * 8 > room ? { textLength: room, lengthAdjust: "spacingAndGlyphs" } : {});

  // One set of axes. kind: {label, names, step: held between the samples}. Returns
  // {element, show(rows, reach, steps, dt), move(share)}.
  function chart(kind, id, height, last) {
    const top = 10, bottom = height - (last ? 42 : 10), middle = (top + bottom) / 2;
    const box = { x: LEFT, y: top, width: RIGHT - LEFT, height: bottom - top };
    const clip = svg("rect", { ...box, width: 0 });
    const cursor = svg("line", { class: "ask-cursor", x1: LEFT, x2: LEFT, y1: top, y2: bottom });
    const upper = svg("text", { class: "ask-tick", x: LEFT - 6, y: top + 12 });
    const lower = svg("text", { class: "ask-tick", x: LEFT - 6, y: bottom });
    const lines = (shade) => kind.names.map((_, i) =>
      svg("polyline", { class: `ask-line ask-${kind.colours[i]} ${shade}` }));
    const faint = lines("ask-faint"), bright = lines("");
    const times = svg("g");
    const element = svg("svg", { viewBox: `0 0 ${WIDTH} ${height}`, class: "ask-chart", "aria-hidden": "true" },
      svg("clipPath", { id }, clip),
      svg("rect", { ...box, class: "ask-box" }),
      svg("line", { class: "ask-zero", x1: LEFT, x2: RIGHT, y1: middle, y2: middle }),
      upper, svg("text", { class: "ask-tick", x: LEFT - 6, y: middle + 5 }, "0"), lower, times,
      svg("text", { class: "ask-axis", transform: `translate(15 ${middle}) rotate(-90)`, ...squeezed(kind.label, bottom - top) }, kind.label),
      ...faint, svg("g", { "clip-path": `url(#${id})` }, ...bright), cursor);

    function show(rows, reach, steps, dt) {
      const at = (k) => LEFT + (k / steps) * (RIGHT - LEFT);
      const up = (value) => middle - (value / reach) * (middle - top);
      const number = reach.toPrecision(2).replace(/\.?0+$/, "");
      [upper.textContent, lower.textContent] = [number, `−${number}`];
      kind.names.forEach((_, i) => {
        const points = [];
        if (kind.step) {
          rows.forEach((row, k) => points.push([at(k), up(row[i])], [at(k + 1), up(row[i])]));
        } else {
          for (let k = 0; k <= steps * FINE; k++) {
            points.push([at(k / FINE), up(between(rows, k / FINE)[i])]);
          }
        }
        const text = points.map(([x, y]) => `${x.toFixed(1)},${y.toFixed(1)}`).join(" ");
        faint[i].setAttribute("points", text);
        bright[i].setAttribute("points", text);
      });
      if (!last) return;
      const every = spacing(steps * dt);
      const ticks = [];
      for (let i = 0; i * every <= steps * dt * (1 + 1e-9); i++) {
        const text = String(Number((i * every).toPrecision(6)));
        ticks.push(svg("text", { class: "ask-tick ask-time", x: at((i * every) / dt), y: bottom + 18 }, text));
      }
      const name = { class: "ask-tick ask-time", x: (LEFT + RIGHT) / 2, y: height - 2 };
      times.replaceChildren(...ticks, svg("text", name, "time in s"));
    }

    function move(share) {
      clip.setAttribute("width", share * box.width);
      cursor.setAttribute("transform", `translate(${share * box.width} 0)`);
    }
    return { element, show, move };
  }

  // ---- the three masses ----

  const SCALE = 135, REST = [140, 260, 380], SIZE = [54, 40, 54], FLOOR = 92;
  const WALLS = [12, 508];

  // A spring from 0 to 1, to be stretched.
  const COIL = "M0 0H.1" + [...Array(8)].map((_, i) =>
    `L${(0.1 + 0.1 * (i + 0.5)).toFixed(2)} ${i % 2 ? 7 : -7}`).join("") + "L.9 0H1";

  // A drawing is {element, move(x, u, share)}: x and u between the samples, share of the time.
  function masses() {
    const springs = [0, 1, 2, 3].map(() =>
      svg("path", { class: "ask-spring", d: COIL, "vector-effect": "non-scaling-stroke" }));
    const blocks = SIZE.map((size, i) => svg("g", {},
      svg("rect", { class: `ask-mass ask-${i}`, x: -size / 2, y: FLOOR - size, width: size, height: size, rx: 5 }),
      svg("text", { class: "ask-number", y: FLOOR - size / 2 + 7 }, `${i + 1}`)));
    const arrows = [0, 2].map((i) => svg("path", { class: `ask-force ask-${i}` }));
    const element = svg("svg", { viewBox: "0 0 520 104", class: "ask-scene", "aria-hidden": "true" },
      ...WALLS.map((x, i) => svg("rect", { class: "ask-wall", x: i ? x : x - 8, y: 18, width: 8, height: FLOOR - 18 })),
      svg("line", { class: "ask-floor", x1: 4, x2: 516, y1: FLOOR + 1, y2: FLOOR + 1 }),
      ...REST.map((x) => svg("line", { class: "ask-rest", x1: x, x2: x, y1: FLOOR + 2, y2: FLOOR + 10 })),
      ...springs, ...blocks, ...arrows);

    function move(x, u) {
      const at = REST.map((rest, i) => rest + SCALE * x[i]);
      blocks.forEach((block, i) => block.setAttribute("transform", `translate(${at[i].toFixed(2)} 0)`));
      const ends = [WALLS[0], ...at.flatMap((c, i) => [c - SIZE[i] / 2, c + SIZE[i] / 2]), WALLS[1]];
      springs.forEach((spring, i) => {
        const [from, to] = [ends[2 * i], ends[2 * i + 1]];
        spring.setAttribute("transform", `translate(${from.toFixed(2)} ${FLOOR - 20}) scale(${(to - from).toFixed(2)} 1)`);
      });
      arrows.forEach((arrow, j) => arrow.setAttribute("d", pointer(at[2 * j], u[j])));
    }
    return { element, move };
  }

  // An arrow above a mass, as long as the force is large.
  function pointer(from, force, y = 20) {
    const to = from + 52 * force, sign = Math.sign(force);
    const head = Math.min(8, Math.abs(to - from));
    if (head < 3) return "";
    return `M${from.toFixed(1)} ${y}H${to.toFixed(1)}m${-sign * head} -5l${sign * head} 5l${-sign * head} 5`;
  }

  ask.draw = { between, chart, pointer, scenes: { masses }, svg };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
