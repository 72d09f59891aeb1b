/* Tour of seven stations on this flight. Each station changes the settings, describes the effect with
   the flight's numbers, and gives one task. The end of the tour restores the previous settings. */
const Tour = (() => {
  const { formatRatio: ratio, formatMetres: length } = Card;
  const number = (x, digits) => String(Number(x.toPrecision(digits)));
  const change = (before, now) => `innovation ÷ √S changes from ${ratio(before.source)} to ${ratio(now.source)}`;

  /* Each station returns title, sentence, task, observation, settings and view */
  const STATIONS = [
    ({ base, rerun }) => {
      const sigmaA = 0.002, run = rerun({ ...base, sigmaA });
      return { title: "Q almost zero", set: { ...base, sigmaA }, view: "sigma_p",
        sentence: `SIGMA_A is now ${sigmaA} m/s². The filter treats the acceleration as exact. σ of position falls to `
          + `${length(run.sigma)}, and ${change(rerun(base), run)}.`,
        task: "Increase SIGMA_A until both marks of KF are in the green band.",
        see: "σ grows again between two measurements, and the innovations return into ±2√S." };
    },
    ({ base, rerun }) => {
      const divisor = [10, 30, 100].find((d) => rerun({ ...base, sigmaZ: roundTo2Digits(base.sigmaZ / d) }).outside > 0.1) ?? 100;
      const sigmaZ = roundTo2Digits(base.sigmaZ / divisor), run = rerun({ ...base, sigmaZ });
      return { title: "R too small", set: { ...base, sigmaZ }, view: "innovation",
        sentence: `SIGMA_Z is now ${sigmaZ} m, ${divisor} times too small. ${number(100 * run.outside, 2)} % of the innovations `
          + "are outside ±2√S (expected 5 %).",
        task: "Increase SIGMA_Z until about 5 % of the innovations are outside.",
        see: "The dots return into the band, and the track becomes smoother." };
    },
    ({ base, rerun }) => {
      const both = { ...base, sigmaA: roundTo2Digits(3 * base.sigmaA), sigmaZ: roundTo2Digits(3 * base.sigmaZ) };
      const alone = { ...base, sigmaA: roundTo2Digits(3 * base.sigmaA) };
      return { title: "The ratio determines the track", set: both, view: "position",
        sentence: `SIGMA_A and SIGMA_Z are both three times larger. The position changes by ${length(rerun(both).rmsDifference(rerun(base)))} `
          + `RMS. With a larger SIGMA_A alone it would change by ${length(rerun(alone).rmsDifference(rerun(base)))} RMS.`,
        task: "Set one of them back to its previous value.",
        see: "The track depends on the ratio SIGMA_A / SIGMA_Z, hardly on their common scale." };
    },
    ({ base, rerun }) => {
      const both = { ...base, sigmaA: roundTo2Digits(3 * base.sigmaA), sigmaZ: roundTo2Digits(3 * base.sigmaZ) };
      const [before, now] = [rerun(base), rerun(both)];
      return { title: "The scale determines σ", set: both, view: "sigma_p",
        sentence: `The track is the same, but σ of position changed from ${length(before.sigma)} to ${length(now.sigma)}, and `
          + `innovation ÷ √S from ${ratio(before.source)} to ${ratio(now.source)} (one third).`,
        task: "Decrease both in the same ratio until the marks are in the green band.",
        see: "Check the reported σ with the innovations, not by the smoothness of the track." };
    },
    ({ base, rerun, why, offsets }) => {
      if (why) {
        return { title: "Time offset", set: base, view: "innovation",
          sentence: `The time offset of this flight is fixed: ${why}.`,
          task: "Continue.", see: "px4fuse sync estimates the time offset of a log." };
      }
      const lateOffset = Math.min(base.offset + 0.2, offsets[1]), late = { ...base, offset: lateOffset };
      const [before, now] = [rerun(base), rerun(late)];
      const truth = now.truthP && now.truthP > 1.1 * before.truthP;
      return { title: "Time offset", set: late, view: truth ? "error" : "innovation",
        sentence: `The timestamps are now ${number(lateOffset - base.offset, 2)} s later: ${change(before, now)}. `
          + (truth ? `The position RMSE changes from ${length(before.truthP)} to ${length(now.truthP)}.`
            : `The position changes by ${length(now.rmsDifference(before))} RMS.`),
        task: `Move the time offset to the smallest ${truth ? "error" : "innovations"}.`,
        see: "The error is proportional to speed: zero at rest, largest at high speed. This is typical of a time offset." };
    },
    ({ base, rerun, worst }) => {
      const run = rerun(base);
      return { title: "Outliers", set: base, view: "innovation", step: worst.step,
        sentence: `The largest innovation is ${number(worst.sigmas, 2)} √S, at ${worst.at.toFixed(1)} s. ${number(100 * run.outside, 2)} % `
          + "of the innovations are outside ±2√S (expected 5 %).",
        task: "Press space to step through the filter at this time, and check the gain.",
        see: "The gain does not depend on the innovation: without a gate the filter follows an outlier." };
    },
    ({ base, rerun, axis, ekf2 }) => {
      const kf = rerun(base);
      if (!ekf2.source) {
        return { title: "Comparison with EKF2", set: base, view: "position",
          sentence: `EKF2 cannot be tested on this flight: ${ekf2.why || "its innovations are not logged"}.`,
          task: "Continue.", see: "The documentation lists the topics to log." };
      }
      return { title: "Comparison with EKF2", set: base, view: "sigma_p",
        sentence: `Innovation ÷ √S: EKF2 ${ratio(ekf2.source)}, KF ${ratio(kf.source)}.`
          + (ekf2.truthP && kf.truthP ? ` Position RMSE: EKF2 ${length(ekf2.truthP)}, KF ${length(kf.truthP)}.` : "")
          + (axis.ekf2.r ? ` EKF2 assumes a measurement σ of ${number(axis.ekf2.r, 2)} m.` : ""),
        task: axis.ekf2.r ? "Press R of EKF2, then change SIGMA_A until both σ coincide."
          : "Change SIGMA_A until both σ coincide.",
        see: "With the same R and a similar Q, EKF2 reports a similar σ." };
    },
  ];
  const roundTo2Digits = (x) => Number(x.toPrecision(2));

  function start(page) {
    const { settings, set, open, result, flight, numbers, chosen, stepper, axisNow, mapNow } = page;
    const box = $("tour"), starters = [...document.querySelectorAll(".tour-start")];
    let at = null, before = null;

    /* Initial settings of all stations: maximum-likelihood estimates if known, else those of the report */
    function facts() {
      const axis = axisNow(), found = mapNow(), likely = typeof found === "string" ? [null, null] : found.likely;
      const own = flight.settings, base = { sigmaA: roundTo2Digits(likely[0] ?? own.sigmaA), sigmaZ: roundTo2Digits(likely[1] ?? own.sigmaZ),
        dt: own.dt, input: own.input, offset: Number((flight.offset.likely ?? own.offset).toFixed(3)) };
      if (flight.offset.why) base.offset = own.offset;
      const rerun = (changes) => {
        const run = Engine.replay(flight, axis, { ...settings, ...changes }), p = run.updates.p00;
        return { ...numbers(axis, run), run, sigma: Math.sqrt(p.toSorted()[p.length >> 1]),
          rmsDifference: (other) => {
            const { time } = run.steps, from = time.length >> 3; // without the initial transient
            return Engine.rmse(run.steps.p.subarray(from), Engine.stateAt(other.run, time).p.subarray(from)) ?? 0;
          } };
      };
      const { updates } = rerun(base).run;
      let step = 0;
      updates.nu.forEach((nu, i) => { if (nu * nu / updates.s[i] > updates.nu[step] ** 2 / updates.s[step]) step = i; });
      const worst = { step, sigmas: Math.abs(updates.nu[step]) / Math.sqrt(updates.s[step]), at: updates.time[step] };
      return { base, rerun, axis, worst, why: flight.offset.why, offsets: [flight.offset.from, flight.offset.to],
        ekf2: page.ekf2Of(axis) };
    }
    function go(to) {
      if (before === null) before = { settings: { ...settings }, view: page.view(), step: chosen.step };
      at = to;
      const { title, sentence, task, see, set: values, view, step } = STATIONS[at](facts());
      $("tour-title").textContent = `${at + 1} of ${STATIONS.length}: ${title}`;
      $("tour-sentence").textContent = sentence;
      $("tour-task").textContent = `Task: ${task}`;
      $("tour-see").textContent = `Result: ${see}`;
      $("tour-back").disabled = at === 0;
      $("tour-next").textContent = at === STATIONS.length - 1 ? "Finish" : "Next";
      box.hidden = false;
      document.body.classList.add("touring");
      open(view);
      set(values);
      if (step !== undefined) stepper.go(step);
      $("tour-title").focus({ preventScroll: true });
      // on a phone the sheet covers the lower half
      if (matchMedia("(max-width: 60rem)").matches) document.querySelector("#card figure").scrollIntoView();
    }
    function end() {
      box.hidden = true;
      document.body.classList.remove("touring");
      at = null;
      chosen.step = before.step;
      open(before.view);
      set(before.settings);
      before = null;
      starters.find((one) => one.checkVisibility())?.focus();
    }
    for (const one of starters) {
      one.hidden = result.run === null;
      one.addEventListener("click", () => go(0));
    }
    $("tour-back").addEventListener("click", () => go(at - 1));
    $("tour-next").addEventListener("click", () => at === STATIONS.length - 1 ? end() : go(at + 1));
    $("tour-end").addEventListener("click", end);
    box.addEventListener("keydown", (event) => { if (event.key === "Escape") end(); });
  }

  return { start, count: STATIONS.length };
})();
