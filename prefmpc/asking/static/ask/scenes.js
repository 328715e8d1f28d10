// Two more drawings: a pendulum on a cart, and a car that changes lanes. Lengths are in metres.
(function (ask) {
  "use strict";
  const { pointer, scenes, svg } = ask.draw;
  const WIDTH = 520, HEIGHT = 104;

  const within = (value, low, high) => Math.min(Math.max(value, low), high);
  const degrees = (angle) => ((angle * 180) / Math.PI).toFixed(2);
  const picture = (...children) =>
    svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, class: "ask-scene", "aria-hidden": "true" }, ...children);

  // x = (position, angle from upright, …), u = (force): the plant of prefmpc.cart_pendulum.
  scenes.pendulum = function () {
    const METRE = 110, FLOOR = 92, ROD = 62, TOP = FLOOR - 22;
    const arm = svg("g", {}, svg("line", { class: "ask-rod", y2: -ROD }), svg("circle", { class: "ask-mass ask-1", cy: -ROD, r: 9 }));
    const cart = svg("g", {}, svg("rect", { class: "ask-mass ask-0", x: -30, y: TOP, width: 60, height: 16, rx: 4 }),
      ...[-17, 17].map((cx) => svg("circle", { class: "ask-wall", cx, cy: FLOOR - 4, r: 5 })), arm);
    const arrow = svg("path", { class: "ask-force ask-0" });
    const element = picture(
      svg("line", { class: "ask-floor", x1: 4, x2: WIDTH - 4, y1: FLOOR + 1, y2: FLOOR + 1 }),
      svg("line", { class: "ask-rest", x1: WIDTH / 2, x2: WIDTH / 2, y1: FLOOR + 2, y2: FLOOR + 10 }), cart, arrow);

    function move(x, u) {
      const at = within(WIDTH / 2 + METRE * x[0], 34, WIDTH - 34);
      cart.setAttribute("transform", `translate(${at.toFixed(2)} 0)`);
      arm.setAttribute("transform", `translate(0 ${TOP}) rotate(${degrees(x[1])})`);
      arrow.setAttribute("d", pointer(at, within(u[0] / 10, -1, 1), TOP + 8));
    }
    return { element, move };
  };

  // x = (lateral position, heading, steering angle, …): the plant of prefmpc.kinematic_bicycle. The
  // car comes from the lane at 3.5 and goes to that at 0; along the road it is drawn by the time.
  scenes.lane = function () {
    const METRE = 12, LANE = 3.5, MIDDLE = HEIGHT / 2;
    const up = (p) => MIDDLE - METRE * (p - LANE / 2);
    const wheel = (x, y) => svg("line", { class: "ask-tyre", x1: -5, x2: 5, transform: `translate(${x} ${y})` });
    const back = [-11, 11].map((y) => wheel(2, y)), front = [-11, 11].map((y) => wheel(34, y));
    const car = svg("g", {}, ...back, ...front,
      svg("rect", { class: "ask-mass ask-0", x: -10, y: -11, width: 54, height: 22, rx: 6 }),
      svg("rect", { class: "ask-pane", x: 22, y: -8, width: 9, height: 16, rx: 3 }));
    const line = (p, name) => svg("line", { class: name, x1: 0, x2: WIDTH, y1: up(p), y2: up(p) });
    const element = picture(line(-LANE / 2, "ask-floor"), line(LANE / 2, "ask-dashes"), line(1.5 * LANE, "ask-floor"),
      svg("line", { class: "ask-rest", x1: WIDTH - 12, x2: WIDTH - 4, y1: up(0), y2: up(0) }), car);

    function move(x, u, share) {
      const y = within(up(x[0]), 0, HEIGHT);
      car.setAttribute("transform", `translate(${(16 + 450 * share).toFixed(2)} ${y.toFixed(2)}) rotate(${degrees(-x[1])})`);
      front.forEach((part, i) => part.setAttribute("transform", `translate(34 ${i ? 11 : -11}) rotate(${degrees(-x[2])})`));
    }
    return { element, move };
  };
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
