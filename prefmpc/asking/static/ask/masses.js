// The book's plant: three masses on a line between two walls, joined by springs; forces act on the
// first and the last. All that the page knows of it is here: another plant is another such object.
(function (ask) {
  "use strict";

  ask.masses = () => ({
    name: "oscillating masses",
    // x⁺ = A x + B u, y = C x: prefmpc.oscillating_masses().
    A: [
      [0.9215830466070046, 0.038422585681011305, 0.0005220526041195617, 0.19473018156684418, 0.002603313047213485, 2.101041251889997e-05],
      [0.07684517136202261, 0.8452599278491016, 0.0768451713620226, 0.005206626094426972, 0.18954456588493604, 0.00520662609442697],
      [0.0005220526041195621, 0.03842258568101131, 0.9215830466070046, 2.101041251890003e-05, 0.0026033130472134848, 0.19473018156684413],
      [-0.7685074740785226, 0.36867587958101816, 0.010329210538778333, 0.9215830466070046, 0.0384225856810113, 0.0005220526041195615],
      [0.7373517591620367, -1.4955300227017807, 0.7373517591620364, 0.07684517136202264, 0.8452599278491016, 0.07684517136202262],
      [0.01032921053877834, 0.3686758795810183, -0.7685074740785228, 0.0005220526041195622, 0.0384225856810113, 0.9215830466070046],
    ],
    B: [
      [0.019735454526605495, 7.030273267578595e-07],
      [0.0002624323567132969, 0.0002624323567132967],
      [7.030273267578638e-07, 0.01973545452660549],
      [0.19473018156684413, 2.1010412518899984e-05],
      [0.005206626094426972, 0.00520662609442697],
      [2.1010412518900038e-05, 0.19473018156684416],
    ],
    C: [
      [1, 0, 0, 0, 0, 0],
      [0, 1, 0, 0, 0, 0],
      [0, 0, 1, 0, 0, 0],
    ],
    dt: 0.2,
    uMin: [-1, -1],
    uMax: [1, 1],
    x0: [0.3, 0.3, 0.3, 0.05, 0.05, 0.05], // the largest x(0)
    // The sensible default, and the centre of what is believed at first: Bryson's rule,
    // 1 / (largest acceptable value)², with 0.3 m, 0.3 m/s and 1 N.
    centre: {
      Q: [0.3, 0.3, 0.3, 0.3, 0.3, 0.3].map((largest) => 1 / largest ** 2),
      R: [1, 1],
    },
    // A person slips now and then, and gets tired.
    method: { lapse: 0.03, most: 30 },
    states: [
      { name: "position of mass 1", unit: "1/m²" },
      { name: "position of mass 2", unit: "1/m²" },
      { name: "position of mass 3", unit: "1/m²" },
      { name: "speed of mass 1", unit: "s²/m²" },
      { name: "speed of mass 2", unit: "s²/m²" },
      { name: "speed of mass 3", unit: "s²/m²" },
    ],
    inputs: [
      { name: "force on mass 1", unit: "1/N²" },
      { name: "force on mass 3", unit: "1/N²" },
    ],
    // What is plotted of x, u and y; a signal is at rest when it is near 0.
    plots: [
      { signal: "y", index: [0, 1, 2], label: "position in m", names: ["mass 1", "mass 2", "mass 3"], colours: [0, 1, 2], near: 0.05, legend: true },
      { signal: "u", index: [0, 1], label: "force in N", names: ["force on mass 1", "force on mass 3"], colours: [0, 2] },
    ],
    draw: "masses", // one of ask.draw.scenes
    standard: "Bryson’s rule", // what the centre is called
    // Somebody whose answers can be watched: the weights of the paper's first case study.
    visitor: [40, 40, 40, 5, 5, 5, 0.2, 0.2],
    code: `import jax
from prefmpc import Interview, LinearMPC, oscillating_masses, simulate

jax.config.update("jax_enable_x64", True)
plant, model = oscillating_masses(), Interview.load("answers.jsonl", append=False).model
controller = LinearMPC(plant, model, horizon=10)
print(simulate(plant, controller, [0.3, -0.3, 0.1, 0, 0, 0], steps=20).x[-1].round(3))
`,
  });
})(globalThis.prefmpcAsk = globalThis.prefmpcAsk || {});
