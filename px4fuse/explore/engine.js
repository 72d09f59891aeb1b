/* KF of px4fuse.filter.kalman in JavaScript, with the same results as px4fuse.replay: the same time
   steps, the same mean acceleration per step, the same Joseph update. */
"use strict";
const Engine = (() => {
  const SAME_TIME_S = 5e-7; // kalman.SAME_TIME_S
  const MIN_MEASUREMENTS = 3; // signals.MIN_MEASUREMENTS
  const MIN_COMMON_SAMPLES = 3; // projection.MIN_COMMON_SAMPLES
  const MIN_INNOVATIONS = 10; // consistency.MIN_INNOVATIONS

  /* numpy.interp for ascending x; `outside` replaces the end values beyond the range of xp */
  function interp(x, xp, fp, outside) {
    const n = xp.length, out = new Float64Array(x.length);
    let j = 0;
    for (let i = 0; i < x.length; i++) {
      const at = x[i];
      if (n === 0 || at < xp[0]) { out[i] = outside ?? fp[0] ?? 0; continue; }
      if (at > xp[n - 1]) { out[i] = outside ?? fp[n - 1]; continue; }
      while (j < n - 1 && xp[j + 1] <= at) j++;
      out[i] = j === n - 1 ? fp[j] : (fp[j + 1] - fp[j]) / (xp[j + 1] - xp[j]) * (at - xp[j]) + fp[j];
    }
    return out;
  }

  /* Mean acceleration of each step, and the fraction of the step within a gap (signals.step_means) */
  function stepMeans(imu, axis, edges) {
    const velocity = interp(edges, imu.time, axis.integral);
    const gap = interp(edges, imu.gapEdges, imu.gapSum);
    const n = edges.length - 1, mean = new Float64Array(n), gapFraction = new Float64Array(n);
    const low = imu.span[0], high = imu.span[1];
    const clip = (t) => Math.min(Math.max(t, low), high);
    for (let i = 0; i < n; i++) {
      const length = edges[i + 1] - edges[i];
      mean[i] = (velocity[i + 1] - velocity[i]) / length;
      const outside = 1 - (clip(edges[i + 1]) - clip(edges[i])) / length;
      gapFraction[i] = Math.min(Math.max((gap[i + 1] - gap[i]) / length + outside, 0), 1);
    }
    return { mean, gapFraction };
  }

  /* Measurements within the segment after the time offset correction */
  function measured(axis, segment, offset) {
    const time = [], z = [];
    for (let i = 0; i < axis.time.length; i++) {
      const t = axis.time[i] + offset;
      if (t >= segment[0] && t <= segment[1]) { time.push(t); z.push(axis.z[i]); }
    }
    return { time, z };
  }

  /* Time steps of the filter: grid of DT and measurement times (kalman.timeline) */
  function timeline(flight, axis, settings) {
    const { time: all, z } = measured(axis, flight.segment, settings.offset);
    if (all.length < MIN_MEASUREMENTS) return null;
    const first = all[0], times = [], index = [];
    for (let i = 1; i < all.length; i++) {
      if (all[i] <= first + SAME_TIME_S) continue;
      if (times.length && times[times.length - 1] === all[i]) { index[index.length - 1] = i; continue; }
      times.push(all[i]);
      index.push(i);
    }
    if (!times.length) return null;
    const m = times.length, last = times[m - 1];
    const count = Math.floor((last - first) / settings.dt + 1e-9) + 1;
    const time = new Float64Array(count + m + 1), at = new Int32Array(count + m + 1).fill(-1);
    let n = 0, j = 0;
    for (let k = 0; k < count; k++) {
      const t = first + settings.dt * k;
      while (j < m && times[j] < t) { at[n] = index[j]; time[n++] = times[j++]; }
      const near = Math.min(
        Math.abs(times[Math.min(j, m - 1)] - t), Math.abs(times[Math.max(j - 1, 0)] - t));
      if (near > SAME_TIME_S) time[n++] = t;
    }
    while (j < m) { at[n] = index[j]; time[n++] = times[j++]; }
    return { time: time.subarray(0, n), at: at.subarray(0, n), z, updates: m };
  }

  /* Mean acceleration of each step, and the additional variance in IMU gaps */
  function inputs(flight, axis, settings, line) {
    const n = line.time.length - 1;
    if (settings.input === "zero") {
      return { mean: new Float64Array(n), extra: new Float64Array(n) };
    }
    const { mean, gapFraction } = stepMeans(flight.imu, axis, line.time);
    const extra = new Float64Array(n);
    for (let from = 0; from < n;) { // from measurement to measurement: the unknown acceleration persists in a gap
      let to = from, gap = 0;
      do gap += gapFraction[to] * (line.time[to + 1] - line.time[to]); while (line.at[++to] < 0 && to < n);
      const persistence = Math.max(gap / settings.dt, 1);
      for (let i = from; i < to; i++) extra[i] = gapFraction[i] * persistence * axis.rms * axis.rms;
      from = to;
    }
    return { mean, extra };
  }

  /* Run the filter (px4fuse.replay); settings: sigmaA, sigmaZ, dt, input, offset */
  function replay(flight, axis, settings) {
    const line = timeline(flight, axis, settings);
    if (line === null) return null;
    const { mean, extra } = inputs(flight, axis, settings, line);
    const n = line.time.length, m = line.updates, R = settings.sigmaZ * settings.sigmaZ;
    const column = (length) => new Float64Array(length);
    const steps = {
      time: line.time, at: line.at, p: column(n), v: column(n), p00: column(n), p01: column(n),
      p11: column(n), prior00: column(n), prior11: column(n), acceleration: mean, extra,
    };
    const updates = {
      step: new Int32Array(m), time: column(m), z: column(m), nu: column(m), s: column(m),
      k0: column(m), k1: column(m), p: column(m), v: column(m), p00: column(m), p01: column(m),
      p11: column(m),
    };
    let p = line.z[0], v = 0, [p00, p01, p11] = flight.start, u = 0;
    const keep = (i) => {
      steps.p[i] = p; steps.v[i] = v; steps.p00[i] = p00; steps.p01[i] = p01; steps.p11[i] = p11;
    };
    keep(0);
    steps.prior00[0] = p00; steps.prior11[0] = p11;
    for (let i = 1; i < n; i++) {
      const dt = line.time[i] - line.time[i - 1], a = mean[i - 1];
      const q = (settings.sigmaA * settings.sigmaA + extra[i - 1]) * settings.dt;
      // x = Fx + Ba, P = FPFᵀ + Q
      p += v * dt + dt * dt / 2 * a;
      v += dt * a;
      p00 += 2 * dt * p01 + dt * dt * p11 + q * dt * dt * dt / 4;
      p01 += dt * p11 + q * dt * dt / 2;
      p11 += q * dt;
      steps.prior00[i] = p00; steps.prior11[i] = p11;
      if (line.at[i] >= 0) {
        // ν = z - Hx, S = HPHᵀ + R, K = PHᵀS⁻¹
        const z = line.z[line.at[i]], nu = z - p, s = p00 + R, k0 = p00 / s, k1 = p01 / s;
        updates.step[u] = i; updates.time[u] = line.time[i]; updates.z[u] = z;
        updates.nu[u] = nu; updates.s[u] = s; updates.k0[u] = k0; updates.k1[u] = k1;
        updates.p[u] = p; updates.v[u] = v;
        updates.p00[u] = p00; updates.p01[u] = p01; updates.p11[u] = p11;
        u++;
        // x = x + Kν, P = (I - KH)P(I - KH)ᵀ + KRKᵀ
        p += k0 * nu;
        v += k1 * nu;
        const rest = 1 - k0, a01 = p01 - k1 * p00;
        p11 = p11 - k1 * p01 - k1 * a01 + k1 * k1 * R;
        p01 = rest * a01 + k0 * k1 * R;
        p00 = rest * rest * p00 + k0 * k0 * R;
      }
      keep(i);
    }
    return { steps, updates, settings };
  }

  /* Position, velocity and position variance at other ascending times, NaN outside the run
     (kalman.state_at and variance_at) */
  function stateAt(run, times) {
    const { steps: s, settings } = run, { time, p, v, acceleration } = s, n = time.length;
    const position = new Float64Array(times.length), velocity = position.slice(), variance = position.slice();
    let j = 0;
    for (let i = 0; i < times.length; i++) {
      const t = times[i];
      if (t < time[0] || t > time[n - 1]) { position[i] = velocity[i] = variance[i] = NaN; continue; }
      while (j < n - 1 && time[j + 1] <= t) j++;
      const ahead = t - time[j], a = j < n - 1 ? acceleration[j] : 0;
      position[i] = p[j] + v[j] * ahead + a * ahead * ahead / 2;
      velocity[i] = v[j] + a * ahead;
      const q = (settings.sigmaA * settings.sigmaA + (s.extra[j] ?? 0)) * settings.dt;
      variance[i] = s.p00[j] + 2 * ahead * s.p01[j] + ahead * ahead * s.p11[j] + q * ahead ** 3 / 4;
    }
    return { p: position, v: velocity, p00: variance };
  }

  /* Statistics of innovations (consistency.assess); null for fewer than MIN_INNOVATIONS */
  function assess(nu, s) {
    let square = 0, outside = 0, product = 0, before = 0;
    const n = nu.length;
    if (n < MIN_INNOVATIONS) return null;
    for (let i = 0; i < n; i++) {
      const one = nu[i] / Math.sqrt(s[i]);
      square += one * one;
      if (Math.abs(one) > 2) outside++;
      if (i) product += one * before;
      before = one;
    }
    return { count: n, nis: square / n, outside: outside / n, lag1: product / square };
  }

  /* Root mean square difference of two series, null for fewer than MIN_COMMON_SAMPLES */
  function rmse(values, reference) {
    let square = 0, n = 0;
    for (let i = 0; i < values.length; i++) {
      const e = values[i] - reference[i];
      if (Number.isFinite(e)) { square += e * e; n++; }
    }
    return n < MIN_COMMON_SAMPLES ? null : Math.sqrt(square / n);
  }

  /* Decode the arrays of px4fuse.explore.packing */
  async function unpack(text, specs) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const all = new Uint8Array(await new Response(stream).arrayBuffer());
    let from = 0;
    return specs.map(([length, planes, scale]) => {
      const out = new Float64Array(length);
      let sum = 0;
      for (let i = 0; i < length; i++) {
        let code = 0;
        for (let b = planes - 1; b >= 0; b--) code = code * 256 + all[from + b * length + i];
        sum += code % 2 ? -(code + 1) / 2 : code / 2;
        out[i] = sum / scale;
      }
      from += length * planes;
      return out;
    });
  }

  return { interp, replay, stateAt, assess, rmse, unpack };
})();
