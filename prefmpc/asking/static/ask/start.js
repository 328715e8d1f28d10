// On the page of the book: the three masses. In a file of its own: the plant that it holds.
(function (ask) {
  "use strict";
  const root = document.getElementById("ask"), held = document.getElementById("ask-config");
  if (!root) return;
  if (!held) {
    ask.mount(root, ask.masses());
    return;
  }
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const shade = () => { document.documentElement.dataset.theme = dark.matches ? "dark" : "light"; };
  shade();
  dark.addEventListener("change", shade);
  const config = ask.plant.limited(JSON.parse(held.textContent));
  ask.mount(root, config, { storage: config.storage });
})(globalThis.prefmpcAsk);
