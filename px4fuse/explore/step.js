// Step-by-step view: KF's prediction to a measurement and its update, as 2σ ellipses in the phase plane
// and as the equations of the course UAT 366, module 2, with numbers.
const Step = (() => {
  const CORNERS = 120;

  /* Points of the 2σ ellipse of a state, from the Cholesky factor of P */
  function ellipse({ p, v, p00, p01, p11 }) {
    const a = Math.sqrt(p00), b = p01 / a, c = Math.sqrt(Math.max(p11 - b * b, 0));
    const out = { p: new Float64Array(CORNERS + 1), v: new Float64Array(CORNERS + 1) };
    for (let i = 0; i <= CORNERS; i++) {
      const turn = 2 * Math.PI * (i % CORNERS) / CORNERS, x = 2 * Math.cos(turn), y = 2 * Math.sin(turn);
      out.p[i] = p + a * x;
      out.v[i] = v + b * x + c * y;
    }
    return out;
  }

  const rowOf = (columns, i) => Object.fromEntries(Object.entries(columns).map(([name, values]) => [name, values[i]]));
  const format = (x, digits = 4) => Math.abs(x) >= 1e-4 || x === 0 ? x.toFixed(digits) : x.toExponential(2);
  const matrix = (a, b, d) => `[${format(a, 5)}  ${format(b, 5)}; ${format(b, 5)}  ${format(d, 5)}]`;
  const covariance = ({ p00, p01, p11 }) => matrix(p00, p01, p11);
  const vector = ({ p, v }) => `[${format(p)} m, ${format(v)} m/s]`;
  const trend = (before, now) => now > before ? "increases" : now < before ? "decreases" : "stays equal";
  const sigma = (before, now) =>
    `σ_p ${trend(before.p00, now.p00)}: ${format(Math.sqrt(before.p00))} to ${format(Math.sqrt(now.p00))} m`;

  /* States before the prediction to a measurement, before its update, and after its update */
  function states({ steps, updates }, measurement) {
    const i = updates.step[measurement];
    return [rowOf(steps, i - 1), rowOf(updates, measurement), rowOf(steps, i)];
  }

  /* Equations of a prediction and update with numbers: rows [title, text] */
  function equations(run, measurement) {
    const [previous, prior, posterior] = states(run, measurement), { settings } = run;
    const { z, nu, s, k0, k1 } = prior, dt = posterior.time - previous.time;
    const q = Engine.processNoise(settings, previous.extra);
    return [
      ["Previous state", `x⁺ = ${vector(previous)}`],
      ["", `P⁺ = ${covariance(previous)}`],
      ["Prediction", `F = [1  ${format(dt)}; 0  1], B = [${format(dt * dt / 2, 5)}; ${format(dt)}], a = ${format(previous.acceleration, 3)} m/s²`],
      ["", `Q = ${matrix(q * dt ** 3 / 4, q * dt * dt / 2, q * dt)}`],
      ["", `x⁻ = Fx⁺ + Ba = ${vector(prior)}`],
      ["", `P⁻ = FP⁺Fᵀ + Q = ${covariance(prior)}`],
      ["", sigma(previous, prior)],
      ["Measurement", `z = ${format(z)} m, R = SIGMA_Z² = ${format(settings.sigma_z_m ** 2, 5)} m²`],
      ["Innovation", `ν = z − Hx⁻ = ${format(nu)} m`],
      ["", `S = HP⁻Hᵀ + R = ${format(s, 5)} m²; ν²/S = ${format(nu ** 2 / s, 2)}`],
      ["Gain", `K = P⁻Hᵀ/S = [${format(k0)}, ${format(k1)} 1/s]`],
      ["Update", `x⁺ = x⁻ + Kν = ${vector(posterior)}`],
      ["", `P⁺ = (I − KH)P⁻ = ${covariance(posterior)}`],
      ["", sigma(prior, posterior)],
    ];
  }

  /* Draw the ellipses before and after an update, and list its equations; `model` finds a part of the plot by its name */
  function draw(run, measurement, model) {
    const [, prior, posterior] = states(run, measurement), { p, v } = posterior, plot = model("step");
    model("before-source").data = ellipse(prior);
    model("now-source").data = ellipse(posterior);
    model("mean-source").data = { p: [p], v: [v] };
    const [band, line] = ["band", "measurement"].map((name) => plot.center.find((item) => item.name === name));
    const reach = 2 * run.settings.sigma_z_m;
    [band.left, band.right] = [prior.z - reach, prior.z + reach];
    line.location = prior.z;
    // the same scale for the whole run shows changes of the ellipse; only the first ellipses are larger
    const axisReach = (name) => Math.sqrt(Math.max(
      8 * run.updates[name].toSorted()[Math.floor(0.9 * run.updates[name].length)], 5 * posterior[name]));
    const [reachP, reachV] = [axisReach("p00"), axisReach("p11")];
    plot.x_range.setv({ start: p - reachP, end: p + reachP });
    plot.y_range.setv({ start: v - reachV, end: v + reachV });
    const table = make("table");
    for (const [title, text] of equations(run, measurement)) {
      table.insertRow().append(make("th", title, { scope: "row" }), make("td", text));
    }
    $("numbers").replaceChildren(table);
  }

  return { draw, ellipse, states };
})();
