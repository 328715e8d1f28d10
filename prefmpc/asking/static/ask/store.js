// What a reload must not lose, and how answers leave the page.
(function (ask) {
  "use strict";

  // A place for one text; where there is no local storage, nothing is kept.
  function store(name) {
    const guarded = (action) => {
      try {
        return action(localStorage);
      } catch {
        return null;
      }
    };
    return {
      read: () => guarded((place) => JSON.parse(place.getItem(name))),
      write: (value) => guarded((place) => place.setItem(name, JSON.stringify(value))),
      forget: () => guarded((place) => place.removeItem(name)),
    };
  }

  const nowhere = { read: () => null, write() {}, forget() {} };

  function download(name, text) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type: "application/jsonl" }));
    link.download = name;
    document.body.append(link);
    link.click();
    link.remove();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }

  // Whether a text could be put on the clipboard; from file:// the older way works.
  async function copy(text) {
    try {
      await navigator.clipboard.writeText(text);
      return true;
    } catch {
      const area = document.createElement("textarea");
      area.value = text;
      document.body.append(area);
      area.select();
      const done = document.execCommand("copy");
      area.remove();
      return done;
    }
  }

  ask.store = { copy, download, nowhere, store };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
