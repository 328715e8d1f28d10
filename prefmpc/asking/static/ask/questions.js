// The next question: closed loops that the answers leave possible, and of all pairs that start
// alike the one whose answer tells most.
(function (ask) {
  "use strict";
  const { dot, quantile } = ask.linalg;
  const { logistic } = ask.belief;
  const { features, gainOf, loop, loopFeatures } = ask.plant;

  const RECENT = 4; // a question is repeated when at least so many others came in between

  // The entropy of a yes or no, in nats.
  const entropy = (p) => (p <= 0 || p >= 1 ? 0 : -p * Math.log(p) - (1 - p) * Math.log1p(-p));

  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

  const probability = (z, lapse) => lapse / 2 + (1 - lapse) * logistic(z);

  // How much an answer tells if it is yes with these probabilities (one a sample): the model
  // unsure, the person sure.
  const information = (P) => Math.max(entropy(mean(P)) - mean(P.map(entropy)), 0);

  // The probabilities (one a sample) that the first is preferred; gap: features of the second
  // minus those of the first.
  const probabilities = (gap, samples) =>
    samples.w.map((w, s) => probability(dot(gap, w), samples.lapse[s]));

  // What σ sees of the closed loops of the controllers w from states x0: all that end, each with
  // its gain and its start, so that it can be shown.
  function candidates(plant, centre, controllers, x0, steps) {
    const found = [];
    controllers.forEach((w, source) => {
      const K = gainOf(plant, centre, w);
      if (K === null) return;
      loopFeatures(plant, K, centre, x0, steps).forEach((phi, start) => {
        if (phi.every(Number.isFinite)) found.push({ phi, start, source, K });
      });
    });
    return found;
  }

  // Pairs [first, second] of candidates with the same start.
  function pairs(found) {
    const out = [];
    for (let i = 0; i < found.length; i++) {
      for (let j = i + 1; j < found.length; j++) {
        if (found[i].start === found[j].start) out.push([i, j]);
      }
    }
    return out;
  }

  // The information gain of each pair; −1 if its two loops are the same.
  function gains(found, chosen, samples) {
    const costs = samples.w.map((w) => found.map((candidate) => dot(w, candidate.phi)));
    const count = costs.length;
    return chosen.map(([i, j]) => {
      const one = found[i].phi, other = found[j].phi;
      if (!one.some((phi, k) => Math.abs(other[k] - phi) > 1e-9 * Math.abs(phi))) return -1;
      let sum = 0, inner = 0;
      for (let s = 0; s < count; s++) {
        const p = probability(costs[s][j] - costs[s][i], samples.lapse[s]);
        sum += p;
        inner += entropy(p);
      }
      return Math.max(entropy(sum / count) - inner / count, 0);
    });
  }

  function question(first, second, P, number, repeats) {
    return {
      first, second, gain: information(P), sure: mean(P.map((p) => Math.max(p, 1 - p))),
      probability: mean(P), number, repeats,
    };
  }

  // Which of the answers is to be asked again now, null if none.
  function toRepeat(answers, every, source) {
    const n = answers.length;
    if (!every || n % every !== every - 1) return null;
    const done = new Set(answers.map((answer) => answer.question.repeats));
    const free = answers.slice(0, Math.max(n - RECENT, 0)).map((_, i) => i).filter((i) =>
      answers[i].label !== null && answers[i].question.repeats === null && !done.has(i));
    return free.length ? free[ask.random.whole(source, free.length)] : null;
  }

  // The next question. options: centre, radius, steps, controllers, states, repeatEvery.
  function next(plant, options, answers, samples, source) {
    const number = answers.length, again = toRepeat(answers, options.repeatEvery, source);
    if (again !== null) {
      const { first, second } = answers[again].question;
      const [one, other] = [second, first].map((side) => features(side, options.centre));
      const P = probabilities(other.map((phi, i) => phi - one[i]), samples);
      return question(second, first, P, number, again);
    }
    const x0 = ask.random.states(source, options.radius, options.states);
    const controllers = samples.w.slice(0, options.controllers);
    const found = candidates(plant, options.centre, controllers, x0, options.steps);
    const all = pairs(found), scores = gains(found, all, samples);
    const best = scores.indexOf(Math.max(...scores));
    if (!(scores[best] >= 0)) throw new Error("no two closed loops from one start differ");
    const [i, j] = source.uniform() < 0.5 ? all[best].slice().reverse() : all[best];
    const P = probabilities(found[j].phi.map((phi, k) => phi - found[i].phi[k]), samples);
    const sides = [i, j].map((side) => loop(plant, found[side].K, x0[found[side].start], options.steps));
    return question(...sides, P, number, null);
  }

  // For each sample: its own cost of the loops of the present weights over that of the controller
  // that knows it, minus 1; 0 where the present one does better.
  function regret(plant, options, present, samples, x0) {
    const all = [present, ...samples];
    const found = candidates(plant, options.centre, all, x0, options.steps);
    const reached = new Set(found.filter((c) => c.source === 0).map((c) => c.start));
    const phi = all.map(() => new Array(present.length).fill(0)), loops = all.map(() => 0);
    for (const candidate of found) {
      if (!reached.has(candidate.start)) continue;
      loops[candidate.source] += 1;
      candidate.phi.forEach((value, i) => { phi[candidate.source][i] += value; });
    }
    const ended = loops.map((count) => count === reached.size);
    return samples.map((w, s) => {
      // Of a sample whose own loops failed the best of the others is what is known.
      const best = ended[s + 1] ? dot(w, phi[s + 1])
        : Math.min(...phi.filter((_, i) => ended[i]).map((sums) => dot(w, sums)));
      return Math.max(dot(w, phi[0]) / best - 1, 0);
    });
  }

  // What the regret is at most with probability q: a higher quantile of the values, by 1.645
  // standard errors of a share q among so many.
  const bound = (values, q) =>
    quantile(values, Math.min(q + 1.645 * Math.sqrt(q * (1 - q) / values.length), 1));

  ask.questions = { bound, candidates, entropy, gains, information, next, pairs, probabilities, regret };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
