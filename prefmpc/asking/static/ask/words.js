// What the page says.
(function (ask) {
  "use strict";

  const percent = (share) => {
    const value = 100 * share;
    return `${value < 9.95 ? value.toFixed(1).replace(/\.0$/, "") : Math.round(value)}\u00a0%`;
  };

  // How sure the page is, as a statement about the controller.
  function sureness({ count, bound, level, certain }) {
    if (count === 0) return "I know nothing of you yet.";
    const odds = `(${Math.round(10 * certain)} chances in 10)`;
    if (bound >= 1) return `I hardly know what you want: a controller built now may be ${
      bound >= 10 ? "many times" : "more than twice"} as bad for you as the best one ${odds}.`;
    return `A controller built now is at most ${percent(bound)} worse for you than the best one ${odds}.`;
  }

  // From 0 (as bad again as the best) to 1 (near enough).
  const progress = ({ bound, level, count }) =>
    (count ? Math.min(Math.max(Math.log(1 / bound) / Math.log(1 / level), 0.02), 1) : 0);

  function resting({ count, bound, level, enough, most, consistency }) {
    const answers = `${count} answer${count === 1 ? "" : "s"}`;
    const sure = enough
      ? `After ${answers} I know enough: another controller could be better for you by ${percent(level)} at most.`
      : `${count >= most ? `More than ${answers} are too much to ask` : `You stopped after ${answers}`}; the controller may be ${bound >= 1 ? "more than twice as bad as" :
        `up to ${percent(bound)} worse than`} the best one for you.`;
    const { repeats, equal } = consistency;
    const same = repeats ? ` ${repeats === 1 ? "One question" : `${repeats} questions`} came twice; you answered ${
      equal === repeats ? (repeats === 1 ? "it alike" : "all of them alike") : `${equal} of ${repeats} alike`}.` : "";
    return sure + same;
  }

  const test = (standard) => "Now the blind test: pairs from new starts. One response is by the controller " +
    `learned from you, the other by the usual default, ${standard}. You are not told which.`;

  function verdict({ wins, count, ties, low, high }) {
    const undecided = ties ? ` (${ties} time${ties === 1 ? "" : "s"} you saw no difference)` : "";
    const range = `between ${percent(low)} and ${percent(high)} of all pairs`;
    const meaning = low > 0.5 ? "That is more than chance." : high < 0.5
      ? "That is bad news: the default suits you better. Either some answers were slips, or no sum of squares describes what you want."
      : "So few pairs cannot tell that from chance: the two may be about equally good for you.";
    if (!count) return "You saw no difference in any pair: the default is as good for you.";
    return `You chose the learned one ${wins} time${wins === 1 ? "" : "s"} out of ${count}${undecided}. With 95 % confidence you would choose it in ${range}. ${meaning}`;
  }

  ask.words = { percent, progress, resting, sureness, test, verdict };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
