/* Time: what part of the flight is looked at, and what happened when. */
const Times = (() => {
  // by the places' names: the colours of both modes of the screen
  const COLOURS = {
    light: { ours: "#123f7a", ekf2: "#e0741a", truth: "#111111", measured: "#9a9a9a",
      paper: "#ffffff", ink: "#1b2027", muted: "#55606c", line: "#d9dee4", event: "#aab3bd" },
    dark: { ours: "#8ab8ff", ekf2: "#f0a35c", truth: "#f2f2f2", measured: "#7f8892",
      paper: "#1a1f26", ink: "#e5e9ee", muted: "#a0abb7", line: "#343c46", event: "#55616e" },
  };

  /* Where the plan stands */
  function places(flight) {
    const plan = make("section", undefined, { className: "card" });
    plan.append(make("h2", "Seen from above"),
      make("p", "Drag a box over the track to look at that time; the part in view is drawn thick.",
        { className: "note" }), make("div", undefined, { id: `plan-${flight.number}` }));
    return plan;
  }

  function start(page) {
    const { flights, settings, model, put, timeRange, figures, look, later, isSeen, keys: others } = page;
    const lone = flights[0];
    const ends = [Math.min(...flights.map((f) => f.segment[0] - f.shift)),
      Math.max(...flights.map((f) => f.segment[1] - f.shift))];

    // ------------------------------------------------------------------ the part in view
    let waiting = false;
    const seen = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => { waiting = false; said(); look(); });
    };
    const said = () => {
      $("span").textContent = `${timeRange.start.toFixed(1)} s to ${timeRange.end.toFixed(1)} s`;
    };
    function view(low, high) {
      const width = Math.min(Math.max(high - low, 0.2), ends[1] - ends[0]);
      const from = Math.min(Math.max((low + high - width) / 2, ends[0]), ends[1] - width);
      timeRange.start = from;
      timeRange.end = from + width;
    }
    [timeRange.start, timeRange.end] = ends;
    timeRange.properties.start.change.connect(seen);
    timeRange.properties.end.change.connect(seen);
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

    // ------------------------------------------------------------------ what happened
    function strip(flight, axis) {
      const rows = { row: [], left: [], right: [], text: [] };
      const add = (row, low, high, text) => {
        rows.row.push(row); rows.left.push(low - flight.shift); rows.right.push(high - flight.shift);
        rows.text.push(text);
      };
      const { events } = flight, sliver = (ends[1] - ends[0]) / 800;
      for (const [low, high, name] of events.modes) add("mode", low, high, name);
      for (const [low, high] of events.ground) add("on the ground", low, high, "");
      for (const [low, high] of events.silent) add("source silent", low, high, "");
      for (const [low, high] of events.dropout) add("log dropout", low, high, "");
      if (typeof axis.ekf2 !== "string") {
        for (const t of events.reset) add("EKF2 reset", t, t + sliver, "");
        const [time, , , rejected] = axis.ekf2.innovations;
        (rejected ?? []).forEach((flag, i) => { if (flag) add("EKF2 rejected", time[i], time[i] + sliver, ""); });
      }
      put("strip", flight, rows);
    }

    // ------------------------------------------------------------------ the plan
    function plan(flight) {
      if (typeof flight.plan === "string" || !isSeen("plan")) return;
      const [time, north, east] = flight.plan, t = later(time, flight.shift - settings.offset + flight.settings.offset);
      const inside = [...t.keys()].filter((i) => t[i] >= timeRange.start && t[i] <= timeRange.end);
      const track = model(`plan-source-${flight.number}`);
      if (!track.data.t.length) {
        put("plan", flight, { t: time, north, east });
        track.selected.properties.indices.change.connect(() => {
          const { indices } = track.selected;
          if (!indices.length) return;
          const [low, high] = [Math.min(...indices), Math.max(...indices)];
          track.selected.indices = [];
          view(time[low] - flight.shift, time[high] - flight.shift);
        });
      }
      put("shown", flight, { north: inside.map((i) => north[i]), east: inside.map((i) => east[i]) });
    }

    /* Where the vehicle was at a time of the filter, and that time in view */
    function show(t) {
      const shown = t - lone.shift;
      if (shown < timeRange.start || shown > timeRange.end) {
        const half = (timeRange.end - timeRange.start) / 2;
        view(shown - half, shown + half);
      }
      if (!isSeen("plan")) return;
      for (const flight of flights) {
        if (typeof flight.plan === "string") continue;
        const [time, north, east] = flight.plan, at = [t - settings.offset + flight.settings.offset];
        put("here", flight, { north: Engine.interp(at, time, north), east: Engine.interp(at, time, east) });
      }
    }

    // ------------------------------------------------------------------ findings and words
    $("facts").textContent = flights.map((flight) => `${flights.length > 1 ? `${flight.log}: ` : ""}positions `
      + `from ${flight.source}, ${flight.segment.map((t) => t.toFixed(1)).join(" s to ")} s`).join("; ");
    /* The story and the findings of the report, with another flight's where they came later */
    function recorded(later) {
      $("found").replaceChildren();
      for (const flight of flights) {
        const { story, findings } = later ?? flight, [a, z] = [flight.settings.sigmaA, flight.settings.sigmaZ];
        if (flights.length > 1) $("found").append(make("h3", flight.log));
        if (!story.length) { $("found").append(make("p", "Not told yet.")); continue; }
        $("found").append(make("p", `Recorded and judged at SIGMA_A ${a}, SIGMA_Z ${z}, DT ${flight.settings.dt} s, clock `
          + `offset ${Number(flight.settings.offset.toPrecision(4))} s; no knob changes this:`, { className: "note" }),
        make("p", story.join(" "), { dir: "auto", className: "story" }));
        if (!findings.length) $("found").append(make("p", "No findings."));
        for (const finding of findings) $("found").append(told(flight, finding));
      }
    }
    recorded();
    function told(flight, finding) {
      const box = make("div"), line = make("p", undefined, { dir: "auto" });
      line.append(make("span", `${finding.severity}: `, { className: `severity ${finding.severity}` }), finding.message);
      box.append(line);
      if (finding.remedy) box.append(make("p", finding.remedy, { className: "note", dir: "auto" }));
      // the page rewrites what hangs on the knobs
      if (finding.knobs) box.append(make("p", "", { className: "now-said", id: `now-said-${flight.number}` }));
      finding.spans.forEach(([low, high]) => {
        const text = high - low > 0.05 ? `${low.toFixed(1)} s to ${high.toFixed(1)} s` : `${low.toFixed(1)} s`;
        const button = make("button", `look at ${text}`, { type: "button", className: "jump" });
        button.addEventListener("click", () => {
          const around = Math.max(2, 0.3 * (high - low));
          view(low - flight.shift - around, high - flight.shift + around);
          page.open("innovation");
        });
        box.append(button);
      });
      for (const more of finding.more) box.append(told(flight, more));
      return box;
    }

    // ------------------------------------------------------------------ colours
    const dark = matchMedia("(prefers-color-scheme: dark)");
    function paint() {
      const colours = COLOURS[dark.matches ? "dark" : "light"];
      for (const flight of flights) {
        const all = [...figures(flight), ...["map", "plan", "step"].map((name) => model(`${name}-${flight.number}`))];
        for (const plot of all) {
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
          }
          for (const { name, glyph } of plot.renderers) colour(name, glyph, colours);
        }
      }
    }
    function colour(name, glyph, colours) {
      if (name === "ours_band") { glyph.fill_color = colours.ours; return; }
      if (name === "ink") { glyph.text_color = colours.ink; return; }
      if (name === null || colours[name] === undefined) return;
      const drawn = (one) => Boolean(one !== null && typeof one === "object" ? one.value : one);
      if (drawn(glyph.line_color)) glyph.line_color = colours[name];
      if (drawn(glyph.fill_color)) glyph.fill_color = colours[name]; // what is hollow stays so
    }
    dark.addEventListener("change", paint);
    paint();
    if (matchMedia("(pointer: coarse)").matches) { // a finger scrolls; the buttons zoom
      for (const flight of flights) for (const plot of figures(flight)) plot.toolbar.active_drag = null;
    }
    said();
    return { strip, plan, show, view, recorded };
  }

  return { places, start };
})();
