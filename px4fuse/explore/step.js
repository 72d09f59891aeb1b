/* Step-by-step view: 2σ ellipse in the phase plane, which grows in each prediction and shrinks along
   the measurement in each update, with the lesson's equations in numbers. */
const Step = (() => {
  const CORNERS = 120;
  const TRAIL = 60; // steps in the trail of means
  const STEP_TIMES_MS = [1600, 800, 400, 200, 100, 50];

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

  /* All predictions and updates of a run in order: i is the step, u the measurement or -1 */
  function moments({ steps, updates }) {
    const list = [{ i: 0, u: -1, updated: false }];
    for (let i = 1, u = 0; i < steps.time.length; i++) {
      const updateIndex = u < updates.step.length && updates.step[u] === i ? u++ : -1;
      list.push({ i, u: updateIndex, updated: false });
      if (updateIndex >= 0) list.push({ i, u: updateIndex, updated: true });
    }
    return list;
  }
  const stateAfter = ({ steps: s }, i) => [s.p[i], s.v[i], s.p00[i], s.p01[i], s.p11[i]];
  function state(run, { i, u, updated }) {
    const { updates: s } = run;
    return u >= 0 && !updated ? [s.p[u], s.v[u], s.p00[u], s.p01[u], s.p11[u]] : stateAfter(run, i);
  }

  const format = (x, digits = 4) => Math.abs(x) >= 1e-4 || x === 0 ? x.toFixed(digits) : x.toExponential(2);
  const matrix = (a, b, d) => `[${format(a, 5)}  ${format(b, 5)}; ${format(b, 5)}  ${format(d, 5)}]`;
  const grows = (before, now) => now > before ? "increases" : now < before ? "decreases" : "unchanged";
  const sigma = (before, now) => `σ_p ${grows(before, now)}: ${format(Math.sqrt(before))} to ${format(Math.sqrt(now))} m`;

  /* Equations of the lesson with the numbers of this step: [label, text, true for the update] */
  function equations(run, settings, moment) {
    const { steps: s, updates: m } = run, { i, u, updated } = moment;
    const [, , b00, b01, b11] = stateAfter(run, i - 1), prior = state(run, { i, u, updated: false });
    const [p, v, p00, p01, p11] = prior, dt = s.time[i] - s.time[i - 1], a = s.acceleration[i - 1];
    const q = (settings.sigmaA ** 2 + s.extra[i - 1]) * settings.dt;
    const rows = [
      ["Before", `x⁺ = [${format(s.p[i - 1])} m, ${format(s.v[i - 1])} m/s]`, false],
      ["", `P⁺ = ${matrix(b00, b01, b11)}`, false],
      ["Predict", `F = [1  ${format(dt)}; 0  1], B = [${format(dt * dt / 2, 5)}; ${format(dt)}], a = ${format(a, 3)} m/s²`, false],
      ["", `Q = ${matrix(q * dt ** 3 / 4, q * dt * dt / 2, q * dt)}`, false],
      ["", `x⁻ = Fx⁺ + Ba = [${format(p)} m, ${format(v)} m/s]`, false],
      ["", `P⁻ = FP⁺Fᵀ + Q = ${matrix(p00, p01, p11)}`, false],
      ["", sigma(b00, p00), false],
    ];
    if (u < 0) return rows;
    const r = settings.sigmaZ ** 2;
    rows.push(
      ["Measure", `z = ${format(m.z[u])} m, R = SIGMA_Z² = ${format(r, 5)} m²`, true],
      ["Compare", `ν = z − Hx⁻ = ${format(m.nu[u])} m`, true],
      ["", `S = HP⁻Hᵀ + R = ${format(m.s[u], 5)} m²; ν²/S = ${format(m.nu[u] ** 2 / m.s[u], 2)}`, true]);
    if (updated) {
      const [x, w, c00, c01, c11] = stateAfter(run, i);
      rows.push(
        ["Gain", `K = P⁻Hᵀ/S = [${format(m.k0[u])}, ${format(m.k1[u])} 1/s]`, true],
        ["Update", `x⁺ = x⁻ + Kν = [${format(x)} m, ${format(w)} m/s]`, true],
        ["", `P⁺ = (I − KH)P⁻ = ${matrix(c00, c01, c11)}`, true],
        ["", sigma(p00, c00), true]);
    }
    return rows;
  }

  function start(page) {
    const { settings, chosen, result, model, setSource, figures, isSeen, moved } = page;
    let cached = { run: null, list: [] };
    const listNow = () => {
      const { run } = result;
      if (cached.run !== run) cached = { run, list: run === null ? [] : moments(run) };
      return cached.list;
    };
    let moment = null, playing = null, speed = 2; // indices: of moments of the run, and of STEP_TIMES_MS

    /* Go to a measurement (index), after its update */
    function go(measurement) {
      const list = listNow();
      if (!list.length) return;
      const last = result.run.updates.nu.length - 1;
      chosen.step = Math.min(Math.max(measurement, 0), last);
      moment = list.findIndex((one) => one.u === chosen.step && one.updated);
      draw();
      moved(result.run.updates.time[chosen.step]);
    }
    function advance() {
      const list = listNow();
      moment = Math.min((moment ?? 0) + 1, list.length - 1);
      for (let at = moment; at >= 0; at--) if (list[at].u >= 0) { chosen.step = list[at].u; break; }
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
      playing = setInterval(advance, STEP_TIMES_MS[speed]);
      $("play").textContent = "Pause";
      $("now").ariaLive = "off"; // too fast for a screen reader
    }
    function faster(by) {
      speed = Math.min(Math.max(speed + by, 0), STEP_TIMES_MS.length - 1);
      if (playing !== null) { clearInterval(playing); playing = setInterval(advance, STEP_TIMES_MS[speed]); }
      $("slower").disabled = speed === 0;
      $("faster").disabled = speed === STEP_TIMES_MS.length - 1;
    }

    function draw() {
      const { run } = result;
      if (isSeen("step")) chosen.step ??= 0; // opens at the first update
      if (moment === null && chosen.step !== null) {
        const requested = Math.min(chosen.step, (run?.updates.nu.length ?? 1) - 1);
        moment = listNow().findIndex((one) => one.u === requested && one.updated);
        if (moment < 0) moment = null;
      }
      const known = run !== null && moment !== null;
      const lines = figures.flatMap((plot) => plot.center).filter((one) => one.name === "cursor");
      for (const line of lines) line.visible = known;
      for (const id of ["first", "previous", "next", "last", "play"]) $(id).disabled = run === null;
      if (run !== null) $("cursor").max = run.updates.nu.length - 1;
      if (!known) {
        $("now").textContent = "Select a measurement with n or the buttons.";
        return;
      }
      const list = listNow(), one = list[Math.min(moment, list.length - 1)], t = run.steps.time[one.i];
      for (const line of lines) line.location = t;
      const count = run.updates.nu.length, slider = $("cursor");
      slider.value = chosen.step;
      slider.ariaValueText = `Measurement ${chosen.step + 1} of ${count}`;
      $("now").textContent = one.u >= 0 ? `Measurement ${one.u + 1} of ${count}, at ${t.toFixed(3)} s`
        + (one.updated ? "" : ": predicted, not yet updated") : `Predicted to ${t.toFixed(3)} s`;
      if (!isSeen("step")) return;
      drawPlane(run, one);
      if (one.i === 0) return $("numbers").replaceChildren(make("p", "Initial state."));
      const table = make("table");
      for (const [head, text, update] of equations(run, settings, one)) {
        const row = table.insertRow();
        row.append(make("th", head, { scope: "row" }), make("td", text));
        row.className = update === one.updated ? "now" : "";
      }
      $("numbers").replaceChildren(table);
    }
    function drawPlane(run, one) {
      const plot = model("step"), now = state(run, one);
      const previous = one.updated ? state(run, { ...one, updated: false }) : stateAfter(run, Math.max(one.i - 1, 0));
      setSource("now", ellipse(now));
      setSource("before", ellipse(previous));
      setSource("mean", { p: [now[0]], v: [now[1]] });
      const from = Math.max(one.i - TRAIL, 0);
      setSource("trail-means", { p: run.steps.p.subarray(from, one.i), v: run.steps.v.subarray(from, one.i) });
      const measured = one.u >= 0, z = measured ? run.updates.z[one.u] : 0;
      const band = plot.center.find((part) => part.name === "band");
      const line = plot.center.find((part) => part.name === "measurement");
      band.visible = line.visible = measured;
      if (measured) {
        [band.left, band.right] = [z - 2 * settings.sigmaZ, z + 2 * settings.sigmaZ];
        line.location = z;
      }
      // constant scale over the run, so that changes of the ellipse are visible; larger at the start
      const reach = reachOf(run).map((typical, i) => Math.max(typical, 2.2 * Math.sqrt(now[2 + 2 * i])));
      [plot.x_range.start, plot.x_range.end] = [now[0] - reach[0], now[0] + reach[0]];
      [plot.y_range.start, plot.y_range.end] = [now[1] - reach[1], now[1] + reach[1]];
    }
    let cachedReach = { run: null, reach: [1, 1] };
    function reachOf(run) {
      if (cachedReach.run === run) return cachedReach.reach;
      const typical = (values) => Float64Array.from(values, Math.sqrt).sort()[Math.floor(0.9 * values.length)];
      const wide = Math.max(2.5 * typical(run.updates.p00), 2.5 * Math.min(settings.sigmaZ, 20 * typical(run.updates.p00)));
      cachedReach = { run, reach: [wide, 2.8 * typical(run.updates.p11)] };
      return cachedReach.reach;
    }

    const actions = { first: () => go(0), previous: () => go((chosen.step ?? 1) - 1),
      next: () => go((chosen.step ?? -1) + 1), last: () => go(Infinity), play,
      slower: () => faster(-1), faster: () => faster(1) };
    for (const [id, act] of Object.entries(actions)) $(id).addEventListener("click", act);
    $("cursor").addEventListener("input", (event) => go(Number(event.target.value)));
    const restart = () => { // a new run has other steps, so the selected measurement is kept
      moment = null;
      draw();
    };
    return { go, draw: restart, play, pause, faster, at: () => moment, listNow };
  }

  return { start, ellipse, moments, state };
})();
