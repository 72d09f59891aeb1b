/* Main script of the page: runs KF with the settings and draws plots and numbers. */
const Explore = (async () => {
  // maximum number of drawn points of a line
  const MAX_POINTS = 1000;
  const read = (id) => $(`${id}${Practice.suffix}`).textContent;
  // ------------------------------------------------------------------ the flight's data
  const arrays = await Engine.unpack(read("arrays"));
  const withArrays = (_, value) => value?.array === undefined ? value : arrays[value.array];
  const { flight, ratio_axis: ratioAxis, places } = JSON.parse(read("content"), withArrays);
  const { imu, axes } = flight;

  // ------------------------------------------------------------------ settings
  const settings = { ...flight.settings, axis: flight.main };
  // names of the settings of KF by ids of their sliders
  const SETTINGS = { "sigma-a": "sigma_a_m_s2", "sigma-z": "sigma_z_m", "clock-offset": "clock_offset_s", dt: "dt_s" };
  // the slider of the time offset is linear, all others are logarithmic
  const toSlider = (key, value) => key === "clock_offset_s" ? value : Math.log10(value);
  const fromSlider = (key, place) => key === "clock_offset_s" ? Number(place.toFixed(4)) : round(10 ** place);
  const round = (value) => Number(value.toPrecision(3));
  const axisNow = () => axes.find(({ name }) => name === settings.axis);
  const likelyNow = () => flight.likely[axisNow().noises] ?? [null, null];

  /* Change settings; KF runs again at the next frame */
  let nextFrame = null;
  function set(changes) {
    Object.assign(settings, changes);
    nextFrame ??= requestAnimationFrame(show);
  }
  const offsetSlider = $("clock-offset");
  [offsetSlider.min, offsetSlider.max] = flight.limits.clock_offset_s;
  for (const [id, key] of Object.entries(SETTINGS)) {
    const slider = $(id), number = $(`${id}-value`);
    [number.min, number.max] = flight.limits[key];
    slider.addEventListener("input", () => set({ [key]: fromSlider(key, slider.valueAsNumber) }));
    number.addEventListener("change", () => {
      if (number.reportValidity()) set({ [key]: number.valueAsNumber });
    });
  }
  if (offsetSlider.min === offsetSlider.max) {
    $("offset-note").hidden = false;
    for (const id of ["clock-offset", "clock-offset-value"]) $(id).disabled = true;
  }
  if (typeof imu === "string") {
    $("input-note").textContent = imu;
    query("[name=input][value=imu]").disabled = true;
  }
  for (const radio of queryAll("[name=axis], [name=input]")) {
    radio.addEventListener("change", () => set({ [radio.name]: radio.value }));
  }
  onClick("likely", () => {
    const [sigmaA, sigmaZ] = likelyNow().map(round);
    set({ sigma_a_m_s2: sigmaA, sigma_z_m: sigmaZ, dt_s: flight.settings.dt_s });
  });
  onClick("ekf2-r", () => set({ sigma_z_m: round(axisNow().ekf2.r) }));
  onClick("card", ({ target }) => {
    const command = target.dataset.apply;
    if (command === undefined) return;
    const changes = { ...flight.settings };
    for (const [id, key] of Object.entries(SETTINGS)) {
      const found = new RegExp(`--${id} (-?[0-9.e-]+)`).exec(command);
      if (found) changes[key] = Number(found[1]);
    }
    set(changes);
  });
  for (const [name, value] of Object.entries(flight.flown)) $("flown").append(make("dt", name), make("dd", value));

  /* Show the settings, their maximum-likelihood estimates and the command with these settings */
  function showSettings() {
    const [sigmaA, sigmaZ] = likelyNow(), { ekf2, note } = axisNow();
    const likely = { "sigma-a": sigmaA, "sigma-z": sigmaZ, "clock-offset": flight.likely_offset };
    const words = [flight.command];
    for (const [id, key] of Object.entries(SETTINGS)) {
      const value = settings[key], slider = $(id);
      $(`${id}-value`).value = value;
      slider.value = toSlider(key, value);
      slider.ariaValueText = String(value);
      $(`${id}-likely`).textContent = likely[id] ? `(maximum likelihood ${round(likely[id])})` : "";
      if (!slider.disabled) words.push(`--${id} ${value}`);
    }
    for (const radio of queryAll("[name=axis], [name=input]")) radio.checked = radio.value === settings[radio.name];
    $("axis-note").textContent = note;
    $("likely").disabled = sigmaA === null;
    $("ekf2-r").disabled = !ekf2?.r;
    $("command").textContent = [...words, `--input ${settings.input}`].join(" ");
  }

  // ------------------------------------------------------------------ views
  let view = "errors";
  function open(name) {
    view = name;
    for (const button of queryAll("[name=view]")) button.checked = button.value === name;
    for (const box of queryAll("[data-view]")) box.hidden = box.dataset.view !== name;
    set({});
  }
  for (const button of queryAll("[name=view]")) button.addEventListener("change", () => open(button.value));

  // ------------------------------------------------------------------ Bokeh
  Bokeh.logger.set_level("off");
  await Bokeh.embed.embed_items({ page: JSON.parse(read("document")) }, [
    { docid: "page", roots: places, root_ids: Object.keys(places) }]);
  const model = (name) => Bokeh.documents[0].get_model_by_name(name);
  /* Draw columns, reduced to MAX_POINTS, in each visible plot with this source */
  function drawSource(name, columns) {
    for (const { id, dataset } of queryAll(`.plot[data-view=${view}] > div`)) {
      const source = model(`${id}:${name}-source`);
      if (source) source.data = decimate(columns, columns[dataset.column]);
    }
  }
  const timeRange = model("time");
  const figures = queryAll(".plot > div").map(({ id }) => model(id));
  /* Rows within the visible time range; of long series only minimum and maximum of `y` in each time bin */
  function decimate(columns, y) {
    const t = columns.t, n = t.length;
    const from = Math.max(t.findIndex((time) => time >= timeRange.start) - 1, 0);
    const last = t.findIndex((time) => time >= timeRange.end), to = last < 0 ? n : Math.min(last + 2, n);
    const mapColumns = (select) => Object.fromEntries(Object.entries(columns).map(([name, column]) => [name, select(column)]));
    if (to - from <= MAX_POINTS) return mapColumns((column) => column.slice(from, to));
    const bins = MAX_POINTS / 2, edge = (bin) => from + Math.floor((to - from) * bin / bins), indices = [];
    for (let bin = 0; bin < bins; bin++) {
      let least = edge(bin), most = least;
      for (let i = least; i < edge(bin + 1); i++) { if (y[i] < y[least]) least = i; if (y[i] > y[most]) most = i; }
      indices.push(Math.min(least, most), Math.max(least, most));
    }
    return mapColumns((column) => indices.map((i) => column[i]));
  }

  // ------------------------------------------------------------------ visible time range
  const [firstTime, lastTime] = flight.shown;
  function showTimes(start, width) {
    const newWidth = clamp(width, 0.2, lastTime - firstTime), from = clamp(start, firstTime, lastTime - newWidth);
    timeRange.setv({ start: from, end: from + newWidth });
  }
  // shift of the middle as fraction of the visible time, and factor on the visible time
  const ZOOMS = { earlier: [-0.5, 1], later: [0.5, 1], closer: [0, 0.5], wider: [0, 2], whole: [0, Infinity] };
  for (const [id, [shift, factor]] of Object.entries(ZOOMS)) {
    onClick(id, () => {
      const width = timeRange.end - timeRange.start;
      showTimes(timeRange.start + width * (0.5 + shift - factor / 2), factor * width);
    });
  }
  showTimes(firstTime, Infinity);
  timeRange.change.connect(() => set({}));
  // a finger scrolls the page, so only buttons zoom
  if (matchMedia("(pointer: coarse)").matches) {
    for (const plot of figures) plot.toolbar.active_drag = null;
  }

  // ------------------------------------------------------------------ KF run and its numbers
  // latest `run` of KF, its `axis` and its `numbers`; without enough measurements, `run` and `numbers` are null
  const result = {};
  /* Statistics of a KF run: innovations, difference to EKF2 and error against ground truth, at the times of EKF2's state */
  function numbers(axis, run) {
    const kf = Engine.assess(run.updates.nu, run.updates.s);
    if (kf.count) {
      const [low, high] = axis.bands.map((limits) => limits[kf.count - 1]);
      kf.source = Math.sqrt(kf.nis);
      kf.isNisInBand = kf.nis >= low && kf.nis <= high;
    }
    let times = run.steps.time, state = run.steps;
    if (axis.ekf2) {
      const [time, p] = axis.ekf2.state;
      times = time;
      state = Engine.stateAt(run, time);
      kf.differenceRms = Engine.rmse(state.p, p);
    }
    if (axis.truth) {
      const expected = Engine.interp(times, ...axis.truth.p, NaN);
      kf.rmse = Engine.rmse(state.p, expected);
      kf.truth = Engine.rmse(state.p.map((x, i) => (x - expected[i]) / Math.sqrt(state.p00[i])), new Float64Array(times.length));
    }
    return kf;
  }

  // ------------------------------------------------------------------ card
  const sigmaRatioFigures = new Map([...$(`figures${Practice.suffix}`).content.children].map((figure) => [figure.dataset.axis, figure]));
  // the figure in the card also marks explained verdicts
  const cardFigure = query("#card figure");
  if (cardFigure.hasChildNodes()) sigmaRatioFigures.set(flight.main, cardFigure);
  function drawCard({ numbers: kf }) {
    const isChanged = Object.keys(flight.settings).some((key) => settings[key] !== flight.settings[key]);
    const figure = sigmaRatioFigures.get(settings.axis).cloneNode(true), verdicts = Card.findVerdicts(kf, ratioAxis.bands);
    if (isChanged) Card.moveMarks(figure, verdicts, ratioAxis);
    query("#card figure").replaceWith(figure);
    Card.showHeadline(verdicts, isChanged);
  }

  // ------------------------------------------------------------------ plots over time
  /* Innovations ÷ √S for the plot; those outside the plot are arrow heads at its edge */
  function innovationRows(t, nu, sigma, marker) {
    const edge = 0.95 * model("innovation").y_range.end, x = Array.from(nu, (value, i) => value / sigma[i]);
    return { t, x, y: x.map((value) => clamp(value, -edge, edge)),
      marker: x.map((value) => value > edge ? "triangle" : value < -edge ? "inverted_triangle" : marker) };
  }
  /* Differences of positions to those of a reference [times, positions] */
  function errors(t, p, reference) {
    const expected = Engine.interp(t, ...reference, NaN);
    return p.map((position, i) => position - expected[i]);
  }
  function drawKf({ run: { steps, updates }, axis: { ekf2, truth, time, z } }) {
    const rows = { t: [], p: [], v: [], sp: [], sv: [] };
    const add = (t, { p, v, p00, p11 }, i) => {
      rows.t.push(t);
      rows.p.push(p[i]);
      rows.v.push(v[i]);
      rows.sp.push(Math.sqrt(p00[i]));
      rows.sv.push(Math.sqrt(p11[i]));
    };
    for (let i = 0, u = 0; i < steps.time.length; i++) {
      // the state before the update is an additional row
      if (updates.step[u] === i) add(steps.time[i], updates, u++);
      add(steps.time[i], steps, i);
    }
    const reference = truth?.p ?? ekf2?.state.slice(0, 2) ?? [[], []];
    const plus = rows.sp.map((sigma) => 2 * sigma), minus = plus.map((x) => -x);
    drawSource("kf", { ...rows, plus, minus, e: errors(rows.t, rows.p, reference) });
    drawSource("gain", { t: updates.time, k0: updates.k0, k1: updates.k1 });
    drawSource("innovations", innovationRows(updates.time, updates.nu, updates.s.map(Math.sqrt), "circle"));
    drawSource("measured", { t: time.map((t) => t + settings.clock_offset_s), p: z });
  }
  /* Draw EKF2 and ground truth; missing data are drawn as empty or NaN */
  function drawReferences(axis) {
    const truth = axis.truth ?? { p: [[], []], v: [[], []] }, [truthTime, truthP] = truth.p;
    drawSource("truth", { t: truthTime, p: truthP, v: Engine.interp(truthTime, ...truth.v, NaN) });
    const ekf2 = axis.ekf2 ?? { state: [[], [], []], innovations: [] };
    const [t, p, v, sp = p.map(() => NaN), sv = sp] = ekf2.state;
    drawSource("ekf2", { t, p, v, sp, sv, e: errors(t, p, truth.p) });
    const [time = [], nu = [], sigma = [], rejected] = ekf2.innovations;
    for (const [name, flag] of [["fused", 0], ["rejected", 1]]) {
      const columns = [time, nu, sigma].map((values) => values.filter((_, i) => rejected[i] === flag));
      drawSource(name, innovationRows(...columns, "square"));
    }
  }
  /* Add RMSE and the percentage of large innovations to the titles of the plots */
  function drawTitles({ axis, numbers: kf }) {
    const title = (name, text) => {
      const span = $(name)?.parentElement.querySelector("span");
      if (span) span.textContent = `· ${text}`;
    };
    const ekf2 = axis.ekf2?.summary ?? {};
    const both = (name, format) => [["KF", kf?.[name]], ["EKF2", ekf2[name]]]
      .filter(([, value]) => Number.isFinite(value)).map(([filter, value]) => `${filter} ${format(value)}`).join(", ");
    title("innovation", `innovations outside ±2√S (expected 5 %): ${both("outside", (x) => `${(100 * x).toFixed(0)} %`)}`);
    const rms = axis.truth ? `position RMSE against ground truth: ${both("rmse", Card.formatMetres)}`
      : `RMS position difference KF − EKF2: ${both("differenceRms", Card.formatMetres)}`;
    title("error", `${rms} · shaded: ±2σ reported by KF, hatched: gap in the position source`);
  }

  // ------------------------------------------------------------------ step by step
  const cursors = figures.map((plot) => plot.center.find(({ name }) => name === "cursor"));
  // index of the selected measurement
  let measurement = 0;
  function select(index) {
    if (!result.run) return;
    const times = result.run.updates.time, width = timeRange.end - timeRange.start;
    measurement = clamp(index, 0, times.length - 1);
    const time = times[measurement];
    if (time < timeRange.start || time > timeRange.end) showTimes(time - width / 2, width);
    set({});
  }
  const selectPrevious = () => select(measurement - 1), selectNext = () => select(measurement + 1);
  onClick("previous", selectPrevious);
  onClick("next", selectNext);
  $("cursor").addEventListener("input", ({ target }) => select(target.valueAsNumber));
  addEventListener("keydown", ({ key, ctrlKey, metaKey, altKey }) => {
    if (ctrlKey || metaKey || altKey) return;
    if (key === "p") selectPrevious();
    if (key === "n") selectNext();
  });
  function drawStep({ run }) {
    const count = run.updates.time.length, slider = $("cursor");
    measurement = Math.min(measurement, count - 1);
    const time = run.updates.time[measurement], text = `Measurement ${measurement + 1} of ${count}`;
    for (const cursor of cursors) cursor.location = time;
    slider.max = count - 1;
    slider.value = measurement;
    slider.ariaValueText = text;
    $("now").textContent = `${text}, at ${time.toFixed(3)} s`;
    if (view === "step") Step.draw(run, measurement, model);
  }

  // ------------------------------------------------------------------ whole page
  /* Run KF and draw the visible view */
  function show() {
    nextFrame = null;
    const axis = axisNow(), run = Engine.replay(flight, axis, settings);
    Object.assign(result, { run, axis, numbers: run && numbers(axis, run) });
    showSettings();
    drawCard(result);
    $("span").textContent = `${timeRange.start.toFixed(1)} s to ${timeRange.end.toFixed(1)} s`;
    drawTitles(result);
    drawReferences(axis);
    if (!run) return;
    drawKf(result);
    drawStep(result);
  }
  open(view);
  const page = { settings, set, open, showTimes, result, flight, model };
  Practice.start(page);
  return page;
})();
