// Step-by-step view: 2σ ellipse in the phase plane, which grows in each prediction and shrinks along
// the measurement in each update, and the equations of the lesson UAT 366, module 2, with numbers.
const Step = (() => {
  const CORNERS = 120;
  // duration of a prediction or update in the animation
  const STEP_TIME_MS = 400;

  /* Points of the 2σ ellipse, from the Cholesky factor of P */
  function ellipse([p, v, p00, p01, p11]) {
    const a = Math.sqrt(p00), b = p01 / a, c = Math.sqrt(Math.max(p11 - b * b, 0));
    const out = { p: new Float64Array(CORNERS + 1), v: new Float64Array(CORNERS + 1) };
    for (let i = 0; i <= CORNERS; i++) {
      const turn = 2 * Math.PI * (i % CORNERS) / CORNERS, x = 2 * Math.cos(turn), y = 2 * Math.sin(turn);
      out.p[i] = p + a * x;
      out.v[i] = v + b * x + c * y;
    }
    return out;
  }

  /* All predictions and updates of a KF run in order: `i` is the index of the step, `u` of the measurement or -1 */
  function moments({ steps, updates }) {
    const list = [];
    for (let i = 0, u = 0; i < steps.time.length; i++) {
      const updateIndex = updates.step[u] === i ? u++ : -1;
      list.push({ i, u: updateIndex, updated: false });
      if (updateIndex >= 0) list.push({ i, u: updateIndex, updated: true });
    }
    return list;
  }
  const stateOf = (s, i) => [s.p[i], s.v[i], s.p00[i], s.p01[i], s.p11[i]];
  const state = ({ steps, updates }, { i, u, updated }) => u >= 0 && !updated ? stateOf(updates, u) : stateOf(steps, i);

  const format = (x, digits = 4) => Math.abs(x) >= 1e-4 || x === 0 ? x.toFixed(digits) : x.toExponential(2);
  const matrix = (a, b, d) => `[${format(a, 5)}  ${format(b, 5)}; ${format(b, 5)}  ${format(d, 5)}]`;
  const trend = (before, now) => now > before ? "increases" : now < before ? "decreases" : "stays equal";
  const sigma = (before, now) => `σ_p ${trend(before, now)}: ${format(Math.sqrt(before))} to ${format(Math.sqrt(now))} m`;

  /* Equations with numbers: rows [title, text] of prediction and update */
  function equations(run, settings, moment) {
    const { steps: s, updates: m } = run, { i, u, updated } = moment;
    const [, , b00, b01, b11] = stateOf(s, i - 1), [p, v, p00, p01, p11] = state(run, { i, u, updated: false });
    const dt = s.time[i] - s.time[i - 1], a = s.acceleration[i - 1];
    const q = (settings.sigma_a_m_s2 ** 2 + s.extra[i - 1]) * settings.dt_s;
    const prediction = [
      ["Previous state", `x⁺ = [${format(s.p[i - 1])} m, ${format(s.v[i - 1])} m/s]`],
      ["", `P⁺ = ${matrix(b00, b01, b11)}`],
      ["Prediction", `F = [1  ${format(dt)}; 0  1], B = [${format(dt * dt / 2, 5)}; ${format(dt)}], a = ${format(a, 3)} m/s²`],
      ["", `Q = ${matrix(q * dt ** 3 / 4, q * dt * dt / 2, q * dt)}`],
      ["", `x⁻ = Fx⁺ + Ba = [${format(p)} m, ${format(v)} m/s]`],
      ["", `P⁻ = FP⁺Fᵀ + Q = ${matrix(p00, p01, p11)}`],
      ["", sigma(b00, p00)],
    ];
    if (u < 0) return [prediction, []];
    const update = [
      ["Measurement", `z = ${format(m.z[u])} m, R = SIGMA_Z² = ${format(settings.sigma_z_m ** 2, 5)} m²`],
      ["Innovation", `ν = z − Hx⁻ = ${format(m.nu[u])} m`],
      ["", `S = HP⁻Hᵀ + R = ${format(m.s[u], 5)} m²; ν²/S = ${format(m.nu[u] ** 2 / m.s[u], 2)}`]];
    if (updated) {
      const [x, w, c00, c01, c11] = stateOf(s, i);
      update.push(
        ["Gain", `K = P⁻Hᵀ/S = [${format(m.k0[u])}, ${format(m.k1[u])} 1/s]`],
        ["Update", `x⁺ = x⁻ + Kν = [${format(x)} m, ${format(w)} m/s]`],
        ["", `P⁺ = (I − KH)P⁻ = ${matrix(c00, c01, c11)}`],
        ["", sigma(p00, c00)]);
    }
    return [prediction, update];
  }

  function start(page) {
    const { settings, selected, result, model, setSource, figures, isVisible, moved } = page;
    let cached = { run: null, list: [] };
    const listNow = () => {
      const { run } = result;
      if (cached.run !== run) cached = { run, list: run === null ? [] : moments(run) };
      return cached.list;
    };
    // index of a prediction or update in listNow(), and timer of the animation
    let moment = null, playing = null;

    /* Show KF after the update with a measurement (index) */
    function goTo(measurement) {
      const list = listNow();
      if (!list.length) return;
      const last = result.run.updates.nu.length - 1;
      selected.measurement = clamp(measurement, 0, last);
      moment = list.findIndex(({ u, updated }) => updated && u === selected.measurement);
      draw();
      moved(result.run.updates.time[selected.measurement]);
    }
    function advance() {
      const list = listNow();
      moment = Math.min((moment ?? 0) + 1, list.length - 1);
      selected.measurement = list.slice(0, moment + 1).findLast(({ u }) => u >= 0)?.u ?? selected.measurement;
      draw();
      moved(result.run.steps.time[list[moment].i]);
      if (moment === list.length - 1) pause();
    }
    function pause() {
      clearInterval(playing);
      playing = null;
      $("play").textContent = "Play";
      $("now").ariaLive = "polite";
    }
    function play() {
      if (playing !== null) return pause();
      const list = listNow();
      if (!list.length) return;
      if (moment === null || moment >= list.length - 1) moment = 0;
      playing = setInterval(advance, STEP_TIME_MS);
      $("play").textContent = "Pause";
      // too fast for a screen reader
      $("now").ariaLive = "off";
    }
    function draw() {
      const { run } = result;
      // the view opens at the first update
      if (isVisible("step")) selected.measurement ??= 0;
      if (moment === null && selected.measurement !== null) {
        const requested = Math.min(selected.measurement, (run?.updates.nu.length ?? 1) - 1);
        moment = listNow().findIndex(({ u, updated }) => updated && u === requested);
        if (moment < 0) moment = null;
      }
      const hasMoment = run !== null && moment !== null;
      const lines = figures.flatMap((plot) => plot.center).filter(({ name }) => name === "cursor");
      for (const line of lines) line.visible = hasMoment;
      for (const id of ["first", "previous", "next", "last", "play"]) $(id).disabled = run === null;
      if (run !== null) $("cursor").max = run.updates.nu.length - 1;
      if (!hasMoment) {
        $("now").textContent = "Select a measurement with the buttons or the key n.";
        return;
      }
      const list = listNow(), now = list[Math.min(moment, list.length - 1)], t = run.steps.time[now.i];
      for (const line of lines) line.location = t;
      const count = run.updates.nu.length, slider = $("cursor");
      slider.value = selected.measurement;
      slider.ariaValueText = `Measurement ${selected.measurement + 1} of ${count}`;
      $("now").textContent = now.u >= 0 ? `Measurement ${now.u + 1} of ${count}, at ${t.toFixed(3)} s`
        + (now.updated ? ": after the update of KF" : ": before the update of KF") : `KF's prediction has reached ${t.toFixed(3)} s`;
      if (!isVisible("step")) return;
      drawPlane(run, now);
      if (now.i === 0) return $("numbers").replaceChildren(make("p", "Initial state of KF: the first measured position, velocity 0."));
      const table = make("table");
      equations(run, settings, now).forEach((rows, isUpdate) => {
        for (const [title, text] of rows) {
          const row = table.insertRow();
          row.append(make("th", title, { scope: "row" }), make("td", text));
          row.className = isUpdate === Number(now.updated) ? "now" : "";
        }
      });
      $("numbers").replaceChildren(table);
    }
    function drawPlane(run, current) {
      const plot = model("step"), now = state(run, current);
      const previous = current.updated ? state(run, { ...current, updated: false }) : stateOf(run.steps, Math.max(current.i - 1, 0));
      setSource("now", ellipse(now));
      setSource("before", ellipse(previous));
      setSource("mean", { p: [now[0]], v: [now[1]] });
      const isMeasured = current.u >= 0, z = run.updates.z[current.u];
      const [band, line] = ["band", "measurement"].map((name) => plot.center.find((item) => item.name === name));
      band.visible = line.visible = isMeasured;
      if (isMeasured) {
        [band.left, band.right] = [z - 2 * settings.sigma_z_m, z + 2 * settings.sigma_z_m];
        line.location = z;
      }
      // the same scale for the whole run shows changes of the ellipse; only the first ellipses are larger
      const reach = [run.updates.p00, run.updates.p11].map((variances, i) => Math.sqrt(Math.max(
        8 * variances.toSorted()[Math.floor(0.9 * variances.length)], 5 * now[2 + 2 * i])));
      [plot.x_range.start, plot.x_range.end] = [now[0] - reach[0], now[0] + reach[0]];
      [plot.y_range.start, plot.y_range.end] = [now[1] - reach[1], now[1] + reach[1]];
    }
    const actions = { first: () => goTo(0), previous: () => goTo((selected.measurement ?? 1) - 1),
      next: () => goTo((selected.measurement ?? -1) + 1), last: () => goTo(Infinity), play };
    for (const [id, act] of Object.entries(actions)) onClick(id, act);
    $("cursor").addEventListener("input", (event) => goTo(Number(event.target.value)));
    // a new KF run has other steps but the same measurements
    const restart = () => {
      moment = null;
      draw();
    };
    return { ...actions, goTo, draw: restart, at: () => moment };
  }

  return { start, ellipse, moments, state };
})();
