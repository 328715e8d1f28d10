// Random numbers from whole numbers: the same seed, the same session.
(function (ask) {
  "use strict";

  // sfc32 (Doty-Humphrey), 128 bits of state. A source is any object with uniform() and normal().
  function random(...words) {
    let [a, b, c, counter] = [0x9e3779b9, 0x243f6a88, 0xb7e15162, 1];
    function next() {
      const sum = (a + b + counter) | 0;
      counter = (counter + 1) | 0;
      a = b ^ (b >>> 9);
      b = (c + (c << 3)) | 0;
      c = ((c << 21) | (c >>> 11)) + sum | 0;
      return sum >>> 0;
    }
    for (const word of words) {
      a ^= word | 0;
      for (let i = 0; i < 16; i++) next();
    }
    const uniform = () => (next() * 2 ** 21 + (next() >>> 11)) / 2 ** 53;
    const normal = () => {
      const radius = Math.sqrt(-2 * Math.log(1 - uniform()));
      return radius * Math.cos(2 * Math.PI * uniform());
    };
    return { uniform, normal };
  }

  const whole = (source, below) => Math.min(Math.floor(source.uniform() * below), below - 1);

  const uniforms = (source, count) => Array.from({ length: count }, () => source.uniform());

  // A matrix of standard normal numbers, row by row.
  const normals = (source, rows, columns) =>
    Array.from({ length: rows }, () => Array.from({ length: columns }, () => source.normal()));

  // States: each entry uniform within its radius; or of a list, each at most once.
  function states(source, x0, count) {
    if (!Array.isArray(x0[0])) return Array.from({ length: count }, () => x0.map((r) => (2 * source.uniform() - 1) * r));
    const left = x0.slice();
    while (left.length > count) left.splice(whole(source, left.length), 1);
    return left;
  }

  // Where there is no better source of a seed than the clock, that one.
  function seed() {
    if (globalThis.crypto && crypto.getRandomValues) return crypto.getRandomValues(new Uint32Array(1))[0];
    return Date.now() >>> 0;
  }

  ask.random = { random, whole, uniforms, normals, states, seed };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
