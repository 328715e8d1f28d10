// A clock for both responses: play, pause, again.
(function (ask) {
  "use strict";

  // move(share), share of the duration (s) from 0 to 1; changed(playing, ended) when that changes.
  function player(duration, move, changed) {
    let share = 0, frame = 0, before = null;

    function step(now) {
      frame = requestAnimationFrame(step);
      if (before !== null) share = Math.min(share + (now - before) / (1000 * duration), 1);
      before = now;
      move(share);
      if (share === 1) pause();
    }

    function play() {
      if (frame) return;
      if (share === 1) share = 0;
      before = null;
      frame = requestAnimationFrame(step);
      changed(true, false);
    }

    function pause() {
      cancelAnimationFrame(frame);
      frame = 0;
      changed(false, share === 1);
    }

    // Go to a share of the time.
    function to(place) {
      share = place;
      before = null;
      move(share);
      changed(frame !== 0, share === 1);
    }
    return { play, pause, to, toggle: () => (frame ? pause() : play()) };
  }

  const still = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

  ask.player = { player, still };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
