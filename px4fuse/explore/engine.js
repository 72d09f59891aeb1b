// KF of px4fuse.filter.kalman in JavaScript, with the same results as px4fuse.replay: the same time
// steps, the same mean acceleration per step, the same P = (I - KH)P.
"use strict";
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
/* Response with the decompressed bytes of a base64 text */
const inflate = (text) => new Response(new Blob([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))])
  .stream().pipeThrough(new DecompressionStream("deflate")));
const Engine = (() => {
  // steps.MAX_SAME_TIME_S, signals.MIN_MEASUREMENTS, projection.MIN_COMPARED_SAMPLES, consistency.MIN_INNOVATIONS
  const SAME_TIME_S = 5e-7, MIN_MEASUREMENTS = 3, MIN_COMPARED_SAMPLES = 3, MIN_INNOVATIONS = 10;

  /* numpy.interp for ascending x; `outside` replaces the end values beyond the range of xp */
  function interp(x, xp, fp, outside) {
    const n = xp.length, out = new Float64Array(x.length);
    let j = 0;
    for (let i = 0; i < x.length; i++) {
      const position = x[i];
      if (n === 0 || position < xp[0]) { out[i] = outside ?? fp[0] ?? 0; continue; }
      if (position > xp[n - 1]) { out[i] = outside ?? fp[n - 1]; continue; }
      while (j < n - 1 && xp[j + 1] <= position) j++;
      out[i] = j === n - 1 ? fp[j] : (fp[j + 1] - fp[j]) / (xp[j + 1] - xp[j]) * (position - xp[j]) + fp[j];
    }
    return out;
  }

  /* Mean acceleration of each step, and the fraction of the step within a gap (signals.compute_mean_step_acceleration) */
  function stepMeans(imu, axis, edges) {
    const velocity = interp(edges, imu.time, axis.integral);
    const gap = interp(edges, imu.gapEdges, imu.gapSum);
    const n = edges.length - 1, mean = new Float64Array(n), gapFraction = mean.slice();
    const clip = (t) => clamp(t, imu.time[0], imu.time.at(-1));
    for (let i = 0; i < n; i++) {
      const length = edges[i + 1] - edges[i];
      mean[i] = (velocity[i + 1] - velocity[i]) / length;
      const outside = 1 - (clip(edges[i + 1]) - clip(edges[i])) / length;
      gapFraction[i] = clamp((gap[i + 1] - gap[i]) / length + outside, 0, 1);
    }
    return { mean, gapFraction };
  }

  /* Time steps of KF: grid of DT and measurement times (steps.make_prediction_steps) */
  function timeline(flight, axis, settings) {
    // measurements (s, m) in the analysed segment, after the correction of their time offset
    const all = [], z = [], [start, end] = flight.segment;
    for (let i = 0; i < axis.time.length; i++) {
      const t = axis.time[i] + settings.clock_offset_s;
      if (t >= start && t <= end) { all.push(t); z.push(axis.z[i]); }
    }
    if (all.length < MIN_MEASUREMENTS) return null;
    // of several measurements at the same time, the last is used
    const first = all[0], updates = [];
    for (let i = 1; i < all.length; i++) {
      if (all[i] <= first + SAME_TIME_S) continue;
      if (updates.at(-1)?.t === all[i]) updates.pop();
      updates.push({ t: all[i], measurement: i });
    }
    if (!updates.length) return null;
    const count = Math.floor((updates.at(-1).t - first) / settings.dt_s + 1e-9) + 1;
    const grid = Array.from({ length: count }, (_, k) => ({ t: first + settings.dt_s * k, measurement: -1 }));
    const rows = [...updates, ...grid].sort((a, b) => a.t - b.t);
    // a time of the grid is omitted if a measurement has the same time
    const isUpdateAt = (t, row) => row?.measurement >= 0 && Math.abs(row.t - t) <= SAME_TIME_S;
    const steps = rows.filter(({ t, measurement }, k) =>
      measurement >= 0 || !isUpdateAt(t, rows[k - 1]) && !isUpdateAt(t, rows[k + 1]));
    return {
      time: Float64Array.from(steps.map(({ t }) => t)), measurement: steps.map(({ measurement }) => measurement),
      z, updates: updates.length };
  }

  /* Mean acceleration (m/s²) of each KF step, and its additional variance in IMU gaps */
  function inputs(flight, axis, settings, line) {
    const n = line.time.length - 1, extra = new Float64Array(n);
    if (settings.input === "zero") return { mean: extra, extra };
    const { mean, gapFraction } = stepMeans(flight.imu, axis, line.time);
    // one interval between measurements: the unknown acceleration is constant in a gap
    for (let from = 0; from < n;) {
      let to = from, gap = 0;
      do gap += gapFraction[to] * (line.time[to + 1] - line.time[to]); while (line.measurement[++to] < 0 && to < n);
      const persistence = Math.max(gap / settings.dt_s, 1);
      for (let i = from; i < to; i++) extra[i] = gapFraction[i] * persistence * axis.rms ** 2;
      from = to;
    }
    return { mean, extra };
  }

  /* Set row i of all columns */
  const write = (columns, i, values) => { for (const name in values) columns[name][i] = values[name]; };
  const processNoise = (settings, extra) => (settings.sigma_a_m_s2 * settings.sigma_a_m_s2 + extra) * settings.dt_s;
  /* Run KF (px4fuse.replay); `settings` has the fields of px4fuse.Settings */
  function replay(flight, axis, settings) {
    const line = timeline(flight, axis, settings);
    if (line === null) return null;
    const { mean, extra } = inputs(flight, axis, settings, line);
    const n = line.time.length, m = line.updates, R = settings.sigma_z_m * settings.sigma_z_m;
    const columns = (names, length) => Object.fromEntries(names.split(" ").map((name) => [name, new Float64Array(length)]));
    const steps = { time: line.time, ...columns("p v p00 p01 p11", n), acceleration: mean, extra };
    // of each update: index in `steps`, time, z, ν, S, gain K, and the state p, v and P before the update
    const updates = columns("step time z nu s k0 k1 p v p00 p01 p11", m);
    let p = line.z[0], v = 0, [p00, p01, p11] = flight.start, u = 0;
    write(steps, 0, { p, v, p00, p01, p11 });
    for (let i = 1; i < n; i++) {
      const dt = line.time[i] - line.time[i - 1], a = mean[i - 1];
      const q = processNoise(settings, extra[i - 1]);
      // x = Fx + Ba, P = FPFᵀ + Q
      p += v * dt + dt * dt / 2 * a;
      v += dt * a;
      p00 += 2 * dt * p01 + dt * dt * p11 + q * dt * dt * dt / 4;
      p01 += dt * p11 + q * dt * dt / 2;
      p11 += q * dt;
      if (line.measurement[i] >= 0) {
        // ν = z - Hx, S = HPHᵀ + R, K = PHᵀS⁻¹
        const z = line.z[line.measurement[i]], nu = z - p, s = p00 + R, k0 = p00 / s, k1 = p01 / s;
        write(updates, u++, { step: i, time: line.time[i], z, nu, s, k0, k1, p, v, p00, p01, p11 });
        // x = x + Kν, P = (I - KH)P(I - KH)ᵀ + KRKᵀ
        p += k0 * nu;
        v += k1 * nu;
        const rest = 1 - k0, a01 = p01 - k1 * p00;
        p11 = p11 - k1 * p01 - k1 * a01 + k1 * k1 * R;
        p01 = rest * a01 + k0 * k1 * R;
        p00 = rest * rest * p00 + k0 * k0 * R;
      }
      write(steps, i, { p, v, p00, p01, p11 });
    }
    return { steps, updates, settings };
  }

  // Position and its variance at other ascending times, NaN outside the KF run
  // (kalman.predict_track)
  function stateAt(run, times) {
    const { steps: s, settings } = run, { time, p, v, acceleration } = s, n = time.length;
    const position = new Float64Array(times.length).fill(NaN), variance = position.slice();
    let j = 0;
    for (let i = 0; i < times.length; i++) {
      const t = times[i];
      if (t < time[0] || t > time[n - 1]) continue;
      while (j < n - 1 && time[j + 1] <= t) j++;
      const ahead = t - time[j], q = processNoise(settings, s.extra[j] ?? 0);
      position[i] = p[j] + v[j] * ahead + (acceleration[j] ?? 0) * ahead * ahead / 2;
      variance[i] = s.p00[j] + 2 * ahead * s.p01[j] + ahead * ahead * s.p11[j] + q * ahead ** 3 / 4;
    }
    return { p: position, p00: variance };
  }

  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  /* Statistics of innovations (consistency.assess_innovations); none for fewer than MIN_INNOVATIONS */
  function assess(nu, s) {
    if (nu.length < MIN_INNOVATIONS) return {};
    const normalised = nu.map((innovation, i) => innovation / Math.sqrt(s[i]));
    return { count: nu.length, nis: mean(normalised.map((x) => x * x)), outside: mean(normalised.map((x) => Math.abs(x) > 2)) };
  }

  /* Root mean square difference of two series, null for fewer than MIN_COMPARED_SAMPLES */
  function rmse(values, reference) {
    const squares = Array.from(values, (value, i) => (value - reference[i]) ** 2).filter(Number.isFinite);
    return squares.length < MIN_COMPARED_SAMPLES ? null : Math.sqrt(mean(squares));
  }

  /* Decode the arrays of px4fuse.explore.data */
  async function unpack(text) {
    const arrays = await inflate(text).json();
    return arrays.map(([scale, differences]) => {
      let sum = 0;
      return Float64Array.from(differences, (difference) => (sum += difference) / scale);
    });
  }

  return { interp, replay, processNoise, stateAt, assess, rmse, unpack };
})();
