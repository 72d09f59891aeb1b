/* Time range of the plots, events and map. */
const Times = (() => {
  // names of the drawn elements, which are names of CSS colours
  const NAMES = ["kf", "ekf2", "truth", "measured", "paper", "ink", "muted", "line", "band"];

  function start(page) {
    const { flight, settings, model, setSource, timeRange, figures, redraw, shifted, isSeen, keys: others } = page;
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
    function view(low, high) {
      const width = Math.min(Math.max(high - low, 0.2), ends[1] - ends[0]);
      const from = Math.min(Math.max((low + high - width) / 2, ends[0]), ends[1] - width);
      timeRange.start = from;
      timeRange.end = from + width;
    }
    [timeRange.start, timeRange.end] = ends;
    timeRange.properties.start.change.connect(onRangeChange);
    timeRange.properties.end.change.connect(onRangeChange);
    const move = (by) => {
      const width = timeRange.end - timeRange.start;
      view(timeRange.start + by * width, timeRange.end + by * width);
    };
    const zoom = (by) => {
      const middle = (timeRange.start + timeRange.end) / 2, half = by * (timeRange.end - timeRange.start) / 2;
      view(middle - half, middle + half);
    };
    const actions = { earlier: () => move(-0.5), later: () => move(0.5), closer: () => zoom(0.5),
      wider: () => zoom(2), whole: () => view(...ends) };
    for (const [id, act] of Object.entries(actions)) $(id).addEventListener("click", act);
    const keys = { ArrowLeft: actions.earlier, ArrowRight: actions.later, "+": actions.closer,
      "-": actions.wider, 0: actions.whole, ...others };
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.target.matches("input, [role=tab], summary") || (event.key === " " && event.target.matches("button"))) return;
      if (keys[event.key]) { keys[event.key](); event.preventDefault(); }
    });

    // ------------------------------------------------------------------ events
    function strip(axis) {
      const rows = { row: [], left: [], right: [], text: [] };
      const add = (row, low, high, text) => {
        rows.row.push(row); rows.left.push(low); rows.right.push(high); rows.text.push(text);
      };
      const { events } = flight, minWidth = (ends[1] - ends[0]) / 800;
      for (const [low, high, name] of events.modes) add("mode", low, high, name);
      for (const [low, high] of events.ground) add("on the ground", low, high, "");
      for (const [low, high] of events.gap) add("gap in source", low, high, "");
      for (const [low, high] of events.dropout) add("log dropout", low, high, "");
      if (typeof axis.ekf2 !== "string") {
        for (const t of events.reset) add("EKF2 reset", t, t + minWidth, "");
        const [time, , , rejected] = axis.ekf2.innovations;
        (rejected ?? []).forEach((flag, i) => { if (flag) add("EKF2 rejected", time[i], time[i] + minWidth, ""); });
      }
      setSource("strip", rows);
    }

    // ------------------------------------------------------------------ map
    function plan() {
      if (typeof flight.plan === "string" || !isSeen("plan")) return;
      const [time, north, east] = flight.plan, t = shifted(time, settings.offset - flight.settings.offset);
      const inside = [...t.keys()].filter((i) => t[i] >= timeRange.start && t[i] <= timeRange.end);
      const track = model("plan-source");
      if (!track.data.t.length) {
        setSource("plan", { t: time, north, east });
        track.selected.properties.indices.change.connect(() => {
          const { indices } = track.selected;
          if (!indices.length) return;
          const [low, high] = [Math.min(...indices), Math.max(...indices)];
          track.selected.indices = [];
          view(time[low], time[high]);
        });
      }
      setSource("shown", { north: inside.map((i) => north[i]), east: inside.map((i) => east[i]) });
    }

    /* Mark the vehicle on the map at a time of KF, and make that time visible */
    function show(t) {
      if (t < timeRange.start || t > timeRange.end) {
        const half = (timeRange.end - timeRange.start) / 2;
        view(t - half, t + half);
      }
      if (typeof flight.plan === "string" || !isSeen("plan")) return;
      const [time, north, east] = flight.plan, at = [t - settings.offset + flight.settings.offset];
      setSource("here", { north: Engine.interp(at, time, north), east: Engine.interp(at, time, east) });
    }

    // ------------------------------------------------------------------ colours
    const dark = matchMedia("(prefers-color-scheme: dark)");
    function paint() {
      const style = getComputedStyle(document.documentElement);
      const colours = Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`)]));
      for (const plot of [...figures, ...["map", "plan", "step"].map(model)]) {
        plot.background_fill_color = plot.border_fill_color = colours.paper;
        plot.outline_line_color = colours.line;
        for (const axis of [...plot.left, ...plot.below]) {
          axis.axis_label_text_color = axis.major_label_text_color = colours.muted;
          axis.axis_line_color = axis.major_tick_line_color = axis.minor_tick_line_color = colours.muted;
        }
        for (const one of plot.center) {
          if (one.type === "Grid") one.grid_line_color = colours.line;
          if (one.name === "cursor") one.line_color = colours.ink;
          if (one.name === "measurement") one.line_color = colours.measured;
          if (one.name === "band") one.fill_color = colours.measured;
          if (one.name === "consistent") one.fill_color = one.line_color = colours.band;
        }
        for (const { name, glyph } of plot.renderers) colour(name, glyph, colours);
      }
    }
    function colour(name, glyph, colours) {
      if (name === "kf_band") { glyph.fill_color = colours.kf; return; }
      if (name === "ink") { glyph.text_color = colours.ink; return; }
      if (name === null || colours[name] === undefined) return;
      const isVisible = (one) => Boolean(one !== null && typeof one === "object" ? one.value : one);
      if (isVisible(glyph.line_color)) glyph.line_color = colours[name];
      if (isVisible(glyph.fill_color)) glyph.fill_color = colours[name]; // hollow marks stay hollow
    }
    dark.addEventListener("change", paint);
    paint();
    if (matchMedia("(pointer: coarse)").matches) { // touch scrolls the page; zoom with the buttons
      for (const plot of figures) plot.toolbar.active_drag = null;
    }
    showRange();
    return { strip, plan, show, view };
  }

  return { start };
})();
