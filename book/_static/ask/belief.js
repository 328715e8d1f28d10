// What is known of the weights after some answers: Laplace's method in log weights, and samples.
//
// η (p) are log weights in units of the prior's centre: σ(T) = Σ e^{η_i} φ_i(T). A person prefers
// the first of two trajectories with P = ε/2 + (1 − ε)·logistic(z), z = σ(second) − σ(first).
// A set of answers is {gap (n, p): features of the second minus those of the first,
// labels (n): P(first preferred)}.
(function (ask) {
  "use strict";
  const { cholesky, dot, eigen, eye, multiply, solve, times, transpose, zeros } = ask.linalg;
  const { normals, uniforms } = ask.random;

  const LAPSE_CENTRE = Math.log(0.04 / 0.96);
  const LAPSE_SPREAD = 1; // an estimated lapse rate has a logit of this mean and deviation
  const STEPS = 100;
  const TOLERANCE = 1e-9; // of the certificate; the search itself goes on to
  const POLISHED = 1e-18;
  const FLOOR = 1e-3;
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

  // The posterior of η for a prior {spread, sharpness} and a lapse rate, or "estimate".
  function belief(p, prior, lapse) {
    const own = prior.spread ** 2, common = prior.sharpness ** 2;
    const covariance = zeros(p, p).map((row, i) => row.map((_, j) => common + (i === j ? own : 0)));
    const unit = cholesky(covariance), precision = solve(covariance, eye(p));
    return { p, lapse, unit, precision };
  }

  // The Gaussian about the most probable η. With ε > 0 the search starts from the solution for
  // ε = 0, that one from the centre of the prior, so that the result depends on the answers alone.
  function fit(b, answers) {
    const plain = newton(b, new Array(b.p).fill(0), answers, 0);
    if (b.lapse === 0) return plain;
    if (b.lapse === "estimate") return newton(b, [...plain.eta, LAPSE_CENTRE], answers, null);
    return newton(b, plain.eta, answers, b.lapse);
  }

  // −log posterior up to a constant, at η, and the logit of the lapse rate if `lapse` is null.
  function energy(b, at, answers, lapse) {
    const { gap, labels } = answers, p = b.p, w = new Array(p);
    let total = 0;
    for (let i = 0; i < p; i++) {
      w[i] = Math.exp(at[i]);
      for (let j = 0; j < p; j++) total += 0.5 * at[i] * b.precision[i][j] * at[j];
    }
    if (lapse === null) total += 0.5 * ((at[p] - LAPSE_CENTRE) / LAPSE_SPREAD) ** 2;
    const rate = lapse === null ? logistic(at[p]) : lapse;
    for (let i = 0; i < gap.length; i++) {
      const z = dot(gap[i], w);
      total += rate === 0 ? softplus(z) - labels[i] * z : lapsing(z, labels[i], rate).loss;
    }
    return Number.isFinite(total) ? total : Infinity;
  }

  function slopes(b, at, answers, lapse) {
    const { gap, labels } = answers, p = b.p, eta = at.slice(0, p), w = eta.map(Math.exp);
    const rate = lapse === null ? logistic(at[p]) : lapse;
    const gradient = times(b.precision, eta), hessian = b.precision.map((row) => row.slice());
    const side = new Array(p).fill(0), total = [0, 0];
    for (let i = 0; i < gap.length; i++) {
      const z = dot(gap[i], w);
      let [slope, curvature, byRate] = [0, 0, [0, 0, 0]];
      if (lapse === 0) {
        const s = logistic(z);
        [slope, curvature] = [s - labels[i], s * (1 - s)];
      } else {
        ({ slope, curvature, byRate } = lapsing(z, labels[i], rate));
      }
      const toEta = gap[i].map((g, j) => g * w[j]);
      for (let j = 0; j < p; j++) {
        gradient[j] += slope * toEta[j];
        side[j] += byRate[1] * toEta[j];
        hessian[j][j] += slope * toEta[j];
        for (let k = 0; k < p; k++) hessian[j][k] += curvature * toEta[j] * toEta[k];
      }
      total[0] += byRate[0];
      total[1] += byRate[2];
    }
    if (lapse !== null) return { gradient, hessian };
    const step = rate * (1 - rate), bend = step * (1 - 2 * rate);
    gradient.push(step * total[0] + (at[p] - LAPSE_CENTRE) / LAPSE_SPREAD ** 2);
    hessian.forEach((row, j) => row.push(step * side[j]));
    const corner = step ** 2 * total[1] + bend * total[0] + 1 / LAPSE_SPREAD ** 2;
    hessian.push([...side.map((s) => step * s), corner]);
    return { gradient, hessian };
  }

  // Newton's method with directions of negative curvature turned, scaled so that the prior is a
  // standard Gaussian. What it says of itself is the certificate: decrement and least curvature.
  function newton(b, start, answers, lapse) {
    const q = start.length, unit = eye(q);
    b.unit.forEach((row, i) => row.forEach((value, j) => { unit[i][j] = value; }));
    if (lapse === null) unit[q - 1][q - 1] = LAPSE_SPREAD;
    const back = transpose(unit);
    let at = start, now = energy(b, at, answers, lapse), values, vectors, decrement;
    for (let step = 0; step < STEPS; step++) {
      const { gradient, hessian } = slopes(b, at, answers, lapse);
      ({ values, vectors } = eigen(multiply(back, multiply(hessian, unit))));
      const turned = times(transpose(vectors), times(back, gradient));
      const scaled = turned.map((g, i) => g / Math.max(Math.abs(values[i]), FLOOR));
      decrement = 0.5 * dot(turned, scaled);
      if (decrement <= POLISHED && values[0] > 0) break;
      const inner = times(vectors, scaled), move = times(unit, inner);
      let t = Math.min(1, 4 / (Math.max(...inner.map(Math.abs)) + 1e-300)), found = false;
      for (let half = 0; half < 40 && !found; half++) {
        const trial = at.map((value, i) => value - t * move[i]);
        const level = energy(b, trial, answers, lapse);
        found = level <= now - 0.2 * t * decrement + 1e-13 * Math.abs(now);
        if (found) [at, now] = [trial, level];
        else t /= 2;
      }
      if (!found) break;
    }
    const scale = values.map((value) => 1 / Math.sqrt(Math.max(value, FLOOR)));
    const root = multiply(unit, vectors.map((row) => row.map((v, i) => v * scale[i])));
    return {
      eta: at.slice(0, b.p), at, root, decrement: Number.isFinite(now) ? decrement : Infinity,
      curvature: values[0], lapse: lapse === null ? logistic(at[q - 1]) : lapse,
      success: decrement <= TOLERANCE && values[0] > 0,
    };
  }

  // Samples of the posterior: elliptical slice sampling about Laplace's Gaussian, all chains at
  // once. Each starts from a draw of the Gaussian and is moved `slices` times.
  function draws(b, laplace, answers, count, slices, source) {
    const q = laplace.at.length, lapse = q === b.p ? b.lapse : null;
    const place = (x) => times(laplace.root, x).map((value, i) => laplace.at[i] + value);
    const excess = (x) => 0.5 * dot(x, x) - energy(b, place(x), answers, lapse);
    const x = normals(source, count, q), level = slices ? x.map(excess) : [];
    for (let k = 0; k < slices; k++) slice(x, level, excess, source);
    const at = x.map(place);
    return {
      eta: at.map((point) => point.slice(0, b.p)),
      lapse: at.map((point) => (lapse === null ? logistic(point[b.p]) : lapse)),
    };
  }

  // Move every chain once, in place (Murray, Adams and MacKay 2010).
  function slice(x, level, excess, source) {
    const count = x.length, other = normals(source, count, x[0].length);
    const floor = uniforms(source, count).map((r, i) => level[i] + Math.log(r));
    const angle = uniforms(source, count).map((r) => 2 * Math.PI * r);
    const low = angle.map((a) => a - 2 * Math.PI), high = angle.slice(), from = x.slice();
    let open = x.map((_, i) => i);
    for (let round = 0; round < ROUNDS && open.length; round++) {
      open = open.filter((i) => {
        const c = Math.cos(angle[i]), s = Math.sin(angle[i]);
        const trial = from[i].map((value, j) => c * value + s * other[i][j]);
        const value = excess(trial);
        if (!(value >= floor[i])) return true;
        [x[i], level[i]] = [trial, value];
        return false;
      });
      for (const i of open) {
        if (angle[i] < 0) low[i] = angle[i];
        else high[i] = angle[i];
        angle[i] = low[i] + (high[i] - low[i]) * source.uniform();
      }
    }
  }

  ask.belief = { belief, fit, draws, logistic };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
