/* What the knobs make of the flight, in the words of findings/story.py; a cure is told after it was
   replayed. */
const Story = (() => {
  // plain.number_words and the others
  const numberWords = (x, digits = 3) =>
    Number(x.toPrecision(digits)).toLocaleString("en", { maximumFractionDigits: 20 });
  const factorWords = (x) => numberWords(x, x < 2 ? 3 : 2);
  const excessWords = (x) => x < 2 ? `${Math.round(100 * (x - 1))} %` : `${factorWords(x)} times`;
  function lengthWords(m) {
    if (m < 0.0095) return `${(1e3 * m).toFixed(0)} mm`;
    if (m < 0.995) return `${(1e2 * m).toFixed(0)} cm`;
    return `${m.toFixed(m < 9.95 ? 1 : 0)} m`;
  }
  const capital = (text) => text.slice(0, 1).toUpperCase() + text.slice(1);

  function knows({ nis, band, claimed }) {
    if (claimed !== undefined) return `claims ${lengthWords(claimed)}`;
    if (nis === undefined) return "cannot be judged, since too few innovations are left";
    if (nis >= band[0] && nis <= band[1]) return "is honest about it";
    return nis < band[0] ? `is ${excessWords(Math.sqrt(1 / nis))} too modest`
      : `is ${excessWords(Math.sqrt(nis))} too sure of itself`;
  }
  function verdict({ nis, band }) {
    if (nis === undefined) return "not known";
    if (nis >= band[0] && nis <= band[1]) return "consistent";
    return nis < band[0] ? `overstated ${factorWords(Math.sqrt(1 / nis))}× in σ`
      : `understated ${factorWords(Math.sqrt(nis))}× in σ`;
  }

  /* How well both do along the axis now */
  function sentence(axis, ours, ekf2) {
    const along = `Along ${axis.called}`;
    if (ours === null) return `${along} too few measurements are left to run the filter.`;
    const off = ours.truthP ? `${lengthWords(ours.truthP)} from the truth (RMS) and `
      : ours.ekf2P ? `${lengthWords(ours.ekf2P)} from EKF2 (RMS) and ` : "";
    const other = ekf2.nis === undefined ? "" : `; EKF2 ${ekf2.truthP
      ? `is ${lengthWords(ekf2.truthP)} from the truth and ` : ""}${knows(ekf2)}`;
    return `${along} our filter is ${off}${knows(ours).replace(/^is /, "")}${other}.`;
  }

  /* Which one knob alone brings the mean NIS into its band: each is tried by a replay */
  function cure(ours, candidates, tried) {
    if (ours === null || ours.nis === undefined) return "";
    const { nis, band } = ours;
    if (nis >= band[0] && nis <= band[1]) return "";
    const done = candidates.map(([words, changes]) => [words, tried(changes)])
      .filter(([, one]) => one?.nis !== undefined);
    const cures = done.filter(([, one]) => one.nis >= one.band[0] && one.nis <= one.band[1]);
    const told = ([words, one]) => `${words} (mean NIS ${numberWords(nis, 2)} → ${numberWords(one.nis, 2)})`;
    if (cures.length) return ` Tried: ${cures.map(told).join(", or ")} alone makes it honest.`;
    const best = done.reduce((a, b) => a === null || Math.abs(Math.log(b[1].nis)) < Math.abs(Math.log(a[1].nis))
      ? b : a, null);
    if (best === null || Math.abs(Math.log(best[1].nis)) >= Math.abs(Math.log(nis))) return "";
    return ` Tried: no knob alone makes it honest; nearest comes ${told(best)}.`;
  }

  return { numberWords, lengthWords, excessWords, capital, knows, verdict, sentence, cure };
})();
