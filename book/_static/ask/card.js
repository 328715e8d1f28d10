// One response: what moves, its curves, a description in words, and the button that chooses it.
(function (ask) {
  "use strict";
  const { between, chart } = ask.draw;

  function element(tag, attributes = {}, ...children) {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
      else if (name === "class") made.className = value;
      else made.setAttribute(name, value);
    }
    made.append(...children);
    return made;
  }

  const largest = (rows) => Math.max(...rows.flat().map(Math.abs));

  // The next of 1, 2, 5, 10, …, in tenths where that is close: a limit of an axis.
  function above(value) {
    const unit = 10 ** Math.floor(Math.log10(value || 1));
    return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((m) => m * unit >= value) * unit;
  }

  // Words for those who do not see the curves.
  function description(trajectory, config) {
    const { y, u } = trajectory, steps = u.length;
    const outputs = config.outputs.names.map((name, i) => {
      const values = y.map((row) => row[i]), near = config.outputs.near;
      const last = values.findLastIndex((value) => Math.abs(value) > near) + 1;
      const when = last < steps ? `after ${(last * config.dt).toFixed(1)} s` : "not to the end";
      return `${name} starts at ${values[0].toFixed(2)} and stays within ${near}: ${when}`;
    });
    const inputs = config.forces.names.map((name, i) =>
      `largest ${name} ${largest(u.map((row) => [row[i]])).toFixed(2)}`);
    return `${[...outputs, ...inputs].join("; ")}.`;
  }

  // side: "first" or "second". Returns {element, button, show(trajectory, reach), move(share), flash()}.
  function card(side, config, id, choose) {
    const name = side === "first" ? "Left" : "Right", arrow = side === "first" ? "←" : "→";
    const scene = config.draw ? config.draw() : null;
    const charts = [
      chart(config.outputs, `${id}-${side}-y`, 158, false),
      chart({ ...config.forces, step: true }, `${id}-${side}-u`, 152, true),
    ];
    const words = element("p", { class: "ask-hidden", id: `${id}-${side}-words` });
    const button = element("button", {
      type: "button", class: "ask-choose", "data-answer": side, "aria-describedby": words.id, onclick: choose,
    }, element("kbd", { "aria-hidden": "true" }, arrow), ` I prefer this one`,
    element("span", { class: "ask-hidden" }, `: ${name.toLowerCase()}`));
    const picture = element("div", { class: "ask-picture" },
      ...(scene ? [scene.element] : []), ...charts.map((c) => c.element));
    const made = element("section", { class: "ask-card", "aria-label": `${name} response` }, picture, words, button);
    let shown = null;

    function show(trajectory, reach) {
      shown = trajectory;
      const { x, u } = trajectory;
      const y = x.map((state) => ask.linalg.times(config.C, state));
      charts[0].show(y, reach[0], u.length, config.dt);
      charts[1].show(u, reach[1], u.length, config.dt);
      words.textContent = description(trajectory, config);
    }

    // share: of the whole time, from 0 to 1.
    function move(share) {
      if (!shown) return;
      const { x, u } = shown, place = share * u.length;
      for (const c of charts) c.move(share);
      if (scene) scene.move(between(x, place), u[Math.min(Math.floor(place), u.length - 1)]);
    }

    function flash() {
      made.classList.remove("ask-chosen");
      void made.offsetWidth; // so that the animation starts again
      made.classList.add("ask-chosen");
    }
    return { element: made, button, show, move, flash };
  }

  // Common limits of the axes of both sides.
  function reach(question, config) {
    const sides = [question.first, question.second];
    const y = Math.max(...sides.map(({ x }) => largest(x.map((s) => ask.linalg.times(config.C, s)))));
    const u = Math.max(...sides.map((side) => largest(side.u)));
    const limit = Math.max(...config.uMax.concat(config.uMin.map((v) => -v)).filter(Number.isFinite), 0);
    return [above(y), limit || above(u)];
  }

  ask.card = { card, description, element, reach };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
