// The blind test's arithmetic, and visitors who are no people.
(function (ask) {
  "use strict";

  // Wilson's interval of 95 % for a share of `wins` out of `count`.
  function wilson(wins, count) {
    const z = 1.959963984540054, z2 = z * z;
    const middle = (wins + z2 / 2) / (count + z2);
    const half = (z / (count + z2)) * Math.sqrt((wins * (count - wins)) / count + z2 / 4);
    return [Math.max(middle - half, 0), Math.min(middle + half, 1)];
  }

  // How a blind test ended: pairs with `learned` on one side, and an answer to each.
  function verdict(pairs, answers) {
    const decided = answers.map((answer, i) => [answer, pairs[i].learned])
      .filter(([answer]) => answer === "first" || answer === "second");
    const wins = decided.filter(([answer, learned]) => answer === learned).length;
    const count = decided.length, [low, high] = count ? wilson(wins, count) : [0, 1];
    return { wins, count, ties: answers.length - count, low, high };
  }

  // The lines of the log for the answers to a blind test that was made after `number` answers.
  const lines = (pairs, answers, number) => answers.map((answer, pair) => JSON.stringify({
    blind: pair, number, answer: { first: 1, second: 0 }[answer] ?? answer, ...pairs[pair],
  }) + "\n").join("");

  // Somebody who always takes the response with the smaller Σ w φ; w: weights of x, then of u.
  function visitor(w) {
    return async ({ first, second }) => {
      const [one, other] = [first, second].map((side) =>
        ask.plant.features(side, w).reduce((sum, phi) => sum + phi, 0));
      return one <= other ? "first" : "second";
    };
  }

  ask.blind = { lines, verdict, visitor, wilson };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
