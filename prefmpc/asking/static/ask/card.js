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

  // The signals of a plot over time: states and outputs at N + 1 times, inputs held in N steps.
  function rows(plot, { x, u, y }, config) {
    const all = { x, u, y: config.C ? x.map((state) => ask.linalg.times(config.C, state)) : y };
    return all[plot.signal].map((row) => plot.index.map((i) => row[i]));
  }

  const short = (value) => String(Number(value.toPrecision(2)));

  // Words for those who do not see the curves; reach: the limits of the axes.
  function description(trajectory, config, reach) {
    const steps = trajectory.u.length;
    const words = config.plots.flatMap((plot, p) => plot.names.map((name, i) => {
      const values = rows(plot, trajectory, config).slice(0, steps).map((row) => row[i]);
      if (plot.signal === "u") return `largest ${name} ${short(largest([values]))}`;
      const near = plot.near ?? 0.05 * reach[p];
      const last = values.findLastIndex((value) => Math.abs(value) > near) + 1;
      const when = last < steps ? `after ${short(last * config.dt)} s` : "not to the end";
      return `${name} starts at ${short(values[0])} and stays within ${short(near)}: ${when}`;
    }));
    return `${words.join("; ")}.`;
  }

  // side: "first" or "second". Returns {element, button, show(trajectory, reach), move(share), flash()}.
  function card(side, config, id, choose) {
    const name = side === "first" ? "Left" : "Right", arrow = side === "first" ? "←" : "→";
    const scene = config.draw ? ask.draw.scenes[config.draw]() : null;
    const end = config.plots.length - 1; // under the last one stands the time
    const charts = config.plots.map((plot, i) => chart(
      { ...plot, step: plot.signal === "u" }, `${id}-${side}-${i}`, i === end ? 152 : 158, i === end));
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
      charts.forEach((c, i) =>
        c.show(rows(config.plots[i], trajectory, config), reach[i], trajectory.u.length, config.dt));
      words.textContent = description(trajectory, config, reach);
    }

    // share: of the whole time, from 0 to 1.
    function move(share) {
      if (!shown) return;
      const { x, u } = shown, place = share * u.length;
      for (const c of charts) c.move(share);
      if (scene) scene.move(between(x, place), u[Math.min(Math.floor(place), u.length - 1)], share);
    }

    function flash() {
      made.classList.remove("ask-chosen");
      void made.offsetWidth; // so that the animation starts again
      made.classList.add("ask-chosen");
    }
    return { element: made, button, show, move, flash };
  }

  // Common limits of the axes of both sides, one for each plot: of inputs those that the plant has.
  function reach(question, config) {
    const sides = [question.first, question.second];
    return config.plots.map((plot) => {
      const limits = plot.index.flatMap((i) => [config.uMax[i], -config.uMin[i]]).filter(Number.isFinite);
      const limit = plot.signal === "u" ? Math.max(...limits, 0) : 0;
      return limit || above(Math.max(...sides.map((side) => largest(rows(plot, side, config)))));
    });
  }

  ask.card = { card, description, element, reach };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
