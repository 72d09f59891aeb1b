/* Seven stations on this very flight: each sets the knobs, says in its numbers what is to be seen,
   and asks for one thing. The knobs are given back at the end. */
const Tour = (() => {
  const { numberWords: number, lengthWords: length } = Story;

  /* Each gives title, sentence, task, what to see, and what to set; the flight's own numbers */
  const STATIONS = [
    ({ base, tried }) => {
      const sigmaA = 0.002, one = tried({ ...base, sigmaA });
      return { title: "Q forgotten", set: { ...base, sigmaA }, view: "sigma_p",
        sentence: `SIGMA_A is now ${sigmaA} m/s²: the filter holds its acceleration for exact, so that σ of position `
          + `falls to ${length(one.sigma)} and the mean NIS goes from ${number(tried(base).nis, 2)} to ${number(one.nis, 2)}.`,
        task: "Drag SIGMA_A up until the needle stands in its band.",
        see: "σ grows again between two measurements, and the innovations come back into ±2√S." };
    },
    ({ base, tried }) => {
      const by = [10, 30, 100].find((d) => tried({ ...base, sigmaZ: tidy(base.sigmaZ / d) }).outside > 0.1) ?? 100;
      const sigmaZ = tidy(base.sigmaZ / by), one = tried({ ...base, sigmaZ });
      return { title: "R too small", set: { ...base, sigmaZ }, view: "innovation",
        sentence: `SIGMA_Z is now ${sigmaZ} m, ${by} times too small: the filter believes each position, and ${number(100 * one.outside, 2)} % `
          + "of its innovations lie outside ±2√S, where 5 % is right.",
        task: "Drag SIGMA_Z up until about one innovation in twenty lies outside.",
        see: "The band widens around the dots, and the track gets smoother." };
    },
    ({ base, tried }) => {
      const both = { ...base, sigmaA: tidy(3 * base.sigmaA), sigmaZ: tidy(3 * base.sigmaZ) };
      const alone = { ...base, sigmaA: tidy(3 * base.sigmaA) };
      return { title: "The ratio is the track", set: both, view: "position",
        sentence: `SIGMA_A and SIGMA_Z are both three times as large: the position moved by ${length(tried(both).from(tried(base)))} `
          + `(RMS). SIGMA_A alone would move it by ${length(tried(alone).from(tried(base)))}.`,
        task: "Turn only one of them back.",
        see: "The track changes with the ratio of the two, hardly with their size." };
    },
    ({ base, tried }) => {
      const both = { ...base, sigmaA: tidy(3 * base.sigmaA), sigmaZ: tidy(3 * base.sigmaZ) };
      const [before, now] = [tried(base), tried(both)];
      return { title: "Size is the claim", set: both, view: "sigma_p",
        sentence: `The same track, another claim: σ of position went from ${length(before.sigma)} to ${length(now.sigma)}, and the `
          + `mean NIS from ${number(before.nis, 2)} to ${number(now.nis, 2)}, a ninth.`,
        task: "Make both smaller, in the same ratio, until the needle stands in its band.",
        see: "What a filter claims is checked by its innovations, not by how smooth it looks." };
    },
    ({ base, tried, why, offsets }) => {
      if (why) {
        return { title: "Clocks", set: base, view: "innovation",
          sentence: `The stamps of this flight cannot be moved here: ${why}.`,
          task: "Go on.", see: "px4fuse sync measures a clock offset from a log." };
      }
      const wrong = Math.min(base.offset + 0.2, offsets[1]), late = { ...base, offset: wrong };
      const [before, now] = [tried(base), tried(late)];
      const seen = now.nis / before.nis > 1.1, truth = now.truthP && now.truthP > 1.1 * before.truthP;
      return { title: "Clocks", set: late, view: truth ? "error" : "innovation",
        sentence: `The stamps are now ${number(wrong - base.offset, 2)} s later: the mean NIS goes from ${number(before.nis, 2)} to `
          + `${number(now.nis, 2)}${seen ? "" : ", so the innovations hardly tell"}; `
          + (truth ? `the error against the truth goes from ${length(before.truthP)} to ${length(now.truthP)}.`
            : `the position moves by ${length(now.from(before))} (RMS).`),
        task: truth ? "Drag the clock offset to where the error is smallest."
          : "Drag the clock offset to where the innovations are smallest.",
        see: "The error follows the speed: nothing while the vehicle stands, most where it is fast. That is the mark of a clock." };
    },
    ({ base, tried, worst }) => {
      const one = tried(base);
      return { title: "Outliers", set: base, view: "innovation", step: worst.step,
        sentence: `The largest innovation is ${number(worst.sigmas, 2)} √S, at ${worst.at.toFixed(1)} s; ${number(100 * one.outside, 2)} % `
          + "lie outside ±2√S.",
        task: "Press space to step through the filter there, and look at the gain.",
        see: "The gain does not ask how large the innovation is: without a gate the filter follows an outlier." };
    },
    ({ base, tried, axis, ekf2 }) => {
      const ours = tried(base);
      if (ekf2.nis === undefined) {
        return { title: "EKF2 beside you", set: base, view: "position",
          sentence: `EKF2 cannot be judged on this flight: ${ekf2.why || "its innovations are not logged"}.`,
          task: "Go on.", see: "docs: what must be logged for it." };
      }
      return { title: "EKF2 beside you", set: base, view: "sigma_p",
        sentence: `EKF2's mean NIS is ${number(ekf2.nis, 2)}, ours ${number(ours.nis, 2)}`
          + (ekf2.truthP && ours.truthP ? `; it is ${length(ekf2.truthP)} from the truth, ours ${length(ours.truthP)}` : "")
          + (axis.ekf2.r ? `. It gives each position a σ of ${number(axis.ekf2.r, 2)} m.` : "."),
        task: axis.ekf2.r ? "Press EKF2's R, then turn SIGMA_A until both σ lie on each other."
          : "Turn SIGMA_A until both σ lie on each other.",
        see: "EKF2 is the same filter with more states: with the same R and a like Q it says the same." };
    },
  ];
  const tidy = (x) => Number(x.toPrecision(2));

  function start(page) {
    const { settings, set, open, result, flight, numbers, chosen, stepper, axisNow, mapNow } = page;
    const box = $("tour");
    let at = null, before = null;

    /* What the stations start from: the most likely noises where they are known, else the report's */
    function facts() {
      const axis = axisNow(), found = mapNow(), likely = typeof found === "string" ? [null, null] : found.likely;
      const own = flight.settings, base = { sigmaA: tidy(likely[0] ?? own.sigmaA), sigmaZ: tidy(likely[1] ?? own.sigmaZ),
        dt: own.dt, input: own.input, offset: Number((flight.offset.likely ?? own.offset).toFixed(3)) };
      if (flight.offset.why) base.offset = own.offset;
      const tried = (changes) => {
        const run = Engine.replay(flight, axis, { ...settings, ...changes }), p = run.updates.p00;
        return { ...numbers(axis, run), run, sigma: Math.sqrt(p.toSorted()[p.length >> 1]),
          from: (other) => {
            const { time } = run.steps, from = time.length >> 3; // settled
            return Engine.rmse(run.steps.p.subarray(from), Engine.stateAt(other.run, time).p.subarray(from)) ?? 0;
          } };
      };
      const { updates } = tried(base).run;
      let step = 0;
      updates.nu.forEach((nu, i) => { if (nu * nu / updates.s[i] > updates.nu[step] ** 2 / updates.s[step]) step = i; });
      const worst = { step, sigmas: Math.abs(updates.nu[step]) / Math.sqrt(updates.s[step]), at: updates.time[step] };
      return { base, tried, axis, worst, why: flight.offset.why, offsets: [flight.offset.from, flight.offset.to],
        ekf2: page.ekf2Of(axis) };
    }
    function go(to) {
      if (before === null) before = { settings: { ...settings }, view: page.view(), step: chosen.step };
      at = to;
      const { title, sentence, task, see, set: values, view, step } = STATIONS[at](facts());
      $("tour-title").textContent = `${at + 1} of ${STATIONS.length}: ${title}`;
      $("tour-sentence").textContent = sentence;
      $("tour-task").textContent = `Do: ${task}`;
      $("tour-see").textContent = `See: ${see}`;
      $("tour-back").disabled = at === 0;
      $("tour-next").textContent = at === STATIONS.length - 1 ? "Finish" : "Next";
      box.hidden = false;
      open(view);
      set(values);
      if (step !== undefined) stepper.go(step);
      $("tour-title").focus({ preventScroll: true });
    }
    function end() {
      box.hidden = true;
      at = null;
      chosen.step = before.step;
      open(before.view);
      set(before.settings);
      before = null;
      $("tour-start").focus();
    }
    $("tour-start").hidden = result.run === null;
    $("tour-start").addEventListener("click", () => go(0));
    $("tour-back").addEventListener("click", () => go(at - 1));
    $("tour-next").addEventListener("click", () => at === STATIONS.length - 1 ? end() : go(at + 1));
    $("tour-end").addEventListener("click", end);
    box.addEventListener("keydown", (event) => { if (event.key === "Escape") end(); });
  }

  return { start, count: STATIONS.length };
})();
