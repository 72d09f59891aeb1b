/* Time: what part of the flight is looked at, what happened when, and one measurement by itself. */
"use strict";
const Times = (() => {
  const $ = (id) => document.getElementById(id);
  const make = (tag, text, properties) => {
    const node = Object.assign(document.createElement(tag), properties);
    if (text !== undefined) node.textContent = text;
    return node;
  };
  // by the places' names: the colours of both modes of the screen
  const COLOURS = {
    light: { ours: "#123f7a", ekf2: "#e0741a", truth: "#111111", measured: "#9a9a9a",
      paper: "#ffffff", ink: "#1b2027", muted: "#55606c", line: "#d9dee4", event: "#aab3bd" },
    dark: { ours: "#8ab8ff", ekf2: "#f0a35c", truth: "#f2f2f2", measured: "#7f8892",
      paper: "#1a1f26", ink: "#e5e9ee", muted: "#a0abb7", line: "#343c46", event: "#55616e" },
  };

  /* Where the plots stand that have words beside them */
  function places(flight) {
    const n = flight.number, box = make("div", undefined, { className: "two" });
    const step = make("section", undefined, { className: "card step" });
    step.append(make("h2", "Step by step"), make("p", flight.log, { className: "note", dir: "auto" }));
    const buttons = make("div", undefined, { className: "buttons" });
    for (const [id, text] of [["first", "first"], ["previous", "previous measurement"],
      ["next", "next measurement"], ["last", "last"]]) {
      buttons.append(make("button", text, { type: "button", id: `${id}-${n}` }));
    }
    const slider = make("input", undefined, { type: "range", id: `cursor-${n}`, min: 0, value: 0,
      ariaLabel: "Measurement" });
    step.append(buttons, slider, make("p", "", { id: `now-${n}`, role: "status" }),
      make("div", undefined, { id: `step-${n}` }),
      make("p", "Dashed: predicted. Dotted: measured. Solid: after the update.", { className: "note" }),
      make("div", undefined, { id: `numbers-${n}` }));
    const plan = make("section", undefined, { className: "card" });
    plan.append(make("h2", "Seen from above"),
      make("p", "Drag a box over the track to look at that time; the part in view is drawn thick.",
        { className: "note" }), make("div", undefined, { id: `plan-${n}` }));
    box.append(step, plan);
    return box;
  }

  function start(page) {
    const { flights, settings, chosen, runs, model, put, timeRange, figures, look, toAddress, axisOf,
      later } = page;
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
      "-": actions.wider, 0: actions.whole, n: () => go((chosen.step ?? -1) + 1),
      p: () => go((chosen.step ?? 1) - 1) };
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input")) return;
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
      const other = Grid.chosen(flight, axis);
      if (other) {
        for (const t of other.reset) add("EKF2 reset", t, t + sliver, "");
        for (const t of other.rejected) add("EKF2 rejected", t, t + sliver, "");
      } else if (typeof axis.ekf2 !== "string") {
        for (const t of events.reset) add("EKF2 reset", t, t + sliver, "");
        const [time, , , rejected] = axis.ekf2.innovations;
        (rejected ?? []).forEach((flag, i) => { if (flag) add("EKF2 rejected", time[i], time[i] + sliver, ""); });
      }
      put("strip", flight, rows);
    }

    // ------------------------------------------------------------------ the plan
    function plan(flight) {
      if (typeof flight.plan === "string") return;
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

    // ------------------------------------------------------------------ one measurement
    function go(step) {
      const done = runs[0];
      if (!done?.run) return;
      chosen.step = Math.min(Math.max(step, 0), done.run.updates.nu.length - 1);
      const t = done.run.updates.time[chosen.step] - lone.shift;
      if (t < timeRange.start || t > timeRange.end) {
        const half = (timeRange.end - timeRange.start) / 2;
        view(t - half, t + half);
      }
      for (const flight of flights) stepOf(flight);
      toAddress();
    }
    const words = (x, digits = 4) => Math.abs(x) >= 1e-4 || x === 0 ? x.toFixed(digits) : x.toExponential(2);
    const matrix = (a, b, d) => `[${words(a, 5)}  ${words(b, 5)}; ${words(b, 5)}  ${words(d, 5)}]`;
    function stepOf(flight) {
      const n = flight.number, done = runs[n];
      const slider = $(`cursor-${n}`), cursors = figures(flight).flatMap((plot) => plot.center)
        .filter((one) => one.name === "cursor");
      const known = done?.run && chosen.step !== null;
      for (const line of cursors) line.visible = Boolean(known);
      for (const id of ["first", "previous", "next", "last"]) $(`${id}-${n}`).disabled = !done?.run;
      if (!known) { $(`now-${n}`).textContent = "Choose a measurement: press n, or the buttons."; return; }
      const { updates: u, steps } = done.run, m = u.nu.length;
      const k = Math.min(chosen.step, m - 1), i = u.step[k];
      slider.max = m - 1;
      slider.value = k;
      const t = u.time[k], shown = t - flight.shift;
      for (const line of cursors) line.location = shown;
      $(`now-${n}`).textContent = `Measurement ${k + 1} of ${m}, at ${shown.toFixed(3)} s`;
      slider.ariaValueText = $(`now-${n}`).textContent;
      const r = settings.sigmaZ ** 2, before = k ? u.step[k - 1] : 0;
      const bells = [["before", u.p[k], u.p00[k]], ["measurement", u.z[k], r], ["posterior", steps.p[i], steps.p00[i]]];
      const low = Math.min(...bells.map(([, x, s]) => x - 3.5 * Math.sqrt(s)));
      const high = Math.max(...bells.map(([, x, s]) => x + 3.5 * Math.sqrt(s)));
      let top = 0;
      for (const [name, mean, variance] of bells) {
        // from its own middle outwards, so that a narrow one is not cut between two points
        const sigma = Math.sqrt(variance), x = [], y = [];
        for (let j = -80; j <= 80; j++) {
          x.push(mean + j / 20 * sigma);
          y.push(Math.exp(-(j * j) / 800) / (sigma * Math.sqrt(2 * Math.PI)));
        }
        top = Math.max(top, y[80]);
        put(name, flight, { x, y });
      }
      const plot = model(`step-${n}`);
      [plot.x_range.start, plot.x_range.end] = [low, high];
      [plot.y_range.start, plot.y_range.end] = [0, 1.08 * top];
      const rows = [
        ["Before", `x⁺ = [${words(steps.p[before])} m, ${words(steps.v[before])} m/s]`],
        ["", `P⁺ = ${matrix(steps.p00[before], steps.p01[before], steps.p11[before])}`],
        ["Predict", `${i - before} step${i - before > 1 ? "s" : ""} x⁻ = Fx + Ba, P⁻ = FPFᵀ + Q over ${words(t - steps.time[before], 3)} s`],
        ["", `x⁻ = [${words(u.p[k])} m, ${words(u.v[k])} m/s]`],
        ["", `P⁻ = ${matrix(u.p00[k], u.p01[k], u.p11[k])}`],
        ["", `σ_p ${grows(steps.p00[before], u.p00[k])}: ${words(Math.sqrt(steps.p00[before]))} to ${words(Math.sqrt(u.p00[k]))} m`],
        ["Measure", `z = ${words(u.z[k])} m, R = SIGMA_Z² = ${words(r, 5)} m²`],
        ["Compare", `ν = z − Hx⁻ = ${words(u.nu[k])} m`],
        ["", `S = HP⁻Hᵀ + R = ${words(u.s[k], 5)} m²; ν²/S = ${words(u.nu[k] ** 2 / u.s[k], 2)}`],
        ["Gain", `K = P⁻Hᵀ/S = [${words(u.k0[k])}, ${words(u.k1[k])} 1/s]`],
        ["Update", `x⁺ = x⁻ + Kν = [${words(steps.p[i])} m, ${words(steps.v[i])} m/s]`],
        ["", `P⁺ = (I − KH)P⁻ = ${matrix(steps.p00[i], steps.p01[i], steps.p11[i])}`],
        ["", `σ_p ${grows(u.p00[k], steps.p00[i])}: ${words(Math.sqrt(u.p00[k]))} to ${words(Math.sqrt(steps.p00[i]))} m`],
      ];
      const own = make("table");
      for (const [head, text] of rows) {
        const row = own.insertRow();
        row.append(make("th", head, { scope: "row" }), make("td", text));
      }
      $(`numbers-${n}`).replaceChildren(own);
      if (typeof flight.plan !== "string") {
        const [time, north, east] = flight.plan, at = [t - settings.offset + flight.settings.offset];
        put("here", flight, { north: Engine.interp(at, time, north), east: Engine.interp(at, time, east) });
      }
    }
    const grows = (before, after) => after > before ? "grows" : after < before ? "shrinks" : "stays";
    for (const { number: n } of flights) {
      const last = () => runs[n].run.updates.nu.length - 1;
      $(`first-${n}`).addEventListener("click", () => go(0));
      $(`previous-${n}`).addEventListener("click", keys.p);
      $(`next-${n}`).addEventListener("click", keys.n);
      $(`last-${n}`).addEventListener("click", () => go(last()));
      $(`cursor-${n}`).addEventListener("input", (event) => go(Number(event.target.value)));
    }

    // ------------------------------------------------------------------ findings and words
    $("facts").textContent = flights.map((flight) => `${flights.length > 1 ? `${flight.log}: ` : ""}positions `
      + `from ${flight.source}, ${flight.segment.map((t) => t.toFixed(1)).join(" s to ")} s`).join("; ");
    $("story").textContent = flights.length === 1 ? lone.story.join(" ") : "";
    for (const flight of flights) {
      if (flights.length > 1) $("found").append(make("h3", flight.log));
      if (!flight.findings.length) $("found").append(make("p", "None."));
      for (const finding of flight.findings) $("found").append(told(flight, finding));
    }
    function told(flight, finding) {
      const box = make("div"), line = make("p", undefined, { dir: "auto" });
      line.append(make("span", `${finding.severity}: `, { className: `severity ${finding.severity}` }), finding.message);
      box.append(line);
      if (finding.remedy) box.append(make("p", finding.remedy, { className: "note", dir: "auto" }));
      finding.spans.forEach(([low, high]) => {
        const text = high - low > 0.05 ? `${low.toFixed(1)} s to ${high.toFixed(1)} s` : `${low.toFixed(1)} s`;
        const button = make("button", `look at ${text}`, { type: "button", className: "jump" });
        button.addEventListener("click", () => {
          const around = Math.max(2, 0.3 * (high - low));
          view(low - flight.shift - around, high - flight.shift + around);
          document.querySelector(".plots").scrollIntoView({ block: "start" });
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
    return { strip, plan, step: stepOf, view, go };
  }

  return { places, start };
})();
