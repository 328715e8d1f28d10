// A linear plant x⁺ = A x + B u, y = C x with limits of u: LQR gains, closed loops, what σ sees.
(function (ask) {
  "use strict";
  const { add, diag, dot, eye, largest, multiply, solve, subtract, times, transpose } = ask.linalg;

  const DOUBLINGS = 60;
  const RICCATI = 1e-8; // a solution may miss Riccati's equation by so much of its largest entry

  // The gain K of u = −K x for Q (nx, nx) and R (nu, nu), by the structure-preserving doubling
  // algorithm; null if none is found.
  function gain(plant, Q, R) {
    const { A, B } = plant, Bt = transpose(B), n = A.length;
    let a = A, g = multiply(B, solve(R, Bt)), P = Q;
    for (let k = 0; k < DOUBLINGS; k++) {
      const both = solve(add(eye(n), multiply(g, P)), a.map((row, i) => row.concat(g[i])));
      const inner = both.map((row) => row.slice(0, n)), middle = both.map((row) => row.slice(n));
      const at = transpose(a), change = multiply(multiply(at, P), inner);
      g = add(g, multiply(multiply(a, middle), at));
      a = multiply(a, inner);
      P = add(P, change);
      if (!(largest(change) > 1e-13 * largest(P))) break;
    }
    const PA = multiply(P, A);
    const K = solve(add(R, multiply(Bt, multiply(P, B))), multiply(Bt, PA));
    const closed = subtract(A, multiply(B, K));
    const miss = subtract(add(Q, multiply(transpose(A), multiply(P, closed))), P);
    return largest(miss) < RICCATI * largest(P) ? K : null;
  }

  // The gain of the LQR with weights w (p) in units of the centre's, first of x, then of u.
  function gainOf(plant, centre, w) {
    const own = w.map((weight, i) => weight * centre[i]), n = plant.A.length;
    return gain(plant, diag(own.slice(0, n)), diag(own.slice(n)));
  }

  // The closed loop of u = clip(−K x): states x_0 … x_N, inputs and outputs of steps 0 … N − 1.
  function loop(plant, K, x0, steps) {
    const { A, B, C, uMin, uMax } = plant;
    const x = [x0], u = [];
    for (let k = 0; k < steps; k++) {
      u.push(K.map((row, i) => Math.min(Math.max(-dot(row, x[k]), uMin[i]), uMax[i])));
      x.push(A.map((row, i) => dot(row, x[k]) + dot(B[i], u[k])));
    }
    return { x, u, y: x.slice(0, -1).map((state) => times(C, state)) };
  }

  // What a diagonal σ sees of a trajectory: sums of squares over time, in units in which the
  // centre's weights are 1. The last state does not count.
  function features(trajectory, centre) {
    const { x, u } = trajectory, n = x[0].length, sums = new Array(centre.length).fill(0);
    for (let k = 0; k < u.length; k++) {
      for (let i = 0; i < n; i++) sums[i] += x[k][i] * x[k][i];
      for (let j = 0; j < u[k].length; j++) sums[n + j] += u[k][j] * u[k][j];
    }
    return sums.map((sum, i) => sum * centre[i]);
  }

  // The features of loops from many x0, without keeping the loops: for each state an array (p).
  function loopFeatures(plant, K, centre, starts, steps) {
    const { uMin, uMax } = plant, nx = plant.A.length, nu = K.length;
    const A = Float64Array.from(plant.A.flat()), B = Float64Array.from(plant.B.flat());
    const gains = Float64Array.from(K.flat()), u = new Float64Array(nu);
    let x = new Float64Array(nx), next = new Float64Array(nx);
    return starts.map((start) => {
      const sums = new Array(nx + nu).fill(0);
      x.set(start);
      for (let k = 0; k < steps; k++) {
        for (let i = 0; i < nu; i++) {
          let sum = 0;
          for (let j = 0; j < nx; j++) sum -= gains[i * nx + j] * x[j];
          u[i] = Math.min(Math.max(sum, uMin[i]), uMax[i]);
          sums[nx + i] += u[i] * u[i];
        }
        for (let i = 0; i < nx; i++) {
          let sum = 0;
          for (let j = 0; j < nx; j++) sum += A[i * nx + j] * x[j];
          for (let j = 0; j < nu; j++) sum += B[i * nu + j] * u[j];
          next[i] = sum;
          sums[i] += x[i] * x[i];
        }
        [x, next] = [next, x];
      }
      return sums.map((sum, i) => sum * centre[i]);
    });
  }

  // A configuration as JSON has it: open limits are null.
  function limited(config) {
    const bounds = (values, open) => values.map((value) => value ?? open);
    return { ...config, uMin: bounds(config.uMin, -Infinity), uMax: bounds(config.uMax, Infinity) };
  }

  ask.plant = { limited, gain, gainOf, loop, loopFeatures, features };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
