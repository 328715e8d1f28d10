// What is known of the weights after some answers: Laplace's method in log weights, and samples.
//
// η (p) are log weights in units of the prior's centre: σ(T) = Σ e^{η_i} φ_i(T). A person prefers
// the first of two trajectories with P = ε/2 + (1 − ε)·logistic(z), z = σ(second) − σ(first).
// A set of answers is {gap (n, p): features of the second minus those of the first,
// labels (n): P(first preferred)}.
//
// What all log weights have in common is how sharp the answers are. Laplace's method is applied
// for each of several sharpnesses ("levels"), which are then weighed by their evidence.
(function (ask) {
  "use strict";
  const { dot, eigen, eye, times, transpose, zeros } = ask.linalg;
  const { normals, uniforms } = ask.random;

  const LAPSE_CENTRE = Math.log(0.04 / 0.96);
  const LAPSE_SPREAD = 1; // an estimated lapse rate has a logit of this mean and deviation
  const LEVELS = Array.from({ length: 13 }, (_, i) => (i - 6) / 2); // in deviations of the prior's
  const STEPS = 100;
  const TOLERANCE = 1e-9; // of the certificate; the search itself goes on to
  const POLISHED = 1e-18;
  const ROUGH = 1e-4; // where a search stopped further from a minimum, its level has no say
  const FLAT = 1e-3; // no curvature counts as less than this share of the prior's for a step,
  const WIDE = 0.25; // nor less than this for a Gaussian: nowhere is it wider than twice the prior
  const ROUNDS = 30;

  const logistic = (z) => (z >= 0 ? 1 / (1 + Math.exp(-z)) : Math.exp(z) / (1 + Math.exp(z)));
  const softplus = (z) => Math.max(z, 0) + Math.log1p(Math.exp(-Math.abs(z)));

  // The loss of one answer under a lapse rate, its derivatives by z, and ∂ε, ∂ε∂z, ∂ε².
  function lapsing(z, label, rate) {
    const s = logistic(z), t = logistic(-z), ds = s * t;
    const p = rate / 2 + (1 - rate) * s, q = rate / 2 + (1 - rate) * t;
    const byP = (1 - label) / q - label / p, byPP = label / (p * p) + (1 - label) / (q * q);
    const pz = (1 - rate) * ds, pzz = (1 - rate) * ds * (1 - 2 * s), pe = 0.5 - s;
    return {
      loss: -label * Math.log(p) - (1 - label) * Math.log(q),
      slope: byP * pz,
      curvature: byPP * pz * pz + byP * pzz,
      byRate: [byP * pe, byPP * pe * pz - byP * ds, byPP * pe * pe],
    };
  }

  // The belief for a prior {spread, sharpness} and a lapse rate, or "estimate": η = level·common
  // + basis·v with a standard Gaussian v; an estimated lapse rate is one more coordinate.
  function belief(p, prior, lapse) {
    const common = Math.hypot(prior.sharpness, prior.spread / Math.sqrt(p));
    // The reflection that turns (1, …, 1) into the first axis: its other rows are orthogonal to it.
    const v = new Array(p).fill(1 / (1 + Math.sqrt(p))), scale = (Math.sqrt(p) + 1) / Math.sqrt(p);
    v[0] = 1;
    const basis = zeros(p, p - 1).map((row, i) => row.map((_, j) =>
      prior.spread * ((i === j + 1 ? 1 : 0) - scale * v[i] * v[j + 1])));
    return { p, lapse, common, basis };
  }

  function etaOf(b, at, level) {
    const eta = new Array(b.p);
    for (let i = 0; i < b.p; i++) {
      eta[i] = level * b.common;
      for (let j = 0; j < b.p - 1; j++) eta[i] += b.basis[i][j] * at[j];
    }
    return eta;
  }

  const rateOf = (at) => logistic(LAPSE_CENTRE + LAPSE_SPREAD * at[at.length - 1]);

  // The Gaussians about the most probable points, one a level: centres `at` (K, q), roots of the
  // covariances (K, q, q), and how probable each level is. The search starts where answers say
  // next to nothing and follows the minimum from level to level, first without lapses, so that
  // the result depends on the answers alone.
  function fit(b, answers) {
    let at = new Array(b.p - 1).fill(0);
    const minima = LEVELS.map((level) => {
      const plain = newton(b, at, level, answers, 0);
      at = plain.at;
      if (b.lapse === 0) return plain;
      if (b.lapse === "estimate") return newton(b, [...at, 0], level, answers, null);
      return newton(b, at, level, answers, b.lapse);
    });
    // A level whose search did not end in a minimum has no say: its evidence is not known.
    const found = minima.map((m) => m.decrement <= ROUGH && m.curvature > 0);
    const any = found.includes(true);
    const evidence = minima.map((m, i) => (found[i] || !any ? m.evidence : -Infinity));
    const most = Math.max(...evidence);
    const shares = evidence.map((e) => Math.exp(e - most));
    const total = shares.reduce((sum, share) => sum + share, 0);
    const k = evidence.indexOf(most), best = minima[k];
    return {
      eta: etaOf(b, best.at, LEVELS[k]), lapse: b.lapse === "estimate" ? rateOf(best.at) : b.lapse,
      decrement: best.decrement, curvature: best.curvature,
      success: best.decrement <= TOLERANCE && best.curvature > 0,
      at: minima.map((m) => m.at), roots: minima.map((m) => m.root),
      weights: shares.map((share) => share / total),
    };
  }

  // −log posterior up to a constant; the lapse rate is a coordinate if `lapse` is null.
  function energy(b, at, level, answers, lapse) {
    const { gap, labels } = answers, w = etaOf(b, at, level).map(Math.exp);
    const rate = lapse === null ? rateOf(at) : lapse;
    let total = 0.5 * dot(at, at);
    for (let i = 0; i < gap.length; i++) {
      const z = dot(gap[i], w);
      total += rate === 0 ? softplus(z) - labels[i] * z : lapsing(z, labels[i], rate).loss;
    }
    return Number.isFinite(total) ? total : Infinity;
  }

  function slopes(b, at, level, answers, lapse) {
    const { gap, labels } = answers, n = b.p - 1, w = etaOf(b, at, level).map(Math.exp);
    const rate = lapse === null ? rateOf(at) : lapse;
    const gradient = at.slice(), hessian = eye(at.length), total = [0, 0];
    const bend = new Array(b.p).fill(0), side = new Array(n).fill(0);
    for (let i = 0; i < gap.length; i++) {
      const z = dot(gap[i], w), s = logistic(z);
      const { slope, curvature, byRate } = lapse === 0
        ? { slope: s - labels[i], curvature: s * (1 - s), byRate: [0, 0, 0] }
        : lapsing(z, labels[i], rate);
      const toEta = gap[i].map((g, j) => g * w[j]), toAt = new Array(n).fill(0);
      toEta.forEach((g, j) => {
        bend[j] += slope * g;
        for (let k = 0; k < n; k++) toAt[k] += g * b.basis[j][k];
      });
      for (let j = 0; j < n; j++) {
        gradient[j] += slope * toAt[j];
        side[j] += byRate[1] * toAt[j];
        for (let k = 0; k < n; k++) hessian[j][k] += curvature * toAt[j] * toAt[k];
      }
      total[0] += byRate[0];
      total[1] += byRate[2];
    }
    b.basis.forEach((row, i) => row.forEach((one, j) => {
      for (let k = 0; k < n; k++) hessian[j][k] += bend[i] * one * row[k];
    }));
    if (lapse !== null) return { gradient, hessian };
    const step = LAPSE_SPREAD * rate * (1 - rate);
    gradient[n] += step * total[0];
    hessian[n][n] += step ** 2 * total[1] + LAPSE_SPREAD * step * (1 - 2 * rate) * total[0];
    side.forEach((value, j) => { hessian[n][j] = hessian[j][n] = step * value; });
    return { gradient, hessian };
  }

  // Newton's method with directions of negative curvature turned. What it says of itself is the
  // certificate: decrement and least curvature.
  function newton(b, start, level, answers, lapse) {
    let at = start, now = energy(b, at, level, answers, lapse), values, vectors, decrement;
    for (let step = 0; step < STEPS; step++) {
      const { gradient, hessian } = slopes(b, at, level, answers, lapse);
      ({ values, vectors } = eigen(hessian));
      const turned = times(transpose(vectors), gradient);
      const scaled = turned.map((g, i) => g / Math.max(Math.abs(values[i]), FLAT));
      decrement = 0.5 * dot(turned, scaled);
      if (decrement <= POLISHED && values[0] > 0) break;
      const move = times(vectors, scaled);
      let t = Math.min(1, 3 / Math.max(...move.map(Math.abs))), found = false;
      for (; t > 1e-10 && !found; t /= 2) {
        const trial = at.map((value, i) => value - t * move[i]);
        const height = energy(b, trial, level, answers, lapse);
        found = height <= now - 0.2 * t * decrement + 1e-13 * Math.abs(now);
        if (found) [at, now] = [trial, height];
      }
      if (!found) break;
    }
    const size = values.map((value) => Math.max(value, WIDE));
    const evidence = -now - 0.5 * size.reduce((sum, s) => sum + Math.log(s), 0) - 0.5 * level ** 2;
    // The symmetric root, since the signs of eigenvectors are arbitrary.
    const scaled = vectors.map((row) => row.map((value, i) => value / Math.sqrt(size[i])));
    return {
      at, evidence, decrement: Number.isFinite(now) ? decrement : Infinity, curvature: values[0],
      root: scaled.map((row) => times(vectors, row)),
    };
  }

  // Samples of the posterior, all chains at once: each starts from a draw of Laplace's Gaussians
  // and is moved `slices` times, within its level by elliptical slice sampling, and then to one
  // of the two next levels, or not, by Metropolis's rule.
  function draws(b, laplace, answers, count, slices, source) {
    const q = laplace.at[0].length, lapse = q === b.p - 1 ? b.lapse : null;
    const which = uniforms(source, count).map((u) => chosen(laplace.weights, u));
    const x = normals(source, count, q);
    const point = (x, k) => times(laplace.roots[k], x).map((v, j) => laplace.at[k][j] + v);
    const excessAt = (x, k) => 0.5 * dot(x, x) - energy(b, point(x, k), LEVELS[k], answers, lapse);
    const excess = (x, i) => excessAt(x, which[i]);
    const constant = laplace.roots.map((root, k) =>
      eigen(root).values.reduce((sum, v) => sum + Math.log(v), 0) - 0.5 * LEVELS[k] ** 2);
    const height = slices ? x.map(excess) : [];
    for (let round = 0; round < slices; round++) {
      slice(x, height, excess, source);
      const steps = uniforms(source, count).map((u) => (u < 0.5 ? -1 : 1));
      const chances = uniforms(source, count);
      for (let i = 0; i < count; i++) {
        const from = which[i], to = Math.min(Math.max(from + steps[i], 0), LEVELS.length - 1);
        const there = excessAt(x[i], to);
        const gain = there + constant[to] - height[i] - constant[from];
        if (Math.log(chances[i]) < gain) [which[i], height[i]] = [to, there];
      }
    }
    const at = x.map((place, i) => point(place, which[i]));
    return {
      eta: at.map((place, i) => etaOf(b, place, LEVELS[which[i]])),
      lapse: at.map((place) => (lapse === null ? rateOf(place) : lapse)),
    };
  }

  // The first index at which the sum of the weights so far is above u.
  function chosen(weights, u) {
    let sum = 0;
    const k = weights.findIndex((weight) => (sum += weight) > u);
    return k < 0 ? weights.length - 1 : k;
  }

  // The mean of weights of equal sharpness. Sharpness is the mean of the log weights; that of the
  // mean is its own mean.
  function meanWeights(etas) {
    const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
    const sharpness = etas.map(mean), all = Math.exp(mean(sharpness));
    return etas[0].map((_, j) => all * mean(etas.map((eta, m) => Math.exp(eta[j] - sharpness[m]))));
  }

  // Move every chain once, in place (Murray, Adams and MacKay 2010).
  function slice(x, height, excess, source) {
    const count = x.length, other = normals(source, count, x[0].length);
    const floor = uniforms(source, count).map((r, i) => height[i] + Math.log(r));
    const angle = uniforms(source, count).map((r) => 2 * Math.PI * r);
    const low = angle.map((a) => a - 2 * Math.PI), high = angle.slice(), from = x.slice();
    let open = x.map((_, i) => i);
    for (let round = 0; round < ROUNDS && open.length; round++) {
      open = open.filter((i) => {
        const c = Math.cos(angle[i]), s = Math.sin(angle[i]);
        const trial = from[i].map((value, j) => c * value + s * other[i][j]);
        const value = excess(trial, i);
        if (!(value >= floor[i])) return true;
        [x[i], height[i]] = [trial, value];
        return false;
      });
      for (const i of open) {
        if (angle[i] < 0) low[i] = angle[i];
        else high[i] = angle[i];
        angle[i] = low[i] + (high[i] - low[i]) * source.uniform();
      }
    }
  }

  ask.belief = { belief, draws, fit, logistic, meanWeights };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
