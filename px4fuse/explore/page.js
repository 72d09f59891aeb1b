/* Main script of the page: runs KF with the settings and draws plots and numbers. */
const Explore = (async () => {
  // maximum number of drawn points of a line, and while a slider is dragged
  const MAX_POINTS = 3000, MAX_DRAG_POINTS = 600;
  const read = (id) => $(`${id}${Practice.suffix}`).textContent;
  // ------------------------------------------------------------------ the flight's data
  const arrays = await Engine.unpack(read("arrays"), JSON.parse(read("content")).packed);
  const withArrays = (_, value) => value?.array === undefined ? value : arrays[value.array];
  const { flight, ranges, places } = JSON.parse(read("content"), withArrays);
  const { imu, axes } = flight;
  // ------------------------------------------------------------------ settings
  // `log`: ends of a logarithmic slider; a slider without `log` is linear. `likely`: maximum-likelihood estimate
  const SETTINGS = [
    { id: "sigma-a", key: "sigma_a_m_s2", title: "SIGMA_A", unit: "m/s²", log: [0.001, 100],
      hint: "process noise", likely: () => likelyNow()[0] },
    { id: "sigma-z", key: "sigma_z_m", title: "SIGMA_Z", unit: "m", log: [0.001, 10],
      hint: "measurement noise", likely: () => likelyNow()[1] },
    { id: "clock-offset", key: "clock_offset_s", title: "Time offset", unit: "s",
      hint: "time added to the position timestamps", likely: () => flight.offset.likely },
    { id: "dt", key: "dt_s", title: "DT", unit: "s", log: [0.01, 1], hint: "prediction step" },
  ];
  const TICKS = 600;
  const settings = { ...flight.settings, axis: flight.main };
  // index of the measurement selected with the keys n and p, or null
  const selected = { measurement: null };
  const round = (value, digits) => Number(value.toPrecision(digits));
  // set if the time offset cannot change
  const fixedReason = flight.offset.why;
  const offsetLimits = fixedReason ? [settings.clock_offset_s, settings.clock_offset_s] : [flight.offset.from, flight.offset.to];
  const limits = (setting) => setting.key === "clock_offset_s" ? offsetLimits : ranges.settings[setting.key];
  const isWithinLimits = (setting, text) => {
    const [low, high] = limits(setting);
    return text !== "" && text >= low && text <= high;
  };
  const fromSlider = (setting, tick) => {
    const [low, high] = setting.log?.map(Math.log) ?? offsetLimits, value = low + (high - low) * tick / TICKS;
    return setting.log ? round(Math.exp(value), 3) : Math.round(value * 1e4) / 1e4;
  };
  const toSlider = (setting, value) => {
    const [low, high, place] = setting.log ? [...setting.log, value].map(Math.log) : [...offsetLimits, value];
    return Math.round(clamp((place - low) / (high - low || 1), 0, 1) * TICKS);
  };
  for (const setting of SETTINGS) {
    const box = make("div", "", "setting");
    const label = make("label", `${setting.title} `, { htmlFor: `${setting.id}-value` });
    label.append(make("small", `${setting.unit}, ${setting.hint} `), setting.estimate = make("small"));
    setting.number = make("input", "", { type: "number", id: `${setting.id}-value`, step: "any" });
    setting.slider = make("input", "", {
      type: "range", id: setting.id, min: 0, max: TICKS, step: 1, ariaLabel: setting.title });
    const id = `${setting.id}-likely`, ticks = make("datalist", "", { id });
    ticks.append(setting.tick = make("option"));
    setting.slider.setAttribute("list", id);
    setting.slider.addEventListener("input", () => {
      set({ [setting.key]: fromSlider(setting, Number(setting.slider.value)) }, true);
    });
    setting.slider.addEventListener("change", () => show());
    setting.number.addEventListener("change", () => {
      const text = setting.number.value, [low, high] = limits(setting);
      if (isWithinLimits(setting, text)) return set({ [setting.key]: Number(text) });
      showMessage(`${setting.title} must be between ${low} and ${high} ${setting.unit}.`);
      show();
    });
    box.append(label, setting.number, setting.slider, ticks);
    if (setting.key === "clock_offset_s" && fixedReason) box.append(make("p", fixedReason, "note"));
    $("sliders").append(box);
  }
  const names = axes.map((axis) => axis.name);
  for (const value of names) {
    const label = make("label");
    label.append(make("input", "", { type: "radio", name: "axis", value }), ` ${value}`);
    $("axes").append(label);
  }
  $("axes").addEventListener("change", (event) => set({ axis: event.target.value }));
  const hasImu = !isText(imu);
  for (const radio of queryAll("[name=input]")) {
    radio.addEventListener("change", () => set({ input: radio.value }));
    if (radio.value === "imu" && !hasImu) {
      radio.disabled = true;
      $("input-note").textContent = imu;
    }
  }
  /* Show the maximum-likelihood estimate in the label and on the track of a slider */
  function showLikely(setting) {
    const value = setting.likely?.() ?? null;
    setting.tick.value = value === null ? "" : toSlider(setting, value);
    setting.estimate.textContent = value === null ? "" : `(maximum likelihood ${round(value, 3)})`;
  }
  const axisNow = () => axes.find((axis) => axis.name === settings.axis);
  const showMessage = (text) => { $("message").textContent = text; };
  const likelyNow = () => flight.likely[axisNow().noises] ?? [null, null];

  onClick("lesson", () => {
    const { sigma_a_m_s2, sigma_z_m, dt_s } = ranges.lesson;
    set({ sigma_a_m_s2, sigma_z_m, dt_s });
    showMessage("SIGMA_A, SIGMA_Z and DT are set to the values of the lesson UAT 366, module 2.");
  });
  onClick("likely", () => {
    const [sigmaA, sigmaZ] = likelyNow().map((value) => round(value, 3));
    set({ sigma_a_m_s2: sigmaA, sigma_z_m: sigmaZ, dt_s: flight.settings.dt_s });
    showMessage("SIGMA_A and SIGMA_Z are set to the maximum-likelihood estimates of this flight.");
  });
  onClick("ekf2-r", () => {
    set({ sigma_z_m: round(axisNow().ekf2.r, 3) });
    showMessage("SIGMA_Z is set to the median of √R of EKF2.");
  });

  /* Change settings, re-run KF and draw; during a drag at most once per frame, with fewer points */
  let nextFrame = null;
  function set(changes, isDragged = false) {
    Object.assign(settings, changes);
    if ($("message").textContent) showMessage("");
    if (isDragged) nextFrame ??= requestAnimationFrame(() => show(true));
    else show();
  }

  // ------------------------------------------------------------------ the address
  function toAddress() {
    const values = { axis: settings.axis, input: settings.input, ...Practice.toAddress() };
    for (const { id, key } of SETTINGS) values[id] = settings[key];
    if (view !== "errors") values.view = view;
    if (selected.measurement !== null) values.measurement = selected.measurement + 1;
    const text = `#${new URLSearchParams(values)}`;
    if (text !== location.hash) history.replaceState(null, "", text);
  }
  function fromAddress() {
    const values = new URLSearchParams(location.hash.slice(1)), ignored = [];
    const take = (name, isValid, use) => {
      if (!values.has(name)) return;
      const value = values.get(name);
      if (isValid(value)) use(value);
      else ignored.push(name);
    };
    for (const setting of SETTINGS) {
      take(setting.id, (text) => isWithinLimits(setting, text), (text) => { settings[setting.key] = Number(text); });
    }
    take("axis", (name) => names.includes(name), (name) => { settings.axis = name; });
    take("input", (name) => name === "zero" || (name === "imu" && hasImu), (name) => { settings.input = name; });
    take("view", (name) => viewButtons.some(({ value }) => value === name), (name) => open(name, false));
    take("measurement", (text) => Number.isInteger(Number(text)) && text > 0,
      (text) => { selected.measurement = text - 1; });
    if (ignored.length) showMessage(`Invalid values in the page address are ignored: ${ignored.join(", ")}.`);
  }

  // ------------------------------------------------------------------ views
  const PLOTS = queryAll(".plot > div").map(({ id }) => id);
  const viewButtons = queryAll("[name=view]");
  let view = "errors";
  const isVisible = (plot) => $(plot)?.closest("[data-view]").dataset.view === view;
  function open(name, draw = true) {
    view = name;
    for (const button of viewButtons) button.checked = button.value === name;
    for (const box of queryAll("[data-view]")) box.hidden = box.dataset.view !== name;
    if (draw) { axisShown = null; show(); }
  }
  for (const button of viewButtons) button.addEventListener("change", () => open(button.value));

  // ------------------------------------------------------------------ Bokeh
  Bokeh.logger.set_level("off");
  await Bokeh.embed.embed_items({ page: JSON.parse(read("document")) }, [
    { docid: "page", roots: places, root_ids: Object.keys(places) }]);
  const page = Bokeh.documents[0];
  const models = new Map();
  const model = (name) => {
    if (!models.has(name)) models.set(name, page.get_model_by_name(name));
    return models.get(name);
  };
  const setSource = (name, data) => Object.assign(model(`${name}-source`) ?? {}, { data });
  /* Draw columns, reduced to a few thousand points, in each visible plot with this source */
  function drawSource(name, columns, keys) {
    const data = decimate(columns, keys);
    for (const plot of PLOTS.filter(isVisible)) setSource(`${plot}:${name}`, data);
  }
  const timeRange = model("time");
  const figures = PLOTS.map(model);
  /* Rows within the visible time range; of long series only minimum and maximum of `keys` in each time bin */
  let pointLimit = MAX_POINTS;
  function decimate(columns, keys) {
    const t = columns.t, n = t.length;
    const from = Math.max(t.findIndex((time) => time >= timeRange.start) - 1, 0);
    const last = t.findIndex((time) => time >= timeRange.end), to = last < 0 ? n : Math.min(last + 2, n);
    const mapColumns = (select) => Object.fromEntries(Object.entries(columns).map(([name, column]) => [name, select(column)]));
    if (to - from <= pointLimit) return mapColumns((column) => column.slice(from, to));
    const bins = Math.floor(pointLimit / 2 / keys.length), indices = [];
    for (let b = 0; b < bins; b++) {
      const low = from + Math.floor((to - from) * b / bins);
      const high = from + Math.floor((to - from) * (b + 1) / bins), extremes = new Set();
      for (const key of keys) {
        const y = columns[key];
        let least = low, most = low;
        for (let i = low; i < high; i++) { if (y[i] < y[least]) least = i; if (y[i] > y[most]) most = i; }
        extremes.add(least).add(most);
      }
      indices.push(...[...extremes].sort((a, b) => a - b));
    }
    return mapColumns((column) => Float64Array.from(indices, (i) => column[i]));
  }
  const table = (names, columns) => Object.fromEntries(
    names.map((name, i) => [name, columns[i] ?? []]));

  /* Draw arrow heads at the edge for innovations outside the plot */
  function drawOutsideArrows() {
    const { end } = model("innovation").y_range;
    for (const [arrows, ...names] of [["beyond", "updates"], ["beyond_ekf2", "fused", "rejected"]]) {
      const sources = names.map((name) => model(`innovation:${name}-source`)).filter(Boolean);
      const points = sources.flatMap(({ data: { t, x } }) => Array.from(t, (time, i) => [time, x[i]]));
      const out = points.filter(([, x]) => Math.abs(x) > end);
      setSource(`innovation:${arrows}`, { t: out.map(([t]) => t), y: out.map(([, x]) => 0.93 * end * Math.sign(x)),
        turn: out.map(([, x]) => x > 0 ? 0 : Math.PI) });
    }
  }

  // ------------------------------------------------------------------ KF run and its numbers
  // `run` and `numbers` of KF are null if the analysed segment has too few measurements
  const result = { run: null, axis: null, numbers: null };
  function replay() {
    const axis = axisNow(), run = Engine.replay(flight, axis, settings);
    Object.assign(result, { run, axis, numbers: run && numbers(axis, run) });
  }
  /* Statistics of a KF run: innovations, difference to EKF2 and error against ground truth, at the times of EKF2's state */
  function numbers(axis, run) {
    const kf = Engine.assess(run.updates.nu, run.updates.s) ?? { count: run.updates.nu.length };
    if (kf.nis !== undefined) {
      kf.source = Math.sqrt(kf.nis);
      const [low, high] = axis.bands.map((ends) => ends[kf.count - 1]);
      kf.interval = [Math.sqrt(kf.nis / high), Math.sqrt(kf.nis / low)];
    }
    let times = run.steps.time, state = run.steps;
    if (!isText(axis.ekf2)) {
      const [time, p, v] = axis.ekf2.state;
      times = time;
      state = Engine.stateAt(run, time);
      kf.ekf2P = Engine.rmse(state.p, p);
      kf.ekf2V = Engine.rmse(state.v, v);
    }
    if (!isText(axis.truth)) {
      const { p, v } = axis.truth, expected = Engine.interp(times, ...p, NaN);
      kf.truthP = Engine.rmse(state.p, expected);
      kf.truthV = v && Engine.rmse(state.v, Engine.interp(times, ...v, NaN));
      kf.truth = Engine.rmse(state.p.map((x, i) => (x - expected[i]) / Math.sqrt(state.p00[i])), new Float64Array(times.length));
    }
    return kf;
  }
  const ekf2Of = (axis) => isText(axis.ekf2) ? { why: axis.ekf2 }
    : { ...axis.ekf2.summary, source: axis.ratios[2], truth: axis.ratios[3] };

  // ------------------------------------------------------------------ card and table
  const card = Card.start(ranges, Practice.suffix);
  function effect({ axis, numbers: kf }) {
    const value = (now, before) => `KF ${Card.formatMetres(now)}${before ? ` (original settings: ${Card.formatMetres(before)})` : ""}`;
    const before = axis.name === flight.main ? analysedNumbers : null;
    if (kf?.truthP) {
      const { truthP } = ekf2Of(axis);
      return `Position RMSE against ground truth along ${axis.called}: ${value(kf.truthP, before?.truthP)}${truthP ? `, EKF2 ${Card.formatMetres(truthP)}` : ""}.`;
    }
    return kf?.ekf2P ? `The position difference KF − EKF2 along ${axis.called} is ${Card.formatMetres(kf.ekf2P)} RMS.` : "";
  }
  const analysedNumbers = (() => {
    const axis = axes.find(({ name }) => name === flight.main), run = Engine.replay(flight, axis, flight.settings);
    return run && numbers(axis, run);
  })();
  function drawCard(result) {
    const now = card.verdicts(result.numbers);
    card.showRatios(now, settings.axis, flight.main, isChanged());
    card.showTexts(now, effect(result), isChanged());
  }
  onClick("card", ({ target }) => {
    if (target.dataset.apply === undefined) return;
    const changes = {};
    for (const { id, key } of SETTINGS) {
      const found = new RegExp(`--${id} (-?[0-9.e-]+)`).exec(target.dataset.apply);
      if (found) changes[key] = Number(found[1]);
    }
    set({ ...flight.settings, ...changes });
  });
  const isChanged = () => Object.keys(flight.settings).some((key) => settings[key] !== flight.settings[key]);
  const fixed = (key, unit) => (x) => x[key]?.toFixed(3).concat(unit);
  const percent = ({ outside }, digits) => outside === undefined ? undefined : `${(100 * outside).toFixed(digits)} %`;
  const ROWS = [
    ["● innovation ÷ √S, RMS", (x) => x.source && Card.formatRatio(x.source)],
    ["◆ error ÷ σ, RMS", (x) => x.truth && Card.formatRatio(x.truth)],
    ["Innovations outside ±2√S (expected 5 %)", (x) => percent(x, 1)],
    ["Lag-1 autocorrelation of the innovations", (x) => x.lag1?.toFixed(2)],
    ["Number of measurements", (x) => x.count],
    ["KF − EKF2 position difference, RMS", fixed("ekf2P", " m")],
    ["KF − EKF2 velocity difference, RMS", fixed("ekf2V", " m/s")],
    ["Position RMSE", fixed("truthP", " m")],
    ["Velocity RMSE", fixed("truthV", " m/s")],
  ];
  const body = $("table").tBodies[0];
  for (const [title] of ROWS) {
    body.insertRow().append(make("th", title, { scope: "row" }), make("td", "", "kf"), make("td", "", "ekf2"));
  }
  function drawTable({ axis, numbers: kf }) {
    const ekf2 = ekf2Of(axis);
    ROWS.forEach(([, format], i) => {
      const row = body.rows[i], left = kf && format(kf), right = format(ekf2);
      row.cells[1].textContent = left ?? "–";
      row.cells[2].textContent = right ?? "–";
      row.hidden = (left ?? right) === undefined && i > 4;
    });
    const missing = [];
    if (kf === null) missing.push("KF is not evaluated: the analysed time span has too few measurements.");
    if (ekf2.why) missing.push(`EKF2 is not evaluated: ${ekf2.why}.`);
    if (isText(axis.truth)) missing.push(`Ground truth is missing: ${axis.truth}.`);
    $("why").textContent = missing.join(" ");
  }

  // ------------------------------------------------------------------ plots over time
  function drawKf({ run, axis }) {
    const { steps, updates } = run;
    const n = steps.time.length, m = updates.nu.length;
    const sawtooth = table(["t", "p", "v", "sp", "sv"], Array.from({ length: 5 }, () => new Float64Array(n + m)));
    let row = 0;
    const add = (step, { p, v, p00, p11 }, i) => {
      sawtooth.t[row] = steps.time[step]; sawtooth.p[row] = p[i]; sawtooth.v[row] = v[i];
      sawtooth.sp[row] = Math.sqrt(p00[i]); sawtooth.sv[row++] = Math.sqrt(p11[i]);
    };
    for (let i = 0, u = 0; i < n; i++) {
      // the state before the update is an additional row
      if (u < m && updates.step[u] === i) add(i, updates, u++);
      add(i, steps, i);
    }
    const rows = { t: updates.time, x: updates.nu.map((nu, i) => nu / Math.sqrt(updates.s[i])),
      k0: updates.k0, k1: updates.k1 };
    drawSource("steps", sawtooth, ["p", "sp"]);
    drawSource("updates", rows, ["x"]);
    if (isVisible("position")) {
      drawSource("measured", { t: axis.time.map((t) => t + settings.clock_offset_s), z: axis.z }, ["z"]);
    }
    const expected = isVisible("error") ? reference(axis, steps.time) : null;
    if (expected !== null) {
      const e = steps.p.map((p, i) => p - expected[i]), plus = steps.p00.map((x) => 2 * Math.sqrt(x));
      drawSource("error", { t: steps.time, e, plus, minus: plus.map((x) => -x) }, ["e", "plus"]);
    }
    if (isVisible("innovation")) drawOutsideArrows();
  }
  /* Position of ground truth at these times; without ground truth that of EKF2; null without both */
  function reference(axis, times) {
    if (!isText(axis.truth)) return Engine.interp(times, ...axis.truth.p, NaN);
    return isText(axis.ekf2) ? null : Engine.interp(times, ...axis.ekf2.state.slice(0, 2), NaN);
  }
  /* Draw EKF2 and ground truth, which depend only on axis and zoom */
  function drawReferences(axis) {
    if (!isText(axis.ekf2)) {
      const { state, variance, innovations } = axis.ekf2;
      drawSource("state", table(["t", "p", "v"], state), ["p", "v"]);
      drawSource("variance", table(["t", "sp", "sv"], variance), ["sp", "sv"]);
      const rows = table(["t", "nu", "sigma", "rejected"], innovations), { t } = rows;
      for (const [name, flag] of [["fused", 0], ["rejected", 1]]) {
        const which = [...t.keys()].filter((i) => rows.rejected[i] === flag);
        drawSource(name, { t: which.map((i) => t[i]), x: which.map((i) => rows.nu[i] / rows.sigma[i]) }, ["x"]);
      }
    }
    if (!isText(axis.truth)) {
      const { p, v } = axis.truth;
      drawSource("truth_p", { t: p[0], p: p[1] }, ["p"]);
      if (v !== null) drawSource("truth_v", { t: v[0], v: v[1] }, ["v"]);
      if (!isText(axis.ekf2)) {
        const [t, position] = axis.ekf2.state, expected = Engine.interp(t, ...p, NaN);
        drawSource("error_ekf2", { t, e: position.map((x, i) => x - expected[i]) }, ["e"]);
      }
    }
  }
  /* Add RMSE and the percentage of large innovations to the titles of the plots */
  function drawTitles({ axis, numbers: kf }) {
    const title = (name, text) => {
      const span = $(name)?.parentElement.querySelector("figcaption span");
      if (span) span.textContent = text && `· ${text}`;
    };
    const both = (format) => [["KF", kf], ["EKF2", ekf2Of(axis)]].flatMap(([name, values]) => {
      const text = values && format(values);
      return text ? `${name} ${text}` : [];
    }).join(", ");
    title("innovation", `innovations outside ±2√S (expected 5 %): ${both((x) => percent(x, 0))}`);
    title("gain", "KF: position gain (solid), velocity gain (dotted, 1/s)");
    if (kf === null) return;
    const legend = flight.events.gap.length
      ? "shaded: ±2σ reported by KF · hatched: gap in the position source" : "shaded: ±2σ reported by KF";
    if (!isText(axis.truth)) {
      title("error", `position RMSE ${both(({ truthP }) => truthP && Card.formatMetres(truthP))} · ${legend}`);
    } else if (kf.ekf2P) {
      $("error").parentElement.querySelector("b").textContent = "KF − EKF2 position difference (m)";
      title("error", `RMS ${Card.formatMetres(kf.ekf2P)} · ${legend}`);
    }
  }

  // ------------------------------------------------------------------ command
  function command() {
    const { base, fixed, input, default_input: defaultInput } = flight.command, lesson = ranges.lesson;
    const words = [settings.clock_offset_s !== flight.settings.clock_offset_s ? fixed : base];
    for (const setting of SETTINGS) {
      const standard = setting.key !== "clock_offset_s" ? lesson[setting.key] : fixedReason ? settings.clock_offset_s : 0;
      if (settings[setting.key] !== standard) words.push(`--${setting.id} ${round(settings[setting.key], 12)}`);
    }
    if (settings.input !== defaultInput || input !== null) words.push(`--input ${settings.input}`);
    return words.join(" ");
  }
  // ------------------------------------------------------------------ whole page
  // null: to be drawn
  let axisShown = null;
  /* Run KF and draw the visible views; `quick`, during a drag of a slider: without texts and tables */
  function show(quick = false) {
    cancelAnimationFrame(nextFrame);
    nextFrame = null;
    pointLimit = quick ? MAX_DRAG_POINTS : MAX_POINTS;
    for (const setting of SETTINGS) {
      if (document.activeElement !== setting.number || !quick) setting.number.value = settings[setting.key];
      if (!quick) setting.slider.value = toSlider(setting, settings[setting.key]);
      setting.slider.ariaValueText = `${settings[setting.key]} ${setting.unit}`;
    }
    const isNewAxis = axisShown !== settings.axis;
    axisShown = settings.axis;
    replay();
    if (isNewAxis) {
      drawReferences(result.axis);
      SETTINGS.forEach(showLikely);
    }
    if (result.run) drawKf(result);
    drawCard(result);
    drawTitles(result);
    if (quick) return;
    for (const name of ["axis", "input"]) {
      for (const radio of queryAll(`[name=${name}]`)) radio.checked = radio.value === settings[name];
    }
    const { axis } = result;
    $("along").textContent = `· ${axis.along}`;
    $("axis-note").textContent = axis.note;
    $("likely").disabled = likelyNow().includes(null);
    $("ekf2-r").disabled = isText(axis.ekf2) || axis.ekf2.r === null;
    drawTable(result);
    $("command").textContent = command();
    if (isNewAxis) times.drawEvents(axis);
    stepper.draw();
    toAddress();
  }
  /* Draw the same KF run again after a zoom */
  function redraw() {
    drawReferences(result.axis);
    if (result.run) drawKf(result);
  }

  const stepper = Step.start({ settings, selected, result, model, setSource, figures, isVisible,
    moved: (time) => { times.showTime(time); toAddress(); } });
  const keys = { n: stepper.next, p: stepper.previous, " ": () => { open("step"); stepper.play(); } };
  const times = Times.start({ flight, model, setSource, timeRange, figures, redraw, keys });
  for (const [name, value] of Object.entries(flight.flown)) $("flown").append(make("dt", name), make("dd", value));
  if (!Object.keys(flight.flown).length) $("flown").append(make("dt", "The log does not contain the EKF2 parameters for noise, delay and gate of the position source."));
  addEventListener("hashchange", () => { fromAddress(); axisShown = null; show(); });
  open(view, false);
  fromAddress();
  show();
  const shared = { setSpan: times.setSpan, settings, set, open, result, flight, model, stepper };
  Practice.start(shared);
  return shared;
})();
