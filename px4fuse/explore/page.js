/* Main script of the page: runs KF with the settings and draws plots and numbers. */
const Explore = (async () => {
  const MAX_POINTS = 3000, MAX_DRAG_POINTS = 600; // most drawn points of a line, and while a slider is dragged
  const DRAG_PAUSE_MS = 150;
  const NARROW = matchMedia("(max-width: 60rem)");
  const readJson = (id) => JSON.parse($(id).textContent);
  const content = readJson(`content${Practice.suffix}`), ranges = content.ranges;
  if (typeof DecompressionStream === "undefined") {
    $("problem").textContent = "This browser is too old for this page. Use a browser from 2023 or later.";
    $("problem").hidden = false;
    return null;
  }

  // ------------------------------------------------------------------ the flight's data
  const arrays = await Engine.unpack($(`arrays${Practice.suffix}`).textContent, content.packed);
  const arraysAt = (indices) => indices.map((index) => arrays[index]);
  const { imu, plan, axes } = content.flight;
  const flight = {
    ...content.flight,
    imu: typeof imu === "string" ? imu : { ...imu, time: arrays[imu.time] },
    plan: typeof plan === "string" ? plan : arraysAt(plan),
    axes: axes.map((axis) => ({
      ...axis, time: arrays[axis.time], z: arrays[axis.z], bands: arraysAt(axis.bands),
      integral: axis.integral === undefined ? null : arrays[axis.integral],
      ekf2: typeof axis.ekf2 === "string" ? axis.ekf2 : {
        ...axis.ekf2, state: arraysAt(axis.ekf2.state), variance: arraysAt(axis.ekf2.variance || []),
        innovations: arraysAt(axis.ekf2.innovations || []),
      },
      truth: typeof axis.truth === "string" ? axis.truth : {
        p: arraysAt(axis.truth.p), v: axis.truth.v === null ? null : arraysAt(axis.truth.v),
      },
    })),
  };
  // ------------------------------------------------------------------ settings
  const SETTINGS = [
    { id: "sigma-a", key: "sigmaA", title: "SIGMA_A", unit: "m/s²", log: [0.001, 100],
      hint: "process noise", likely: () => mapNow().likely?.[0] },
    { id: "sigma-z", key: "sigmaZ", title: "SIGMA_Z", unit: "m", log: [0.001, 10],
      hint: "measurement noise", likely: () => mapNow().likely?.[1] },
    { id: "clock-offset", key: "offset", title: "Time offset", unit: "s",
      hint: "added to timestamps", likely: () => flight.offset.likely },
    { id: "dt", key: "dt", title: "DT", unit: "s", log: [0.01, 1], hint: "prediction step" },
  ];
  const TICKS = 600;
  const settings = { ...flight.settings, axis: flight.main };
  const chosen = { step: null }; // index of the selected measurement
  const round = (value, digits) => Number(value.toPrecision(digits));
  const why = flight.offset.why;
  const reach = why ? [settings.offset, settings.offset] : [flight.offset.from, flight.offset.to];
  const limits = (setting) => setting.key === "offset" ? reach : ranges[setting.id];
  const fromSlider = (setting, tick) => {
    if (!setting.log) return Math.round((reach[0] + (reach[1] - reach[0]) * tick / TICKS) * 1e4) / 1e4;
    const [low, high] = setting.log.map(Math.log);
    return round(Math.exp(low + (high - low) * tick / TICKS), 3);
  };
  const toSlider = (setting, value) => {
    const [low, high] = setting.log ? setting.log.map(Math.log) : reach;
    const at = (setting.log ? Math.log(value) : value) - low;
    return Math.round(Math.min(Math.max(at / (high - low || 1), 0), 1) * TICKS);
  };
  for (const setting of SETTINGS) {
    const isMore = ["dt", "offset"].includes(setting.key); // in the opened sheet of a phone
    const box = make("div", undefined, { className: isMore ? "setting more" : "setting" });
    const label = make("label", `${setting.title} `, { htmlFor: `${setting.id}-value` });
    label.append(make("small", `${setting.unit}, ${setting.hint}`));
    setting.number = make("input", undefined, { type: "number", id: `${setting.id}-value`, step: "any" });
    setting.slider = make("input", undefined, {
      type: "range", id: setting.id, min: 0, max: TICKS, step: 1, ariaLabel: setting.title });
    setting.slider.addEventListener("input", () => {
      set({ [setting.key]: fromSlider(setting, Number(setting.slider.value)) }, true);
    });
    setting.number.addEventListener("change", () => {
      const value = setting.number.value === "" ? NaN : Number(setting.number.value);
      const [low, high] = limits(setting);
      if (value >= low && value <= high) return set({ [setting.key]: value });
      showMessage(`${setting.title}: enter ${low} to ${high} ${setting.unit}.`);
      show();
    });
    setting.best = make("div", undefined, { className: "best" });
    box.append(label, setting.number, setting.slider, setting.best);
    if (setting.key === "offset" && why) {
      setting.number.disabled = setting.slider.disabled = true;
      box.append(make("p", why, { className: "note" }));
    }
    $("sliders").append(box);
  }
  const names = axes.map((axis) => axis.name);
  for (const name of names) {
    const label = make("label");
    label.append(make("input", undefined, { type: "radio", name: "axis", value: name }), ` ${name}`);
    $("axes").append(label);
  }
  $("axes").addEventListener("change", (event) => set({ axis: event.target.value }));
  const hasImu = typeof imu !== "string";
  for (const radio of document.querySelectorAll("[name=input]")) {
    radio.addEventListener("change", () => set({ input: radio.value }));
    if (radio.value === "imu" && !hasImu) {
      radio.disabled = true;
      $("input-note").textContent = imu;
    }
  }
  /* Mark the maximum-likelihood estimate on the track of a slider */
  function markLikely(setting) {
    const value = setting.likely?.(), text = `maximum likelihood ${value && round(value, 3)}`;
    setting.best.hidden = value === null || value === undefined;
    if (setting.best.hidden) return;
    const share = toSlider(setting, value) / TICKS, line = make("i"), label = make("small", text);
    line.style.left = `${100 * share}%`;
    label.style.left = `${100 * share}%`;
    label.style.transform = `translateX(${-100 * share}%)`;
    setting.best.replaceChildren(line, label);
  }
  const axisNow = () => flight.axes.find((axis) => axis.name === settings.axis);
  const showMessage = (text) => { $("message").textContent = text; };
  const mapNow = () => flight.maps[axisNow().map] ?? "not computed";

  $("lesson").addEventListener("click", () => {
    const { sigmaA, sigmaZ, dt } = ranges.lesson;
    set({ sigmaA, sigmaZ, dt });
    showMessage("Values of the lesson.");
  });
  $("likely").addEventListener("click", () => {
    const [sigmaA, sigmaZ] = mapNow().likely;
    set({ sigmaA: round(sigmaA, 3), sigmaZ: round(sigmaZ, 3), dt: flight.settings.dt });
    showMessage("Maximum-likelihood estimates from the innovations of this flight.");
  });
  $("ekf2-r").addEventListener("click", () => {
    set({ sigmaZ: round(axisNow().ekf2.r, 3) });
    showMessage("SIGMA_Z is the median measurement standard deviation of EKF2 (√R).");
  });

  /* Change settings, re-run KF and draw; during a drag at most once per frame, with fewer points */
  let isDrawing = false, isChangedSince = false, finalDraw = null;
  function set(changes, dragged = false) {
    Object.assign(settings, changes);
    if ($("message").textContent) showMessage("");
    clearTimeout(finalDraw);
    if (!dragged) return show();
    finalDraw = setTimeout(show, DRAG_PAUSE_MS);
    if (isDrawing) { isChangedSince = true; return; }
    isDrawing = true;
    show(true);
    requestAnimationFrame(() => {
      isDrawing = false;
      if (isChangedSince) { isChangedSince = false; show(true); }
    });
  }

  // ------------------------------------------------------------------ the address
  function toAddress() {
    const parts = { axis: settings.axis, input: settings.input };
    for (const setting of SETTINGS) parts[setting.id] = String(settings[setting.key]);
    Object.assign(parts, Practice.toAddress());
    if (view !== "errors") parts.view = view;
    if (chosen.step !== null) parts.measurement = String(chosen.step + 1);
    const text = `#${new URLSearchParams(parts)}`;
    if (text !== location.hash) history.replaceState(null, "", text);
  }
  function fromAddress() {
    const parts = new URLSearchParams(location.hash.slice(1)), ignored = [];
    for (const setting of SETTINGS) {
      if (!parts.has(setting.id) || (setting.key === "offset" && why)) continue;
      const text = parts.get(setting.id), value = text === "" ? NaN : Number(text);
      const [low, high] = limits(setting);
      if (value >= low && value <= high) settings[setting.key] = value;
      else ignored.push(setting.id);
    }
    if (names.includes(parts.get("axis"))) settings.axis = parts.get("axis");
    else if (parts.has("axis")) ignored.push("axis");
    const input = parts.get("input");
    if (input === "zero" || (input === "imu" && hasImu)) settings.input = input;
    else if (input !== null) ignored.push("input");
    if (parts.has("view") && !isView(parts.get("view"))) ignored.push("view");
    else open(parts.get("view") ?? view, false);
    const step = Number(parts.get("measurement"));
    if (Number.isInteger(step) && step > 0) chosen.step = step - 1;
    if (ignored.length) showMessage(`Invalid values in the address are ignored: ${ignored.join(", ")}.`);
  }

  // ------------------------------------------------------------------ views
  const PLOTS = { innovation: "Innovations", error: "Error", sigma_p: "σ position", sigma_v: "σ velocity",
    position: "Position", strip: "Events", velocity: "Velocity", gain: "Gain", running: "Running RMS" };
  const GROUPS = { errors: ["Innovations and error", ["innovation", "error"]],
    sigma: ["σ", ["sigma_p", "sigma_v"]], track: ["Position", ["position", "strip"]],
    speed: ["Velocity", ["velocity"]], gains: ["Gain", ["gain", "running"]] };
  const CARDS = { numbers: "Numbers", step: "Step by step", map: "Likelihood" };
  const hasPlot = (name) => document.querySelector(`[data-plot=${name}]`) !== null;
  const isView = (name) => Object.hasOwn(GROUPS, name) || Object.hasOwn(CARDS, name)
    || (Object.hasOwn(PLOTS, name) && hasPlot(name));
  let view = "errors";
  /* Tab of a view; on a narrow screen each plot has a separate tab */
  function tabOf(name) {
    if (Object.hasOwn(CARDS, name)) return name;
    if (NARROW.matches) return Object.hasOwn(GROUPS, name) ? GROUPS[name][1][0] : name;
    return Object.keys(GROUPS).find((group) => group === name || GROUPS[group][1].includes(name));
  }
  const seenPlots = () => Object.hasOwn(CARDS, view) ? [] : Object.hasOwn(GROUPS, view) ? GROUPS[view][1] : [view];
  const isSeen = (name) => name === "plan" || name === "step" ? view === "step" : name === view || seenPlots().includes(name);
  function drawTabs() {
    const names = NARROW.matches ? Object.entries(PLOTS).filter(([name]) => hasPlot(name))
      : Object.entries(GROUPS).map(([name, [title]]) => [name, title]);
    $("tabs").replaceChildren(...[...names, ...Object.entries(CARDS)].map(([name, title]) => {
      const tab = make("button", title, { type: "button", id: `tab-${name}` });
      tab.setAttribute("role", "tab");
      tab.setAttribute("aria-controls", Object.hasOwn(CARDS, name) ? `view-${name}` : "view-plots");
      tab.addEventListener("click", () => open(name));
      return tab;
    }));
  }
  /* Show a plot, a group of plots or a card */
  function open(name, draw = true) {
    view = tabOf(name);
    for (const tab of $("tabs").children) {
      const own = tab.id === `tab-${view}`;
      tab.ariaSelected = String(own);
      tab.tabIndex = own ? 0 : -1;
      if (own && draw) tab.scrollIntoView({ block: "nearest", inline: "nearest" });
    }
    const plots = seenPlots();
    $("view-plots").hidden = !plots.length;
    $("view-plots").setAttribute("aria-labelledby", `tab-${view}`);
    for (const figure of document.querySelectorAll("[data-plot]")) figure.hidden = !plots.includes(figure.dataset.plot);
    for (const card of Object.keys(CARDS)) $(`view-${card}`).hidden = card !== view;
    if (draw) { axisShown = null; show(); }
  }
  $("tabs").addEventListener("keydown", (event) => {
    const all = [...$("tabs").children], at = all.findIndex((tab) => tab.tabIndex === 0);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: all.length - 1 }[event.key];
    if (to === undefined) return;
    const tab = all[(to + all.length) % all.length];
    tab.click();
    tab.focus();
    event.preventDefault();
    event.stopPropagation();
  });
  NARROW.addEventListener("change", () => {
    drawTabs();
    setHeights();
    open(view);
  });
  new ResizeObserver(() => document.body.style.setProperty("--sheet", `${document.querySelector("aside").offsetHeight}px`))
    .observe(document.querySelector("aside"));
  /* On a phone the settings are a sheet at the bottom; a swipe or a button opens and closes it */
  function openSheet(isOpen) {
    document.querySelector("aside").classList.toggle("open", isOpen);
    $("handle").ariaExpanded = String(isOpen);
    $("all").textContent = isOpen ? "Less ▾" : "All ▴";
  }
  const isSheetOpen = () => $("handle").ariaExpanded === "true";
  let swipedFrom = null;
  for (const id of ["handle", "all"]) $(id).addEventListener("click", () => openSheet(!isSheetOpen()));
  document.querySelector("aside").addEventListener("touchstart", (event) => {
    swipedFrom = event.target.matches("input") ? null : event.touches[0].clientY;
  }, { passive: true });
  document.querySelector("aside").addEventListener("touchend", (event) => {
    const by = swipedFrom === null ? 0 : event.changedTouches[0].clientY - swipedFrom;
    if (Math.abs(by) > 30) openSheet(by < 0);
  });

  // ------------------------------------------------------------------ Bokeh
  Bokeh.logger.set_level("off");
  await Bokeh.embed.embed_items({ page: readJson(`document${Practice.suffix}`) }, [
    { docid: "page", roots: content.places, root_ids: Object.keys(content.places) }]);
  const page = Bokeh.documents[0];
  const models = new Map();
  const model = (name) => {
    if (!models.has(name)) models.set(name, page.get_model_by_name(name));
    return models.get(name);
  };
  const setSource = (name, columns) => { model(`${name}-source`).data = columns; };
  /* Set a source in each visible plot that has it */
  const setVisibleSources = (name, columns) => {
    for (const plot of seenPlots()) {
      const source = model(`${plot}:${name}-source`);
      if (source !== null) source.data = columns;
    }
  };
  const timeRange = model("time");
  const figures = Object.keys(PLOTS).map(model).filter(Boolean);
  function setHeights() {
    for (const plot of figures) if (plot.name !== "strip") plot.height = NARROW.matches ? 175 : 205;
    model("position").min_border_left = NARROW.matches ? 50 : 82; // aligned with the events below it
  }
  setHeights();

  /* Rows within the visible time range; long series are reduced to the extremes of each bin */
  let pointLimit = MAX_POINTS;
  function decimate(columns, keys) {
    const t = columns.t, n = t.length;
    const below = (x) => { let a = 0, b = n; while (a < b) { const c = (a + b) >> 1;
      if (t[c] < x) a = c + 1; else b = c; } return a; };
    const from = Math.max(below(timeRange.start) - 1, 0), to = Math.min(below(timeRange.end) + 2, n);
    const names = Object.keys(columns), out = {};
    if (to - from <= pointLimit) {
      for (const name of names) out[name] = columns[name].subarray(from, to);
      return out;
    }
    const bins = Math.floor(pointLimit / 2 / keys.length), kept = [];
    for (let b = 0; b < bins; b++) {
      const low = from + Math.floor((to - from) * b / bins);
      const high = from + Math.floor((to - from) * (b + 1) / bins), own = new Set();
      for (const key of keys) {
        const y = columns[key];
        let least = low, most = low;
        for (let i = low; i < high; i++) { if (y[i] < y[least]) least = i; if (y[i] > y[most]) most = i; }
        own.add(least).add(most);
      }
      kept.push(...[...own].sort((a, b) => a - b));
    }
    for (const name of names) out[name] = Float64Array.from(kept, (i) => columns[name][i]);
    return out;
  }
  const EMPTY = new Float64Array(0);
  const table = (names, columns) => Object.fromEntries(
    names.map((name, i) => [name, columns.length ? columns[i] : EMPTY]));
  const shifted = (t, by) => by ? t.map((x) => x + by) : t;

  /* Set the vertical range of a visible plot */
  function setRange(name, ends, log = false) {
    const range = isSeen(name) ? model(name)?.y_range : undefined;
    if (!range) return;
    let [low, high] = ends();
    if (!(high > low)) [low, high] = Number.isFinite(low) ? [0.9 * low - 0.1, 1.1 * low + 0.1] : [0.1, 1];
    const edge = log ? 1.15 : 0.06 * (high - low);
    [range.start, range.end] = log ? [Math.max(low, 1e-6) / edge, high * edge] : [low - edge, high + edge];
  }
  /* Draw arrow heads at the edge for values outside the plot */
  function drawOutsideArrows(drawn) {
    const rows = (...parts) => parts.flatMap(([part, column]) => part === undefined ? []
      : Array.from(part.t, (t, i) => [t, part[column][i]]));
    for (const [plot, name, points] of [["position", "beyond", rows([drawn.measured, "z"])],
      ["innovation", "beyond", rows([drawn.updates, "x"])],
      ["innovation", "beyond_ekf2", rows([drawn.fused, "x"], [drawn.rejected, "x"])]]) {
      const source = isSeen(plot) ? model(`${plot}:${name}-source`) : null;
      if (source === null) continue;
      const { start: low, end: high } = model(plot).y_range, inside = 0.035 * (high - low);
      const out = points.filter(([, y]) => y < low || y > high);
      source.data = { t: out.map(([t]) => t), y: out.map(([, y]) => y > high ? high - inside : low + inside),
        turn: out.map(([, y]) => y > high ? 0 : Math.PI) };
    }
  }
  function extent(...columns) {
    let low = Infinity, high = -Infinity;
    for (const column of columns) for (const y of column) {
      if (y < low) low = y;
      if (y > high) high = y;
    }
    return [low, high];
  }

  // ------------------------------------------------------------------ KF run and its numbers
  // run and numbers are null if the segment has too few measurements
  const result = { run: null, axis: null, numbers: null };
  function replay() {
    const axis = axisNow(), run = Engine.replay(flight, axis, settings);
    Object.assign(result, { run, axis, numbers: run && numbers(axis, run) });
  }
  /* Statistics of KF: against the source, EKF2 and ground truth, at the times of EKF2's state */
  function numbers(axis, run) {
    const kf = Engine.assess(run.updates.nu, run.updates.s) ?? { count: run.updates.nu.length };
    if (kf.nis !== undefined) {
      kf.source = Math.sqrt(kf.nis);
      const [low, high] = axis.bands.map((ends) => ends[kf.count - 1]);
      kf.interval = [Math.sqrt(kf.nis / high), Math.sqrt(kf.nis / low)];
    }
    let times = run.steps.time;
    if (typeof axis.ekf2 !== "string") {
      const [time, p, v] = axis.ekf2.state, at = Engine.stateAt(run, time);
      kf.ekf2P = Engine.rmse(at.p, p);
      kf.ekf2V = Engine.rmse(at.v, v);
      times = time;
    }
    if (typeof axis.truth !== "string") {
      const at = Engine.stateAt(run, times), { p, v } = axis.truth, known = Engine.interp(times, p[0], p[1], NaN);
      kf.truthP = Engine.rmse(at.p, known);
      kf.truthV = v === null ? null : Engine.rmse(at.v, Engine.interp(times, v[0], v[1], NaN));
      kf.truth = Engine.rmse(at.p.map((x, i) => (x - known[i]) / Math.sqrt(at.p00[i])), new Float64Array(times.length));
    }
    return kf;
  }
  const ekf2Of = (axis) => typeof axis.ekf2 === "string" ? { why: axis.ekf2 }
    : { ...axis.ekf2.summary, source: axis.verdicts[2].ratio, truth: axis.verdicts[3].ratio };

  // ------------------------------------------------------------------ card and table
  const card = Card.start(ranges, Practice.suffix);
  function effect({ axis, numbers: kf }) {
    const value = (now, before) => `KF ${Card.formatMetres(now)}${before ? ` (as analysed ${Card.formatMetres(before)})` : ""}`;
    const before = axis.name === flight.main ? analysedNumbers : null;
    if (kf?.truthP) {
      const { truthP } = ekf2Of(axis);
      return `Position RMSE against ground truth along ${axis.called}: ${value(kf.truthP, before?.truthP)}`
        + `${truthP ? `, EKF2 ${Card.formatMetres(truthP)}` : ""}.`;
    }
    return kf?.ekf2P ? `KF − EKF2 along ${axis.called}: ${Card.formatMetres(kf.ekf2P)} RMS.` : "";
  }
  let analysedNumbers = null;
  function drawCard(result) {
    if (analysedNumbers === null) {
      const axis = flight.axes.find(({ name }) => name === flight.main);
      const run = Engine.replay(flight, axis, { ...settings, ...flight.settings });
      analysedNumbers = run === null ? {} : numbers(axis, run);
    }
    const now = card.verdicts(result.numbers);
    card.move(now, result.axis, isChanged());
    card.say(now, effect(result), isChanged());
  }
  $("card").addEventListener("click", ({ target }) => {
    if (target.dataset.apply === undefined) return;
    const changes = {};
    for (const { id, key } of SETTINGS) {
      const found = new RegExp(`--${id} (-?[0-9.e-]+)`).exec(target.dataset.apply);
      if (found) changes[key] = Number(found[1]);
    }
    set({ ...flight.settings, ...changes });
  });
  const isChanged = () => ["sigmaA", "sigmaZ", "dt", "input", "offset"].some((key) => settings[key] !== flight.settings[key]);
  const ROWS = [
    ["● innovation ÷ √S, RMS", (x) => x.source && Card.formatRatio(x.source)],
    ["◆ error ÷ σ, RMS", (x) => x.truth && Card.formatRatio(x.truth)],
    ["Outside ±2√S (expected 5 %)", (x) => x.outside === undefined ? undefined
      : `${(100 * x.outside).toFixed(1)} %`],
    ["Lag-1 autocorrelation of ν", (x) => x.lag1?.toFixed(2)],
    ["Measurements", (x) => x.count && String(x.count)],
    ["Position: KF - EKF2, RMS", (x) => x.ekf2P?.toFixed(3).concat(" m")],
    ["Velocity: KF - EKF2, RMS", (x) => x.ekf2V?.toFixed(3).concat(" m/s")],
    ["Position RMSE", (x) => x.truthP?.toFixed(3).concat(" m")],
    ["Velocity RMSE", (x) => x.truthV?.toFixed(3).concat(" m/s")],
  ];
  const body = $("table").tBodies[0];
  for (const [title] of ROWS) {
    body.insertRow().append(make("th", title, { scope: "row" }), make("td", "", { className: "kf" }),
      make("td", "", { className: "ekf2" }));
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
    if (kf === null) missing.push("KF: the segment has too few measurements.");
    if (ekf2.why) missing.push(`EKF2: ${ekf2.why}.`);
    if (typeof axis.truth === "string") missing.push(`Ground truth: ${axis.truth}.`);
    $("why").textContent = missing.join(" ");
  }

  // ------------------------------------------------------------------ plots over time
  function drawKf({ run, axis }) {
    const { steps, updates } = run;
    const n = steps.time.length, m = updates.nu.length, size = n + m;
    const sawtooth = table(["t", "p", "v", "sp", "sv"], Array.from({ length: 5 }, () => new Float64Array(size)));
    for (let i = 0, k = 0, u = 0; i < n; i++) {
      if (u < m && updates.step[u] === i) { // before the update, then after it
        sawtooth.t[k] = steps.time[i]; sawtooth.p[k] = updates.p[u]; sawtooth.v[k] = updates.v[u];
        sawtooth.sp[k] = Math.sqrt(updates.p00[u]); sawtooth.sv[k++] = Math.sqrt(updates.p11[u++]);
      }
      sawtooth.t[k] = steps.time[i]; sawtooth.p[k] = steps.p[i]; sawtooth.v[k] = steps.v[i];
      sawtooth.sp[k] = Math.sqrt(steps.p00[i]); sawtooth.sv[k++] = Math.sqrt(steps.p11[i]);
    }
    const rows = { t: updates.time, x: updates.nu.map((nu, i) => nu / Math.sqrt(updates.s[i])),
      k0: updates.k0, k1: updates.k1, running: running(updates.nu, updates.s) };
    const seen = { steps: decimate(sawtooth, ["p", "sp"]), updates: decimate(rows, ["x"]) };
    setVisibleSources("steps", seen.steps);
    setVisibleSources("updates", seen.updates);
    if (isSeen("position")) {
      seen.measured = decimate({ t: shifted(axis.time, settings.offset), z: axis.z }, ["z"]);
      setVisibleSources("measured", seen.measured);
    }
    const known = reference(axis, steps.time);
    if (isSeen("error") && known !== null) {
      const e = steps.p.map((p, i) => p - known[i]), plus = steps.p00.map((x) => 2 * Math.sqrt(x));
      seen.error = decimate({ t: steps.time, e, plus, minus: plus.map((x) => -x) }, ["e", "plus"]);
      setVisibleSources("error", seen.error);
    }
    return seen;
  }
  /* Ground truth at some times, else EKF2, else null */
  function reference(axis, times) {
    if (typeof axis.truth !== "string") return Engine.interp(times, ...axis.truth.p, NaN);
    return typeof axis.ekf2 === "string" ? null : Engine.interp(times, axis.ekf2.state[0], axis.ekf2.state[1], NaN);
  }
  function running(nu, s) {
    const over = ranges.running, out = new Float64Array(nu.length).fill(NaN);
    for (let i = 0, sum = 0; i < nu.length; i++) {
      sum += nu[i] * nu[i] / s[i];
      if (i >= over) sum -= nu[i - over] * nu[i - over] / s[i - over];
      if (i >= over - 1) out[i] = Math.sqrt(sum / over);
    }
    return out;
  }
  /* Draw EKF2 and ground truth, which depend only on axis and zoom */
  function drawReferences(axis) {
    const seen = {};
    const take = (name, columns, keys) => { seen[name] = decimate(columns, keys); setVisibleSources(name, seen[name]); };
    if (typeof axis.ekf2 !== "string") {
      const { state, variance, innovations } = axis.ekf2;
      take("state", table(["t", "p", "v"], state), ["p", "v"]);
      take("variance", table(["t", "sp", "sv"], variance), ["sp", "sv"]);
      const rows = table(["t", "nu", "sigma", "rejected"], innovations), { t } = rows;
      for (const [name, flag] of [["fused", 0], ["rejected", 1]]) {
        const which = [...t.keys()].filter((i) => rows.rejected[i] === flag);
        take(name, { t: Float64Array.from(which, (i) => t[i]),
          x: Float64Array.from(which, (i) => rows.nu[i] / rows.sigma[i]) }, ["x"]);
      }
      take("running", { t, running: running(rows.nu, rows.sigma.map((s) => s * s)) }, ["running"]);
    }
    if (typeof axis.truth !== "string") {
      const { p, v } = axis.truth;
      take("truth_p", { t: p[0], p: p[1] }, ["p"]);
      if (v !== null) take("truth_v", { t: v[0], v: v[1] }, ["v"]);
      if (typeof axis.ekf2 !== "string") {
        const [time, own] = axis.ekf2.state;
        const known = Engine.interp(time, ...p, NaN);
        take("error_ekf2", { t: time, e: own.map((x, i) => x - known[i]) }, ["e"]);
      }
    }
    return seen;
  }
  function setRanges(kf, others) {
    const of = (part, column) => part?.[column] ?? EMPTY;
    const { steps, updates } = kf;
    setRange("position", () => extent(steps.p, of(others.state, "p"), of(others.truth_p, "p")));
    setRange("velocity", () => extent(steps.v, of(others.state, "v"), of(others.truth_v, "v")));
    setRange("error", () => extent(of(kf.error, "e"), of(others.error_ekf2, "e")));
    setRange("sigma_p", () => extent(steps.sp, of(others.variance, "sp")), true);
    setRange("sigma_v", () => extent(steps.sv, of(others.variance, "sv")), true);
    setRange("running", () => extent(updates.running, of(others.running, "running"), ranges.bands.source), true);
    setRange("gain", () => extent(updates.k0, updates.k1, [0]));
    drawOutsideArrows({ ...others, ...kf });
  }

  /* Titles of the plots with RMSE and shares */
  function drawTitles({ axis, run, numbers: kf }) {
    const title = (name, text) => {
      const span = document.querySelector(`[data-plot=${name}] figcaption span`);
      if (span !== null) span.textContent = text && `· ${text}`;
    };
    const ekf2 = ekf2Of(axis), percent = (x) => `${(100 * x).toFixed(0)} %`;
    const both = (format) => [["KF", kf], ["EKF2", ekf2]].flatMap(([name, one]) => {
      const text = one && format(one);
      return text ? [`${name} ${text}`] : [];
    }).join(", ");
    title("innovation", `outside ±2: ${both((one) => one.outside === undefined ? "" : percent(one.outside))}; expected 5 %`);
    title("running", `over ${ranges.running} measurements; green: consistent`);
    title("gain", "solid: position, dotted: velocity (1/s)");
    if (run === null) return;
    const sigmas = Array.from(run.steps.p00, Math.sqrt).sort((a, b) => a - b);
    const at = (share) => sigmas[Math.floor(share * (sigmas.length - 1))], [low, middle, high] = [0.02, 0.5, 1].map(at);
    const sigma = high < 1.5 * low ? Card.formatMetres(middle) : `${Card.formatMetres(low).slice(0, -2)} to ${Card.formatMetres(high)}`;
    const gaps = flight.events.gap.length ? "; hatched: no position" : "";
    const shaded = `shaded: ±2σ as KF reports it (σ ${sigma})${gaps}`;
    if (typeof axis.truth !== "string") {
      title("error", `RMSE ${both((one) => one.truthP && Card.formatMetres(one.truthP))} · ${shaded}`);
    } else if (kf.ekf2P) {
      document.querySelector("[data-plot=error] b").textContent = "KF − EKF2, position (m)";
      title("error", `RMS ${Card.formatMetres(kf.ekf2P)} · ${shaded}`);
    }
  }

  // ------------------------------------------------------------------ likelihood map
  const trail = { x: [], y: [] };
  let mapShown = null;
  function drawMap() {
    const map = mapNow(), plot = model("map");
    const known = typeof map !== "string";
    $("map").hidden = !known;
    if (!known) return;
    const last = trail.x.length - 1;
    if (trail.x[last] !== settings.sigmaA || trail.y[last] !== settings.sigmaZ) {
      trail.x.push(settings.sigmaA);
      trail.y.push(settings.sigmaZ);
      if (trail.x.length > 200) { trail.x.shift(); trail.y.shift(); }
    }
    const [[a0, a1], [z0, z1]] = [map.sigmaA, map.sigmaZ], name = axisNow().map;
    if (mapShown !== name) {
      mapShown = name;
      for (const one of plot.renderers) {
        if (one.name?.startsWith("map:")) one.visible = one.name === `map:${name}`;
      }
      const likely = map.likely.every((x) => x !== null);
      setSource("best", likely ? { x: [map.likely[0]], y: [map.likely[1]] } : { x: [], y: [] });
    }
    setSource("trail", { x: [...trail.x], y: [...trail.y] });
    setSource("point", { x: [settings.sigmaA], y: [settings.sigmaZ] });
    [plot.x_range.start, plot.x_range.end] = [Math.min(a0, settings.sigmaA / 1.3), Math.max(a1, settings.sigmaA * 1.3)];
    [plot.y_range.start, plot.y_range.end] = [Math.min(z0, settings.sigmaZ / 1.3), Math.max(z1, settings.sigmaZ * 1.3)];
  }
  function mapNote() {
    const map = mapNow(), initial = flight.settings;
    if (typeof map === "string") return `No map: ${map}.`;
    const axis = axisNow().map === "horizontal" ? "North and east together" : `Axis ${axisNow().map}`;
    const differs = initial.dt !== settings.dt || initial.offset !== settings.offset || initial.input !== settings.input;
    return `${axis}, ${map.count} measurements, DT ${initial.dt} s, input ${initial.input}, clock offset `
      + `${round(initial.offset, 4)} s. Darker: higher likelihood. Cross: maximum. One shade: half a standard `
      + `deviation.${differs ? " The map is not valid for the current DT, input or clock offset." : ""}`;
  }

  // ------------------------------------------------------------------ command
  const optionText = (x) => String(round(x, 12));
  function command() {
    const { base, fixed, input, default_input: defaultInput } = flight.command, lesson = ranges.lesson;
    const parts = [settings.offset !== flight.settings.offset ? fixed : base];
    for (const setting of SETTINGS) {
      const standard = setting.key === "offset" ? 0 : lesson[setting.key];
      if (setting.key === "offset" && why) continue;
      if (settings[setting.key] !== standard) parts.push(`--${setting.id} ${optionText(settings[setting.key])}`);
    }
    if (settings.input !== defaultInput || input !== null) parts.push(`--input ${settings.input}`);
    return parts.join(" ");
  }
  for (const button of document.querySelectorAll("[data-copy]")) {
    button.addEventListener("click", async () => {
      button.textContent = await copyText($(button.dataset.copy)) ? "copied" : "press Ctrl+C";
    });
  }
  async function copyText(node) {
    try {
      await navigator.clipboard.writeText(node.textContent);
      return true;
    } catch { // browsers forbid clipboard access for local files
      getSelection().selectAllChildren(node);
      return document.execCommand("copy");
    }
  }

  // ------------------------------------------------------------------ whole page
  let axisShown = null;
  let others = null;
  /* Run KF and draw the visible views; quick (during a drag): without texts and tables */
  function show(quick = false) {
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
      others = drawReferences(result.axis);
      card.showAxis(settings.axis, flight.main);
      SETTINGS.forEach(markLikely);
    }
    if (result.run) setRanges(drawKf(result), others);
    drawCard(result);
    drawTitles(result);
    if (isSeen("map")) drawMap();
    if (quick) return;
    clearTimeout(finalDraw);
    for (const name of ["axis", "input"]) {
      for (const radio of document.querySelectorAll(`[name=${name}]`)) radio.checked = radio.value === settings[name];
    }
    const { axis } = result, map = mapNow();
    $("along").textContent = `· ${axis.along}`;
    $("axis-note").textContent = axis.note;
    $("likely").disabled = typeof map === "string" || map.likely.includes(null);
    $("ekf2-r").disabled = typeof axis.ekf2 === "string" || axis.ekf2.r === null;
    $("map-note").textContent = mapNote();
    drawTable(result);
    $("command").textContent = command();
    if (isNewAxis) times.strip(axis);
    times.plan();
    stepper.draw();
    toAddress();
  }
  /* Draw the same KF run again after a zoom */
  function redraw() {
    others = drawReferences(result.axis);
    if (result.run) setRanges(drawKf(result), others);
    times.plan();
  }

  const stepper = Step.start({ settings, chosen, result, model, setSource, figures, isSeen,
    moved: (time) => { times.show(time); toAddress(); } });
  const keys = { n: () => stepper.go((chosen.step ?? -1) + 1), p: () => stepper.go((chosen.step ?? 1) - 1),
    " ": () => { open("step"); stepper.play(); }, s: () => stepper.faster(-1), f: () => stepper.faster(1) };
  const times = Times.start({ flight, settings, model, setSource, timeRange, figures, redraw, shifted, isSeen, keys, open });
  const { flown, command: example, why: noReplay } = flight.ekf2;
  for (const [name, value] of Object.entries(flown)) $("flown").append(make("dt", name), make("dd", value));
  if (!Object.keys(flown).length) $("flown").append(make("dt", "The log contains none of its parameters."));
  $("whatif-command").textContent = example ?? "";
  if (noReplay) $("whatif").replaceChildren(make("p", `No replay: ${noReplay}.`, { className: "note" }));
  drawTabs();
  addEventListener("hashchange", () => { fromAddress(); axisShown = null; show(); });
  open(view, false);
  fromAddress();
  show();
  const shared = { look: times.view, settings, set, show, open, result, flight, model,
    numbers, timeRange, chosen, stepper, axisNow, mapNow, ekf2Of, view: () => view };
  Tour.start(shared);
  Practice.start(shared);
  return shared;
})();
