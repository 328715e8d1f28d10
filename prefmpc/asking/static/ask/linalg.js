// Small dense matrices as arrays of rows: what a plant with a handful of states needs.
(function (ask) {
  "use strict";

  const zeros = (rows, columns) => Array.from({ length: rows }, () => new Array(columns).fill(0));

  const diag = (values) => {
    const D = zeros(values.length, values.length);
    values.forEach((value, i) => { D[i][i] = value; });
    return D;
  };

  const eye = (n) => diag(new Array(n).fill(1));

  const transpose = (A) => A[0].map((_, j) => A.map((row) => row[j]));

  function multiply(A, B) {
    const columns = B[0].length;
    return A.map((row) => {
      const out = new Array(columns).fill(0);
      for (let k = 0; k < row.length; k++) {
        const a = row[k], b = B[k];
        for (let j = 0; j < columns; j++) out[j] += a * b[j];
      }
      return out;
    });
  }

  function times(A, x) {
    const out = new Array(A.length);
    for (let i = 0; i < A.length; i++) out[i] = dot(A[i], x);
    return out;
  }

  function dot(a, b) {
    let sum = 0;
    for (let i = 0; i < a.length; i++) sum += a[i] * b[i];
    return sum;
  }

  const combine = (A, B, sign) => A.map((row, i) => row.map((value, j) => value + sign * B[i][j]));
  const add = (A, B) => combine(A, B, 1);
  const subtract = (A, B) => combine(A, B, -1);

  const largest = (A) => Math.max(...A.map((row) => Math.max(...row.map(Math.abs))));

  // A X = B by Gauss's elimination with partial pivoting; B (n, m).
  function solve(A, B) {
    const n = A.length, L = A.map((row) => row.slice()), X = B.map((row) => row.slice());
    for (let k = 0; k < n; k++) {
      let p = k;
      for (let i = k + 1; i < n; i++) if (Math.abs(L[i][k]) > Math.abs(L[p][k])) p = i;
      [L[k], L[p]] = [L[p], L[k]];
      [X[k], X[p]] = [X[p], X[k]];
      for (let i = k + 1; i < n; i++) {
        const factor = L[i][k] / L[k][k];
        if (factor === 0) continue;
        for (let j = k + 1; j < n; j++) L[i][j] -= factor * L[k][j];
        for (let j = 0; j < X[i].length; j++) X[i][j] -= factor * X[k][j];
      }
    }
    for (let k = n - 1; k >= 0; k--) {
      for (let j = 0; j < X[k].length; j++) {
        let sum = X[k][j];
        for (let i = k + 1; i < n; i++) sum -= L[k][i] * X[i][j];
        X[k][j] = sum / L[k][k];
      }
    }
    return X;
  }

  // The lower triangular L of A = L Lᵀ.
  function cholesky(A) {
    const n = A.length, L = zeros(n, n);
    for (let j = 0; j < n; j++) {
      for (let i = j; i < n; i++) {
        let sum = A[i][j];
        for (let k = 0; k < j; k++) sum -= L[i][k] * L[j][k];
        L[i][j] = i === j ? Math.sqrt(sum) : sum / L[j][j];
      }
    }
    return L;
  }

  // Eigenvalues, smallest first, and eigenvectors (columns) of a symmetric A, by Jacobi's method.
  function eigen(A) {
    const n = A.length, S = A.map((row) => row.slice()), V = eye(n);
    for (let sweep = 0; sweep < 60; sweep++) {
      let off = 0, all = 0;
      S.forEach((row, i) => row.forEach((s, j) => { all += s * s; if (i !== j) off += s * s; }));
      if (!(off > 1e-32 * all)) break;
      for (let p = 0; p < n; p++) for (let q = p + 1; q < n; q++) rotate(S, V, p, q);
    }
    const order = S.map((row, i) => i).sort((i, j) => S[i][i] - S[j][j]);
    return { values: order.map((i) => S[i][i]), vectors: V.map((row) => order.map((i) => row[i])) };
  }

  function rotate(S, V, p, q) {
    if (S[p][q] === 0) return;
    const n = S.length, theta = (S[q][q] - S[p][p]) / (2 * S[p][q]);
    const t = (theta >= 0 ? 1 : -1) / (Math.abs(theta) + Math.hypot(theta, 1));
    const c = 1 / Math.hypot(t, 1), s = t * c;
    for (let k = 0; k < n; k++) {
      const a = S[k][p], b = S[k][q];
      S[k][p] = c * a - s * b;
      S[k][q] = s * a + c * b;
    }
    for (let k = 0; k < n; k++) {
      const a = S[p][k], b = S[q][k], v = V[k][p], w = V[k][q];
      S[p][k] = c * a - s * b;
      S[q][k] = s * a + c * b;
      V[k][p] = c * v - s * w;
      V[k][q] = s * v + c * w;
    }
    S[p][q] = S[q][p] = 0;
  }

  // The value that is not exceeded with probability q, between the neighbours in proportion.
  function quantile(values, q) {
    const sorted = Array.from(values).sort((a, b) => a - b);
    const place = q * (sorted.length - 1), i = Math.min(Math.floor(place), sorted.length - 2);
    return sorted.length < 2 ? sorted[0] : sorted[i] + (place - i) * (sorted[i + 1] - sorted[i]);
  }

  ask.linalg = {
    zeros, diag, eye, transpose, multiply, times, dot, add, subtract, largest,
    solve, cholesky, eigen, quantile,
  };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
