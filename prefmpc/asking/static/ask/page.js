// The front end: shows an interviewer's questions, takes the answers, and holds the blind test.
//
// prefmpcAsk.mount(root, config, given) puts it into an element. given (all optional):
//   interviewer(log)  makes one (see interview.js) that goes on from a log, or begins anew
//   storage           a name under which the session is kept, null for none
//   seed              of the session, unless config.log holds one that was begun
//   anywhere          whether some keys count while the focus is nowhere (default: true)
//   notice            to be read before the first answer
(function (ask) {
  "use strict";
  const { cover, know, view, weights } = ask.view;
  const { resting, test: announced, verdict } = ask.words;
  const { still } = ask.player;

  const PAIRS = 10;
  const PACE = 900; // a simulated visitor takes so many ms for an answer

  function mount(root, config, given = {}) {
    const begin = given.interviewer ||
      ((log = config.log) => ask.interview.interviewer(config, log ? { log } : { seed: given.seed }));
    const place = given.storage === null ? ask.store.nowhere :
      ask.store.store(given.storage || `prefmpc: ${config.name}`);
    const anywhere = given.anywhere !== false;
    const doing = (action) => () => act(action);
    const actions = {
      answer, again, save, copy, toggle: () => clock.toggle(), undo: doing(undo), stop: doing(stop),
      test: doing(test), more: doing(more), visit: doing(visit),
      forget: given.storage === null ? null : doing(forget),
    };
    const v = view(root, config, actions);
    const duration = (config.method?.steps ?? ask.interview.DEFAULTS.steps) * config.dt;
    const clock = ask.player.player(duration, (share) => v.cards.forEach((card) => card.move(share)), playing);
    let session, own = null, busy = true, timer = 0, shown = null, notice = given.notice || "";

    // A session: {interviewer, person (of a simulated visitor), phase, pairs, answers, number, tests,
    // more, state}; number: of answers when the blind test was made, tests: the log of those before.
    async function open(kept, person = null) {
      session = {
        interviewer: await begin(kept?.log), person, phase: kept?.phase || "asking",
        pairs: kept?.pairs || [], answers: kept?.answers || [], number: kept?.number || 0,
        tests: kept?.tests || "", more: kept?.more || false,
      };
      session.state = await session.interviewer.progress();
    }

    async function keep() {
      if (session.person || given.storage === null) return;
      const { phase, pairs, answers, number, tests, more } = session;
      place.write({ log: await session.interviewer.log(), phase, pairs, answers, number, tests, more });
    }

    // ---- what is shown ----

    async function show() {
      const { phase, state, person } = session;
      know(v, state);
      weights(v, state, config.standard);
      say(person ? "A simulated visitor answers, with the weights of the paper’s first case study. Your own answers are put aside." : notice);
      v.visit.lastChild.textContent = person ? "Stop watching" : "Watch a simulated visitor";
      v.stop.disabled = phase !== "asking" || !state.count || Boolean(person);
      v.forget.disabled = Boolean(person);
      v.save.disabled = !state.count;
      v.undo.disabled = phase === "trial" || phase === "done" ? !session.answers.length : !state.count;
      for (const button of [v.same, ...v.cards.map((card) => card.button)]) button.disabled = !asking();
      if (phase === "trial") await trial();
      else if (phase === "asking") await question();
      else if (phase === "rest") rest();
      else done();
      visitorsTurn();
    }

    function say(text) {
      v.banner.hidden = !text;
      v.banner.textContent = text;
    }

    // What went wrong is said, and nothing else changes.
    function complain(error) {
      console.error(error);
      notice = `That did not work: ${error.message}`;
      say(notice);
      v.say.textContent = notice;
    }

    const asking = () => session.phase === "asking" || session.phase === "trial";

    async function question() {
      const next = await session.interviewer.next();
      cover(v, null);
      v.title.textContent = "Which one do you prefer?";
      v.count.textContent = `Question ${session.state.count + 1}`;
      present(next);
    }

    function trial() {
      cover(v, null);
      v.title.textContent = "Blind test: which one do you prefer?";
      v.count.textContent = `Pair ${session.answers.length + 1} of ${session.pairs.length}`;
      present(session.pairs[session.answers.length]);
    }

    async function rest() {
      v.title.textContent = session.state.enough ? "I know enough" : "That is enough";
      v.count.textContent = "";
      const texts = [resting(session.state), announced(config.standard)];
      if (!shown) present(await session.interviewer.next());
      finish(texts, [v.button("test", "Start the blind test"), v.button("more", "Ask me more")]);
    }

    function done() {
      v.title.textContent = "The blind test is over";
      v.count.textContent = "";
      if (!shown) present(session.pairs.at(-1));
      finish([verdict(ask.blind.verdict(session.pairs, session.answers))],
        [v.button("save", "Download the answers"), v.button("test", "Test again"), v.button("more", "Ask me more")]);
    }

    function finish(texts, buttons) {
      clock.pause();
      clock.to(1);
      const inside = root.contains(document.activeElement);
      cover(v, texts, session.person ? [] : buttons);
      if (inside && !session.person) {
        v.over.firstChild.scrollIntoView({ block: "nearest" });
        v.over.querySelector("button").focus({ preventScroll: true });
      }
      v.say.textContent = texts.join(" ");
    }

    function present(pair) {
      shown = pair;
      const reach = ask.card.reach(pair, config);
      v.cards.forEach((card, i) => card.show(i ? pair.second : pair.first, reach));
      clock.to(still() ? 1 : 0);
      if (!still() && asking()) clock.play();
      v.say.textContent = `${v.count.textContent}. ${session.state.count ? v.sure.textContent : v.title.textContent}`;
      root.dispatchEvent(new CustomEvent("ask-question", { detail: pair, bubbles: true }));
    }

    function playing(on, ended) {
      v.play.lastChild.textContent = on ? "Pause" : ended ? "Play again" : "Play";
      v.play.classList.toggle("ask-playing", on);
    }

    function again() {
      clock.to(0);
      clock.play();
    }

    // ---- what is done ----

    // One thing at a time: what comes while another is computed is dropped.
    async function act(action) {
      if (busy) return;
      busy = true;
      notice = "";
      try {
        await action();
        await show();
        await keep();
      } catch (error) {
        complain(error);
      } finally {
        busy = false;
      }
    }

    function answer(value) {
      if (busy || !asking()) return;
      v.cards.forEach((card, i) => { if (value === ["first", "second"][i]) card.flash(); });
      act(async () => {
        if (session.phase === "trial") {
          await judged(value);
          session.answers.push(value);
          if (session.answers.length === session.pairs.length) session.phase = "done";
          return;
        }
        session.state = await session.interviewer.answer(value);
        const { enough, count, most } = session.state;
        if ((enough || count >= most) && !session.more) session.phase = "rest";
      });
    }

    async function undo() {
      if (session.phase === "trial" || session.phase === "done") {
        if (!session.answers.length) return;
        const last = session.answers.pop();
        await judged(null).catch((error) => {
          session.answers.push(last);
          throw error;
        });
        session.phase = "trial";
      } else if (session.state.count) {
        session.state = await session.interviewer.undo();
        session.phase = "asking";
      }
    }

    // An interviewer that writes elsewhere learns at once what is said of a pair of the blind test.
    async function judged(value) {
      const { interviewer, answers, number } = session;
      await interviewer.judge?.({ count: PAIRS, pair: answers.length, number, value });
    }

    const tested = () => session.tests + ask.blind.lines(session.pairs, session.answers, session.number);

    async function stop() {
      session.phase = "rest";
    }

    async function test() {
      const pairs = await session.interviewer.trial(PAIRS), tests = tested();
      Object.assign(session, { pairs, answers: [], number: session.state.count, tests });
      session.phase = "trial";
      focus();
    }

    async function more() {
      session.phase = "asking";
      session.more = true;
      focus();
    }

    async function forget() {
      place.forget();
      await open(null);
    }

    // A simulated visitor has a session of its own, which nobody keeps.
    async function visit() {
      clearTimeout(timer);
      if (session.person) {
        session = own;
        shown = null;
        return;
      }
      own = session;
      await open(null, ask.blind.visitor(config.visitor));
    }

    function visitorsTurn() {
      clearTimeout(timer);
      const { person, phase } = session, mine = session;
      if (!person || phase === "done") return;
      timer = setTimeout(async () => {
        if (session !== mine) return;
        if (phase === "rest") act(test);
        else answer(await person(shown));
      }, phase === "rest" ? 4 * PACE : PACE);
    }

    async function save() {
      ask.store.download("answers.jsonl", await session.interviewer.log() + tested());
    }

    async function copy() {
      const done = await ask.store.copy(config.code);
      v.copy.lastChild.textContent = done ? "Copied" : "Select the lines to copy them";
      setTimeout(() => { v.copy.lastChild.textContent = "Copy"; }, 2000);
    }

    const focus = () => v.stage.focus({ preventScroll: true });

    // Keys count while the focus is here. The ones that do not scroll also count while it is
    // nowhere.
    function pressed(event) {
      const at = event.target, inside = root.contains(at);
      if (event.ctrlKey || event.metaKey || event.altKey || event.shiftKey) return;
      if (session?.person || at.closest("input, textarea, select, pre, [contenteditable]")) return;
      const keys = {
        ArrowLeft: () => answer("first"), ArrowRight: () => answer("second"), Backspace: actions.undo,
        ArrowDown: inside && (() => answer(0.5)),
        " ": inside && !at.closest("button, summary, a") && (() => clock.toggle()),
      };
      if (!keys[event.key] || !(inside || (anywhere && at === document.body))) return;
      event.preventDefault();
      if (!event.repeat) keys[event.key]();
      if (!inside) focus();
    }

    document.addEventListener("keydown", pressed);
    (async () => {
      const kept = place.read();
      await open(kept).catch(() => open(null)); // what was kept may be of another version
      await show();
      busy = false;
      if (anywhere && document.activeElement === document.body && !location.hash) focus();
    })().catch(complain);
    return { say, question: () => shown, state: () => session.state, unmount: () => document.removeEventListener("keydown", pressed) };
  }

  ask.mount = mount;
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
