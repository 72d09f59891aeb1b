/* EKF2 with other parameters: only at the stops that Python replayed, nothing between them. */
"use strict";
const Grid = (() => {
  const $ = (id) => document.getElementById(id);
  const WORDS = { EKF2_EVP_NOISE: "noise of the position", EKF2_EV_DELAY: "age of the position at its stamp",
    EKF2_EVP_GATE: "gate of the innovation" };
  let lone = null, stops = [], at = [], shown = false;

  function start(flights, arrays, redraw) {
    lone = flights[0];
    const { grid } = lone, box = $("other-ekf2");
    if (typeof grid === "string") {
      $("grid-note").textContent = `Not here: ${grid}.`;
      box.disabled = true;
      return;
    }
    for (const one of grid.cases) {
      for (const name of ["time", "flag", "rejected", "reset"]) one[name] = arrays[one[name]];
      for (const name of ["nu", "sigma"]) one[name] = one[name].map((place) => arrays[place]);
    }
    ({ stops } = grid);
    at = [...grid.flown];
    $("grid-note").textContent = `By a model of EKF2 that agrees with this log: ${grid.agreement}. `
      + "The innovations, the table and the marks change; position, velocity and σ stay as logged."
      + (grid.every > 1 ? ` One of ${grid.every} innovations is drawn; the numbers are of all.` : "");
    const knobs = stops.map(([name, unit, values], i) => {
      const label = document.createElement("label"), line = document.createElement("div");
      const value = document.createElement("output"), slider = document.createElement("input");
      Object.assign(slider, { type: "range", min: 0, max: values.length - 1, step: 1, value: at[i], id: name });
      label.htmlFor = name;
      label.textContent = `${name} `;
      const hint = document.createElement("small");
      hint.textContent = WORDS[name];
      label.append(hint);
      line.className = "knob";
      const told = () => {
        value.textContent = `${values[at[i]]} ${unit}${at[i] === grid.flown[i] ? " (flown)" : ""}`;
        slider.ariaValueText = value.textContent;
      };
      slider.addEventListener("input", () => {
        at[i] = Number(slider.value);
        told();
        shown = box.checked = true;
        requestAnimationFrame(redraw);
      });
      told();
      line.append(label, value, slider);
      return line;
    });
    $("grid-knobs").append(...knobs);
    box.addEventListener("change", () => { shown = box.checked; redraw(); });
  }

  /* The case of the stops as they stand; null while EKF2 is shown as logged */
  function chosen(flight, axis) {
    if (!shown || flight !== lone) return null;
    const one = lone.grid.cases[at.reduce((sum, stop, i) => sum * stops[i][2].length + stop, 0)];
    return one.axes[axis.name] ? one : null;
  }

  /* Its innovations along an axis, as the log's own */
  function rows(flight, axis) {
    const one = chosen(flight, axis);
    if (one === null) return null;
    const [c, s] = axis.direction, [north, east] = one.nu, [a, b] = one.sigma;
    return { t: one.time, rejected: one.flag, nu: north.map((x, i) => c * x + s * east[i]),
      sigma: a.map((x, i) => Math.hypot(c * x, s * b[i])) };
  }

  function say(flight, axis) {
    const one = chosen(flight, axis);
    $("grid-said").textContent = !shown ? "" : one === null ? "The model has no height: choose another axis."
      : `${(100 * one.share).toFixed(1)} % rejected, ${one.resets} reset${one.resets === 1 ? "" : "s"}`
        + `${one.lost ? `, ${one.lost} samples too late for it` : ""}.`;
  }

  return { start, chosen, rows, say };
})();
