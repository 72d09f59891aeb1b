/* EKF2 with other parameters: only at the stops that Python replayed, nothing between them. */
const Grid = (() => {
  const WORDS = { EKF2_EVP_NOISE: "noise of the position", EKF2_EV_DELAY: "age of the position at its stamp",
    EKF2_EVP_GATE: "gate of the innovation", EKF2_GPS_P_NOISE: "noise of the position, at least",
    EKF2_GPS_DELAY: "age of a fix at its stamp", EKF2_GPS_P_GATE: "gate of the innovation" };
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
      for (const name of ["nu", "sigma", "p", "v", "sp", "sv"]) one[name] = one[name].map((place) => arrays[place]);
    }
    ({ stops } = grid);
    at = [...grid.flown];
    $("grid-note").textContent = `By a model of EKF2 that agrees with this log: ${grid.agreement}. `
      + "Its innovations, position, velocity, σ, numbers and marks change; along the axis down all stays as logged."
      + (grid.every > 1 ? ` One of ${grid.every} innovations is drawn; the numbers are of all.` : "");
    for (const [i, [name, , values]] of stops.entries()) {
      const label = make("label", `${name} `, { htmlFor: name }), line = make("div", undefined, { className: "knob" });
      const value = make("output", "", { id: `${name}-value` });
      const slider = make("input", undefined, { type: "range", min: 0, max: values.length - 1, step: 1, id: name });
      label.append(make("small", WORDS[name]));
      slider.addEventListener("input", () => {
        at[i] = Number(slider.value);
        shown = true;
        redraw();
      });
      line.append(label, value, slider);
      $("grid-knobs").append(line);
    }
    box.addEventListener("change", () => { shown = box.checked; redraw(); });
  }
  function tell() {
    if (typeof lone.grid === "string") return;
    $("other-ekf2").checked = shown;
    for (const [i, [name, unit, values]] of stops.entries()) {
      const words = `${values[at[i]]} ${unit}${at[i] === lone.grid.flown[i] ? " (flown)" : ""}`;
      $(`${name}-value`).textContent = $(name).ariaValueText = words;
      $(name).value = at[i];
    }
  }

  /* The stops as parts of the address, where EKF2 is shown with others than the log's */
  const toAddress = () => shown ? Object.fromEntries(stops.map(([name, , values], i) => [name, values[at[i]]])) : {};
  /* Takes them from there; gives the names of what is no stop */
  function fromAddress(parts) {
    const ignored = [];
    shown = false;
    for (const [i, [name, , values]] of stops.entries()) {
      at[i] = lone.grid.flown[i];
      if (!parts.has(name)) continue;
      const stop = values.indexOf(Number(parts.get(name)));
      if (stop < 0) { ignored.push(name); continue; }
      at[i] = stop;
      shown = true;
    }
    return ignored;
  }

  /* The case of the stops as they stand; null while EKF2 is shown as logged */
  function chosen(flight, axis) {
    if (!shown || flight !== lone) return null;
    const one = lone.grid.cases[at.reduce((sum, stop, i) => sum * stops[i][2].length + stop, 0)];
    return one.axes[axis.name] ? one : null;
  }

  /* Its innovations, state and σ along an axis, as the log's own */
  function rows(flight, axis) {
    const one = chosen(flight, axis);
    if (one === null) return null;
    const [c, s] = axis.direction;
    const sum = ([north, east]) => north.map((x, i) => c * x + s * east[i]);
    const norm = ([north, east]) => north.map((x, i) => Math.hypot(c * x, s * east[i]));
    return { t: one.time, rejected: one.flag, nu: sum(one.nu), sigma: norm(one.sigma), p: sum(one.p),
      v: sum(one.v), sp: norm(one.sp), sv: norm(one.sv) };
  }

  function say(flight, axis) {
    tell();
    const one = chosen(flight, axis);
    $("grid-said").textContent = !shown ? "" : one === null ? "The model has no height: EKF2 stays as logged; choose another axis."
      : `${(100 * one.share).toFixed(1)} % rejected, ${one.resets} reset${one.resets === 1 ? "" : "s"}`
        + `${one.lost ? `, ${one.lost} samples too late for it` : ""}.`
        + (one.share > lone.grid.most ? " Chaotic: each rejection decides the next, and the numbers predict nothing." : "");
  }

  return { start, chosen, rows, say, toAddress, fromAddress };
})();
