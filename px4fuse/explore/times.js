/* Time range and colours of the plots, and events. */
const Times = (() => {
  // Names of drawn elements; the colour of an element is the CSS variable with its name, such as --kf
  const NAMES = ["kf", "ekf2", "truth", "measured", "ink", "band"];

  function start(page) {
    const { flight, model, setSource, timeRange, figures, redraw, keys: otherKeys } = page;
    const ends = flight.shown;

    // ------------------------------------------------------------------ visible time range
    let waiting = false;
    const onRangeChange = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => { waiting = false; showRange(); redraw(); });
    };
    const showRange = () => {
      $("span").textContent = `${timeRange.start.toFixed(1)} s to ${timeRange.end.toFixed(1)} s`;
    };
    function setSpan(low, high) {
      const width = clamp(high - low, 0.2, ends[1] - ends[0]);
      const from = clamp((low + high - width) / 2, ends[0], ends[1] - width);
      timeRange.start = from;
      timeRange.end = from + width;
    }
    [timeRange.start, timeRange.end] = ends;
    timeRange.properties.start.change.connect(onRangeChange);
    timeRange.properties.end.change.connect(onRangeChange);
    /* Show a time range with its middle at time t (s), wider by a factor */
    const showAround = (t, factor = 1) => {
      const half = factor * (timeRange.end - timeRange.start) / 2;
      setSpan(t - half, t + half);
    };
    const middle = () => (timeRange.start + timeRange.end) / 2;
    const actions = { earlier: () => showAround(timeRange.start), later: () => showAround(timeRange.end),
      closer: () => showAround(middle(), 0.5), wider: () => showAround(middle(), 2), whole: () => setSpan(...ends) };
    for (const [id, act] of Object.entries(actions)) onClick(id, act);
    const keys = { ArrowLeft: actions.earlier, ArrowRight: actions.later, "+": actions.closer,
      "-": actions.wider, 0: actions.whole, ...otherKeys };
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const isRadioKey = event.key === " " || event.key.startsWith("Arrow");
      if (event.target.matches("input:not([type=radio]), summary") || (event.key === " " && event.target.matches("button"))
        || (isRadioKey && event.target.matches("[type=radio]"))) return;
      if (keys[event.key]) { keys[event.key](); event.preventDefault(); }
    });

    // ------------------------------------------------------------------ events
    function drawEvents(axis) {
      const { events } = flight, minWidth = (ends[1] - ends[0]) / 800;
      const spans = { "on the ground": events.ground, "gap in source": events.gap, "log dropout": events.dropout };
      if (!isText(axis.ekf2)) {
        const [time = [], , , rejected] = axis.ekf2.innovations, widen = (t) => [t, t + minWidth];
        spans["EKF2 reset"] = events.reset.map(widen);
        spans["EKF2 rejected"] = [...time].filter((_, i) => rejected[i]).map(widen);
      }
      const rows = Object.entries(spans).flatMap(([row, list]) => list.map((span) => [row, ...span]));
      const [row, left, right] = [0, 1, 2].map((column) => rows.map((cells) => cells[column]));
      setSource("strip", { row, left, right });
    }

    /* Make time t (s) visible in the plots */
    function showTime(t) {
      if (t < timeRange.start || t > timeRange.end) showAround(t);
    }

    // ------------------------------------------------------------------ colours
    function paint() {
      const style = getComputedStyle(document.documentElement);
      const colours = Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`)]));
      for (const plot of [...figures, model("step")]) {
        for (const item of plot.center) {
          if (item.type !== "Grid") item.line_color = { cursor: colours.ink, measurement: colours.measured, consistent: colours.band }[item.name] ?? null;
          if (item.name === "band") item.fill_color = colours.measured;
          if (item.name === "consistent") item.fill_color = colours.band;
        }
        for (const { name, glyph } of plot.renderers) colour(name, glyph, colours);
      }
    }
    function colour(name, glyph, colours) {
      if (name === "kf_band") { glyph.fill_color = colours.kf; return; }
      if (name === null || colours[name] === undefined) return;
      for (const property of ["line_color", "fill_color"]) {
        const value = glyph[property];
        // hollow marks have no fill colour
        if (value?.value === undefined ? value : value.value) glyph[property] = colours[name];
      }
    }
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
    paint();
    // a finger scrolls the page, so only buttons zoom
    if (matchMedia("(pointer: coarse)").matches) {
      for (const plot of figures) plot.toolbar.active_drag = null;
    }
    showRange();
    return { drawEvents, showTime, setSpan };
  }

  return { start };
})();
