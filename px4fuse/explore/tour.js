/* Tour of seven stations on this flight. Each station changes the settings, describes the effect with
   the flight's numbers, and gives one task. The end of the tour restores the previous settings. */
const Tour = (() => {
  const { formatRatio: ratio, formatMetres: length } = Card;
  const roundTo2Digits = (x) => Number(x.toPrecision(2));
  const percent = (fraction) => `${roundTo2Digits(100 * fraction)} %`;
  const change = (before, now) => `the RMS of innovation ÷ √S changes from ${ratio(before.source)} to ${ratio(now.source)}`;

  /* Texts, settings (`set`, by default the initial ones of the tour) and view of each station */
  const STATIONS = [
    ({ base, rerun }) => {
      const set = { ...base, sigmaA: 0.002 }, run = rerun(set);
      return { title: "Q almost zero", set, view: "sigma_p",
        sentence: `SIGMA_A is now ${set.sigmaA} m/s². KF treats the acceleration as exact. σ of position falls to ${length(run.sigma)}, and ${change(rerun(base), run)}.`,
        task: "Increase SIGMA_A until both marks of KF are in the green band.",
        see: "σ grows again between two measurements, and the innovations return into ±2√S." };
    },
    ({ base, rerun }) => {
      const divided = (divisor) => ({ ...base, sigmaZ: roundTo2Digits(base.sigmaZ / divisor) });
      const divisor = [10, 30].find((d) => rerun(divided(d)).outside > 0.1) ?? 100, set = divided(divisor);
      return { title: "R too small", set, view: "innovation",
        sentence: `SIGMA_Z is now ${set.sigmaZ} m, ${divisor} times too small. ${percent(rerun(set).outside)} of the innovations are outside ±2√S (expected 5 %).`,
        task: "Increase SIGMA_Z until about 5 % of the innovations are outside.",
        see: "The dots return into the band, and the estimated position becomes smoother." };
    },
    ({ base, rerun, triple }) => {
      const difference = (settings) => length(rerun(settings).rmsDifference(rerun(base)));
      return { title: "The ratio determines the track", set: triple, view: "position",
        sentence: `SIGMA_A and SIGMA_Z are both three times larger. The position of KF changes by ${difference(triple)} RMS. With a larger SIGMA_A alone it would change by ${difference({ ...triple, sigmaZ: base.sigmaZ })} RMS.`,
        task: "Set SIGMA_A or SIGMA_Z back to its previous value.",
        see: "The position depends on the ratio SIGMA_A / SIGMA_Z, hardly on their common scale." };
    },
    ({ base, rerun, triple }) => {
      const [before, now] = [base, triple].map(rerun);
      return { title: "The scale determines σ", set: triple, view: "sigma_p",
        sentence: `The position is the same, but σ of position changed from ${length(before.sigma)} to ${length(now.sigma)}, and ${change(before, now)}: one third.`,
        task: "Decrease SIGMA_A and SIGMA_Z in the same ratio until the marks are in the green band.",
        see: "Check the reported σ with the innovations, not by the smoothness of the position." };
    },
    ({ base, rerun, offset }) => {
      if (offset.why) {
        return { title: "Time offset", view: "innovation",
          sentence: `The time offset of this flight is fixed: ${offset.why}.`,
          task: "Continue.", see: "`px4fuse sync` estimates the time offset of a log." };
      }
      const set = { ...base, offset: Math.min(base.offset + 0.2, offset.to) }, [before, now] = [base, set].map(rerun);
      const hasTruth = now.truthP > 1.1 * before.truthP;
      return { title: "Time offset", set, view: hasTruth ? "error" : "innovation",
        sentence: `The position timestamps are now ${roundTo2Digits(set.offset - base.offset)} s later: ${change(before, now)}. `
          + (hasTruth ? `The position RMSE changes from ${length(before.truthP)} to ${length(now.truthP)}.`
            : `The position of KF changes by ${length(now.rmsDifference(before))} RMS.`),
        task: `Move the time offset to the smallest ${hasTruth ? "error" : "innovations"}.`,
        see: "The error is proportional to speed: zero at rest, largest at high speed. This is typical of a time offset." };
    },
    ({ largest, outside }) => ({ title: "Outliers", view: "innovation", measurement: largest.measurement,
      sentence: `The largest innovation is ${roundTo2Digits(largest.normalised)} √S, at ${largest.time.toFixed(1)} s. ${percent(outside)} of the innovations are outside ±2√S (expected 5 %).`,
      task: "Press space to step through the filter at this time, and check the gain.",
      see: "The gain does not depend on the innovation: without a gate KF follows an outlier." }),
    ({ base, rerun, axis, ekf2 }) => {
      const kf = rerun(base), title = "Comparison with EKF2";
      if (!ekf2.source) {
        return { title, view: "position",
          sentence: `EKF2 cannot be tested on this flight: ${ekf2.why || "its innovations are not logged"}.`,
          task: "Continue.", see: "The documentation lists the topics to log." };
      }
      return { title, view: "sigma_p",
        sentence: `The RMS of innovation ÷ √S is ${ratio(ekf2.source)} for EKF2 and ${ratio(kf.source)} for KF.`
          + (ekf2.truthP && kf.truthP ? ` The position RMSE is ${length(ekf2.truthP)} for EKF2 and ${length(kf.truthP)} for KF.` : "")
          + (axis.ekf2.r ? ` EKF2 assumes a measurement σ of ${roundTo2Digits(axis.ekf2.r)} m.` : ""),
        task: `${axis.ekf2.r ? "Press the button Use R of EKF2, then change" : "Change"} SIGMA_A until σ of KF and EKF2 are equal.`,
        see: "With the same R and a similar Q, EKF2 reports a similar σ." };
    },
  ];

  function start(page) {
    const { settings, set, open, result, flight, numbers, selected, stepper, axisNow, mapNow } = page;
    const box = $("tour"), starters = queryAll(".tour-start");
    let station = null, before = null;

    /* Numbers of this flight. The initial settings are maximum-likelihood estimates, or else those of the analysis */
    function evaluate() {
      const axis = axisNow(), [sigmaA, sigmaZ] = mapNow().likely ?? [null, null], { offset, settings: analysed } = flight;
      const base = { ...analysed, sigmaA: roundTo2Digits(sigmaA ?? analysed.sigmaA), sigmaZ: roundTo2Digits(sigmaZ ?? analysed.sigmaZ),
        offset: offset.why ? analysed.offset : Number((offset.likely ?? analysed.offset).toFixed(3)) };
      const rerun = (changes) => {
        const run = Engine.replay(flight, axis, { ...settings, ...changes }), p = run.updates.p00;
        return { ...numbers(axis, run), run, sigma: Math.sqrt(p.toSorted()[p.length >> 1]),
          rmsDifference: (other) => {
            const { time } = run.steps, from = time.length >> 3; // the first eighth is the transient from the initial state
            return Engine.rmse(run.steps.p.subarray(from), Engine.stateAt(other.run, time).p.subarray(from)) ?? 0;
          } };
      };
      const { run, outside } = rerun(base), { nu, s, time } = run.updates;
      const normalised = nu.map((innovation, i) => Math.abs(innovation) / Math.sqrt(s[i]));
      const measurement = normalised.indexOf(Math.max(...normalised));
      return { base, rerun, axis, outside, offset, ekf2: page.ekf2Of(axis),
        triple: { ...base, sigmaA: roundTo2Digits(3 * base.sigmaA), sigmaZ: roundTo2Digits(3 * base.sigmaZ) },
        largest: { measurement, normalised: normalised[measurement], time: time[measurement] } };
    }
    function goTo(to) {
      if (before === null) before = { settings: { ...settings }, view: page.view(), measurement: selected.measurement };
      station = to;
      const data = evaluate(), { title, sentence, task, see, set: values = data.base, view, measurement } = STATIONS[station](data);
      $("tour-title").textContent = `${station + 1} of ${STATIONS.length}: ${title}`;
      $("tour-sentence").textContent = sentence;
      $("tour-task").textContent = `Task: ${task}`;
      $("tour-see").textContent = `Result: ${see}`;
      $("tour-back").disabled = station === 0;
      $("tour-next").textContent = station === STATIONS.length - 1 ? "Finish" : "Next";
      box.hidden = false;
      document.body.classList.add("touring");
      open(view);
      set(values);
      if (measurement !== undefined) stepper.goTo(measurement);
      $("tour-title").focus({ preventScroll: true });
      // on a phone the settings sheet covers the lower half
      if (matchMedia("(max-width: 60rem)").matches) query("#card figure").scrollIntoView();
    }
    function end() {
      box.hidden = true;
      document.body.classList.remove("touring");
      station = null;
      selected.measurement = before.measurement;
      open(before.view);
      set(before.settings);
      before = null;
      starters.find((button) => button.checkVisibility())?.focus();
    }
    for (const button of starters) {
      button.hidden = result.run === null;
      button.addEventListener("click", () => goTo(0));
    }
    onClick("tour-back", () => goTo(station - 1));
    onClick("tour-next", () => station === STATIONS.length - 1 ? end() : goTo(station + 1));
    onClick("tour-end", end);
    box.addEventListener("keydown", (event) => { if (event.key === "Escape") end(); });
  }

  return { start };
})();
