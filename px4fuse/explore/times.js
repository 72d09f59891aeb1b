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
    const move = (by) => {
      const width = timeRange.end - timeRange.start;
      setSpan(timeRange.start + by * width, timeRange.end + by * width);
    };
    const zoom = (by) => {
      const middle = (timeRange.start + timeRange.end) / 2, half = by * (timeRange.end - timeRange.start) / 2;
      setSpan(middle - half, middle + half);
    };
    const actions = { earlier: () => move(-0.5), later: () => move(0.5), closer: () => zoom(0.5),
      wider: () => zoom(2), whole: () => setSpan(...ends) };
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
      const rows = { row: [], left: [], right: [] };
      const add = (row, low, high) => {
        rows.row.push(row); rows.left.push(low); rows.right.push(high);
      };
      const { events } = flight, minWidth = (ends[1] - ends[0]) / 800;
      for (const [row, spans] of [["on the ground", events.ground], ["gap in source", events.gap], ["log dropout", events.dropout]]) {
        for (const [low, high] of spans) add(row, low, high);
      }
      if (!isText(axis.ekf2)) {
        const [time, , , rejected] = axis.ekf2.innovations;
        for (const [row, times] of [["EKF2 reset", events.reset], ["EKF2 rejected", time?.filter((_, i) => rejected[i]) ?? []]]) {
          for (const t of times) add(row, t, t + minWidth);
        }
      }
      setSource("strip", rows);
    }

    /* Make time t (s) visible in the plots */
    function showTime(t) {
      if (t >= timeRange.start && t <= timeRange.end) return;
      const half = (timeRange.end - timeRange.start) / 2;
      setSpan(t - half, t + half);
    }

    // ------------------------------------------------------------------ colours
    const dark = matchMedia("(prefers-color-scheme: dark)");
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
      const hasColour = (property) => Boolean(property?.value === undefined ? property : property.value);
      if (hasColour(glyph.line_color)) glyph.line_color = colours[name];
      if (hasColour(glyph.fill_color)) glyph.fill_color = colours[name]; // hollow marks have none
    }
    dark.addEventListener("change", paint);
    paint();
    if (matchMedia("(pointer: coarse)").matches) { // a finger scrolls the page, so only buttons zoom
      for (const plot of figures) plot.toolbar.active_drag = null;
    }
    showRange();
    return { drawEvents, showTime, setSpan };
  }

  return { start };
})();
