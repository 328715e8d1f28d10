// On the page of the book: the three masses.
(function (ask) {
  "use strict";
  const root = document.getElementById("ask");
  if (root) ask.mount(root, ask.masses());
})(globalThis.prefmpcAsk);
