// An interviewer that lives elsewhere (see interview.js): every call is a message, and each reply
// names the call that it answers.
(function (ask) {
  "use strict";

  const PATIENCE = 4000; // so many ms without a reply are worth a word

  // model: {send(message), on("msg:custom", listener), off(…)}, as anywidget has it.
  // waiting(whether): called when a reply is late, and when it is there.
  function interviewer(model, waiting = () => {}) {
    const own = `${ask.random.seed()}-${ask.random.seed()}`, open = new Map();
    const later = globalThis.setTimeout || (() => 0), never = globalThis.clearTimeout || (() => {});
    let number = 0, count = 0; // count: of answers, when the open question was made

    function receive(message) {
      const call = open.get(message?.reply);
      if (!call) return; // of another view of the same session
      open.delete(message.reply);
      never(call.timer);
      if (!open.size) waiting(false);
      if ("error" in message) call.reject(new Error(message.error));
      else call.resolve(message.result);
    }

    function send(name, given = {}) {
      const id = `${own}-${(number += 1)}`;
      return new Promise((resolve, reject) => {
        open.set(id, { resolve, reject, timer: later(() => waiting(true), PATIENCE) });
        model.send({ ...given, call: name, id });
      });
    }

    async function known(name, given) {
      const state = await send(name, given);
      count = state.count;
      return state;
    }

    model.on("msg:custom", receive);
    return {
      async next() {
        const question = await send("next");
        count = question.number;
        return question;
      },
      // Whoever is late, because somebody else has answered, learns how things stand.
      answer: (value) => known("answer", { value, number: count }),
      undo: () => known("undo", { number: count }),
      progress: () => known("progress"),
      trial: (pairs) => send("trial", { count: pairs }),
      judge: (given) => send("judge", given),
      log: () => send("log"),
      close: () => model.off("msg:custom", receive),
    };
  }

  ask.remote = { interviewer };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
