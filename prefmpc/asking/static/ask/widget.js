// The front end in a notebook, as an anywidget: the interviewer lives in Python.
const ask = globalThis.prefmpcAsk;

const LATE = "Python does not reply: it is busy, or has been stopped. Whatever you choose now is not written down yet. After a restart, run the cell again: all answers up to here are kept.";

function render({ model, el }) {
  const root = document.createElement("div");
  root.className = "ask";
  root.id = `ask-${ask.random.seed()}`;
  root.dataset.lmSuppressShortcuts = "true"; // the keys here are not the notebook's
  el.append(root);
  let shown = null;
  const interviewer = ask.remote.interviewer(model, (late) => shown?.say(late ? LATE : ""));
  shown = ask.mount(root, ask.plant.limited(model.get("config")), {
    interviewer: async () => interviewer, storage: null, anywhere: false, notice: model.get("notice"),
  });
  return () => {
    shown.unmount();
    interviewer.close();
  };
}

export default { render };
