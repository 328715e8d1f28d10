// An interviewer that lives in the page: what a front end asks for its questions.
//
// Every method is asynchronous, so that another interviewer may live elsewhere:
//   next()         the open question {first, second, number, repeats, …}, each side {x, u, y}
//   answer(value)  "first", "second", "skip", or P(first preferred); then progress()
//   undo()         take the last answer back; then progress()
//   progress()     {count, bound, median, enough, weights, consistency}
//   trial(count)   pairs for a blind test against the centre of the prior, or null
//   log()          the answers as lines of JSON, as prefmpc.Interview.load reads them
(function (ask) {
  "use strict";
  const { quantile } = ask.linalg;
  const { features } = ask.plant;
  const { random } = ask.random;

  const FORMAT = 1;

  // The method's numbers, in one place: those of prefmpc.Interview.
  const DEFAULTS = Object.freeze({
    spread: 2, sharpness: 2, coupling: 0.5, steps: 20, lapse: 0, repeatEvery: 8,
    samples: 150, // draws from the posterior, each moved so often:
    slices: 15,
    controllers: 12, // so many of them make loops, from so many states, for one question
    states: 12,
    level: 0.02, // enough: the regret is at most this with this probability
    certain: 0.9,
    most: Infinity, // so many answers are as much as can be asked of anybody
  });

  // Purposes of random numbers.
  const SAMPLES = 0, QUESTION = 1, STATES = 2, TRIAL = 3;

  // config: see masses.js; given: {seed, log, …}, log: the lines of an earlier session, whose
  // first line the new ones keep.
  function interviewer(config, given = {}) {
    const { lines, answers } = given.log ? parse(given.log) : { lines: [], answers: [] };
    const options = {
      ...DEFAULTS, centre: [...config.centre.Q, ...config.centre.R], radius: config.x0,
      ...config.method, ...given, ...(lines.length ? begun(lines[0]) : {}),
    };
    const key = lines.length ? lines[0].key : [given.seed ?? ask.random.seed()];
    const source = (count, purpose) => random(...key, count, purpose);
    const belief = ask.belief.belief(options.centre.length, options, options.lapse);
    const x0 = ask.random.states(source(0, STATES), options.radius, options.states);
    const kept = new Map();

    // What follows from the answers so far, or compute it.
    function once(name, n, compute) {
      for (const count of kept.keys()) if (count !== n) kept.delete(count);
      if (!kept.has(n)) kept.set(n, {});
      const known = kept.get(n);
      if (!(name in known)) known[name] = compute();
      return known[name];
    }

    const state = (n) => once("state", n, () => {
      const known = data(answers.slice(0, n), options.centre);
      const laplace = ask.belief.fit(belief, known);
      if (!laplace.success) throw new Error("no most probable weights were found");
      const { samples, slices } = options, rng = source(n, SAMPLES);
      const { eta, lapse } = ask.belief.draws(belief, laplace, known, samples, slices, rng);
      const w = eta.map((log) => log.map(Math.exp));
      return { samples: { w, lapse }, mean: ask.belief.meanWeights(eta) };
    });

    const question = () => once("question", answers.length, () => {
      const n = answers.length, rng = source(n, QUESTION);
      return ask.questions.next(config, options, answers, state(n).samples, rng);
    });

    const regret = (n) => once("regret", n, () => {
      const { mean, samples } = state(n);
      return ask.questions.regret(config, options, mean, samples.w, x0);
    });

    const bound = (n) => ask.questions.bound(regret(n), options.certain);

    function progress() {
      const n = answers.length, { mean, samples } = state(n);
      return {
        count: n, bound: bound(n), median: quantile(regret(n), 0.5), level: options.level,
        most: options.most, certain: options.certain, enough: bound(n) <= options.level,
        weights: shares(config, options.centre, mean, samples.w),
        consistency: consistency(answers),
      };
    }

    function trial(count) {
      const rng = source(answers.length, TRIAL), { mean } = state(answers.length);
      const gains = [mean, mean.map(() => 1)].map((w) => ask.plant.gainOf(config, options.centre, w));
      return ask.random.states(rng, options.radius, count).map((start) => {
        const loops = gains.map((K) => ask.plant.loop(config, K, start, options.steps));
        const learned = rng.uniform() < 0.5 ? "first" : "second";
        if (learned === "second") loops.reverse();
        return { first: loops[0], second: loops[1], learned };
      });
    }

    return {
      next: async () => question(),
      async answer(value) {
        const label = labelOf(value);
        answers.push({ label, question: question() });
        return progress();
      },
      async undo() {
        if (!answers.length) throw new Error("there is no answer to take back");
        const { question } = answers.pop();
        kept.clear();
        kept.set(answers.length, { question });
        return progress();
      },
      progress: async () => progress(),
      trial: async (count) => trial(count),
      log: async () => written(lines[0] || head(config, options, key), answers),
    };
  }

  function labelOf(value) {
    const label = { first: 1, second: 0, skip: null }[value];
    if (label !== undefined) return label;
    if (typeof value === "number" && value >= 0 && value <= 1) return value;
    throw new Error(`an answer is "first", "second", "skip" or a probability, not ${value}`);
  }

  // The answers as a set for the belief: what was skipped has no likelihood.
  function data(answers, centre) {
    const known = answers.filter((answer) => answer.label !== null);
    const gap = known.map(({ question }) => {
      const first = features(question.first, centre), second = features(question.second, centre);
      return second.map((phi, i) => phi - first[i]);
    });
    return { gap, labels: known.map((answer) => answer.label) };
  }

  // Each weight, and how far it is from the centre's, with an interval of 90 %: relative to the
  // common factor of all, which no controller depends on.
  function shares(config, centre, mean, samples) {
    const relative = (w) => {
      const logs = w.map(Math.log);
      return logs.map((log) => log - logs.reduce((sum, other) => sum + other, 0) / logs.length);
    };
    const own = relative(mean), others = samples.map(relative);
    return [...config.states, ...config.inputs].map(({ name, unit }, i) => {
      const column = others.map((logs) => logs[i]);
      return {
        name, unit, weight: mean[i] * centre[i], ratio: Math.exp(own[i]),
        low: Math.exp(quantile(column, 0.05)), high: Math.exp(quantile(column, 0.95)),
      };
    });
  }

  // How often a repeated question got the same answer, whatever the model.
  function consistency(answers) {
    const equal = answers.flatMap(({ label, question }) => {
      const before = question.repeats === null ? null : answers[question.repeats].label;
      return label === null || before === null ? [] : [1 - Math.abs(label - (1 - before))];
    });
    return { repeats: equal.length, equal: equal.reduce((sum, e) => sum + e, 0) };
  }

  // ---- the log ----

  function head(config, options, key) {
    const { A, B, C, uMin, uMax, dt } = config;
    const { Q, R } = config.centre, diag = ask.linalg.diag;
    return {
      "prefmpc interview": FORMAT,
      system: { A, B, C, u_min: uMin, u_max: uMax, dt },
      prior: { Q: diag(Q), R: diag(R), strength: 1 },
      x0: options.radius, key, structure: "diagonal", spread: options.spread,
      sharpness: options.sharpness, coupling: options.coupling, steps: options.steps,
      controller: "lqr", reference: null, horizon: 10, constraints: null, pool: null, choose: "information",
      lapse: options.lapse, repeat_every: options.repeatEvery, samples: options.samples,
    };
  }

  function written(first, answers) {
    const lines = answers.map(({ label, question }, number) =>
      ({ answer: label, number, batch: [number, 1], question }));
    return [first, ...lines].map((line) => JSON.stringify(line, finite) + "\n").join("");
  }

  // JSON has no infinite numbers: they are texts, as in the library's logs.
  const finite = (name, value) =>
    (typeof value === "number" && !Number.isFinite(value) ? (value > 0 ? "inf" : "-inf") : value);

  function parse(text) {
    const lines = text.split("\n").filter(Boolean).map((line) => JSON.parse(line));
    if (lines[0]["prefmpc interview"] !== FORMAT) throw new Error("this is no log of an interview");
    const answers = [];
    for (const line of lines.slice(1)) {
      if ("undo" in line) answers.pop();
      else answers.push({ label: line.answer, question: line.question });
    }
    return { lines, answers };
  }

  // An interview goes on as it was begun.
  const begun = ({ spread, sharpness, coupling, steps, lapse, samples, repeat_every: repeatEvery }) =>
    ({ spread, sharpness, coupling, steps, lapse, samples, repeatEvery });

  ask.interview = { DEFAULTS, interviewer, data };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
