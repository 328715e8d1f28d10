// The front end's elements, without behaviour: what page.js fills and listens to.
(function (ask) {
  "use strict";
  const { element } = ask.card;
  const { percent, progress, sureness } = ask.words;

  const hidden = (text) => element("span", { class: "ask-hidden" }, text);
  const key = (text) => element("kbd", { "aria-hidden": "true" }, text);

  // actions: {answer(value), undo, toggle, again, stop, test, more, visit, forget or null, save, copy}.
  function view(root, config, actions) {
    const id = root.id || "ask", on = (action) => () => actions[action]();
    const button = (action, label, ...more) =>
      element("button", { type: "button", class: `ask-button ask-${action}`, onclick: on(action) }, ...more, label);
    const cards = ["first", "second"].map((side) =>
      ask.card.card(side, config, id, () => actions.answer(side)));
    const parts = {
      title: element("p", { class: "ask-title", id: `${id}-title` }),
      count: element("p", { class: "ask-count" }),
      play: button("toggle", ""), again: button("again", "Repeat"),
      same: element("button", { type: "button", class: "ask-button ask-same", onclick: () => actions.answer(0.5) }, key("↓"), "No difference"),
      undo: button("undo", "Undo", key("⌫")),
      over: element("div", { class: "ask-over", hidden: "" }),
      sure: element("p", { class: "ask-sure" }),
      meter: element("div", { class: "ask-meter", role: "meter", "aria-label": "How sure the page is", "aria-valuemin": 0, "aria-valuemax": 100 }, element("div", { class: "ask-fill" })),
      say: element("p", { class: "ask-hidden", "aria-live": "polite", role: "status" }),
      weights: element("div", { class: "ask-weights" }),
      stop: button("stop", "Stop and test me"), visit: button("visit", "Watch a simulated visitor"),
      forget: button("forget", "Forget everything"), save: button("save", "Download the answers"),
      copy: button("copy", "Copy"), banner: element("p", { class: "ask-banner", hidden: "" }),
    };
    const named = config.plots.filter((plot) => plot.legend), many = named.length > 1;
    const legend = element("p", { class: "ask-legend", "aria-hidden": "true" }, ...named.flatMap((plot) => [
      ...(many ? [`${plot.label}:`] : []),
      ...plot.names.map((name, i) => element("span", {}, element("i", { class: `ask-swatch ask-${plot.colours[i]}` }), name))]));
    const stage = element("div", { class: "ask-stage", role: "group", tabindex: "-1", "aria-labelledby": `${id}-title` },
      ...cards.map((card) => card.element), parts.over);
    root.replaceChildren(
      element("div", { class: "ask-head" }, parts.title, parts.count),
      legend, stage,
      element("div", { class: "ask-controls" }, parts.play, parts.again, parts.same, parts.undo),
      element("div", { class: "ask-knowledge" }, parts.meter, parts.sure), parts.banner, parts.say,
      element("details", { class: "ask-details" }, element("summary", {}, "What I think you weigh"), parts.weights),
      element("details", { class: "ask-details" }, element("summary", {}, "Take the answers with you"),
        element("p", {}, "Each line of the file is one answer with its whole question. These lines of Python load it, fit the weights again and run the controller:"),
        element("pre", { class: "ask-code", tabindex: "0", "aria-label": "Python code" }, element("code", {}, config.code)),
        element("p", { class: "ask-row" }, parts.save, parts.copy)),
      element("p", { class: "ask-row" }, parts.stop, ...(config.visitor ? [parts.visit] : []), ...(actions.forget ? [parts.forget] : [])));
    root.classList.add("ask-ready");
    return { ...parts, root, stage, cards, button };
  }

  // The message that covers the two responses: text and buttons; null takes it away.
  function cover(v, texts, buttons = []) {
    v.over.hidden = texts === null;
    for (const card of v.cards) card.element.inert = texts !== null;
    if (texts === null) return;
    v.over.replaceChildren(element("div", { class: "ask-message" },
      ...texts.map((text, i) => element("p", i ? {} : { class: "ask-lead" }, text)),
      element("p", { class: "ask-row" }, ...buttons)));
  }

  function know(v, state) {
    v.sure.textContent = sureness(state);
    const share = progress(state);
    v.meter.firstChild.style.transform = `scaleX(${share})`;
    v.meter.setAttribute("aria-valuenow", Math.round(100 * share));
    v.meter.setAttribute("aria-valuetext", sureness(state));
  }

  // A bar for each weight on a logarithmic axis from 1/100 to 100 times the default.
  function weights(v, state, standard) {
    const place = (ratio) => 50 + 25 * Math.log10(Math.min(Math.max(ratio, 0.01), 100));
    const rows = state.weights.map(({ name, unit, weight, ratio, low, high }) => {
      const bar = element("div", { class: "ask-bar", "aria-hidden": "true" }, element("i"), element("b"));
      const [range, dot] = bar.children;
      range.style.left = `${place(low)}%`;
      range.style.width = `${place(high) - place(low)}%`;
      dot.style.left = `${place(ratio)}%`;
      const times = `× ${ratio.toPrecision(2)}`, interval = `${low.toPrecision(2)} to ${high.toPrecision(2)}`;
      return element("tr", {}, element("th", { scope: "row" }, name), element("td", {}, bar, hidden(interval)),
        element("td", {}, times), element("td", {}, `${weight.toPrecision(3)} ${unit}`));
    });
    const scale = ["0.01", "0.1", "1", "10", "100"].map((text) => element("span", {}, text));
    const heads = ["weight of the squared", element("span", { class: "ask-scale" }, ...scale), "times default", "in σ"];
    v.weights.replaceChildren(
      element("p", {}, `Each weight compared with ${standard} (the middle), after division by what all have in common, on which no controller depends. The bar holds 90 % of what your answers leave possible.`),
      element("table", {}, element("thead", {}, element("tr", {}, ...heads.map((text) => element("th", { scope: "col" }, text)))), element("tbody", {}, ...rows)));
  }

  ask.view = { cover, know, view, weights };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
