/* Sentences and verdicts on the flight with the current settings, worded as in findings/summary.py. */
const Summary = (() => {
  // format_number and format_factor of text.py, format_metres of findings/summary.py
  const formatNumber = (x, digits = 3) =>
    Number(x.toPrecision(digits)).toLocaleString("en", { maximumFractionDigits: 20 });
  const formatFactor = (x) => formatNumber(x, x < 2 ? 3 : 2);
  const formatMetres = (m) => `${m.toFixed(m < 0.0995 ? 3 : 2)} m`;

  const isConsistent = ({ nis, band }) => nis >= band[0] && nis <= band[1];
  /* [confidence, factor in σ, size] of an inconsistent filter */
  const deviation = ({ nis, band }) => nis < band[0]
    ? ["underconfident", formatFactor(Math.sqrt(1 / nis)), "large"]
    : ["overconfident", formatFactor(Math.sqrt(nis)), "small"];
  function verdict(filter) {
    if (filter.nis === undefined) return "unknown";
    if (isConsistent(filter)) return "consistent";
    const [confidence, factor, size] = deviation(filter);
    return `${confidence}, σ ${factor}× too ${size}`;
  }
  function consistency(filter) {
    if (filter.nis === undefined) return "is not tested: too few innovations";
    if (isConsistent(filter)) return "is consistent";
    const [confidence, factor, size] = deviation(filter);
    return `is ${confidence}: σ is ${factor} times too ${size}`;
  }
  function describe(name, filter) {
    if (filter.truthP && filter.reportedSigma !== undefined) {
      return `${name} has a position RMSE of ${formatMetres(filter.truthP)}, but reports σ ${formatMetres(filter.reportedSigma)}.`;
    }
    const start = filter.truthP ? `has a position RMSE of ${formatMetres(filter.truthP)} and `
      : filter.ekf2P ? `differs from EKF2 by ${formatMetres(filter.ekf2P)} RMS and ` : "";
    return `${name} ${start}${consistency(filter)}.`;
  }

  /* Error and consistency of KF and EKF2 along the axis */
  function sentence(axis, kf, ekf2) {
    const along = `Along ${axis.called}`;
    if (kf === null) return `${along} the segment has too few measurements to run KF.`;
    return `${along} ${describe("KF", kf)}${ekf2.nis === undefined ? "" : ` ${describe("EKF2", ekf2)}`}`;
  }

  /* Re-runs with one changed setting: those that make KF consistent, else the best one */
  function remedy(kf, candidates, rerun) {
    if (kf === null || kf.nis === undefined || isConsistent(kf)) return "";
    const results = candidates.map(([label, changes]) => [label, rerun(changes)])
      .filter(([, result]) => result?.nis !== undefined);
    const format = ([label, result]) => `${label} (mean NIS ${formatNumber(kf.nis, 2)} → ${formatNumber(result.nis, 2)})`;
    const consistent = results.filter(([, result]) => isConsistent(result));
    if (consistent.length) return ` One change makes KF consistent (re-run): ${consistent.map(format).join(" or ")}.`;
    const distance = (result) => Math.abs(Math.log(result.nis));
    const best = results.reduce((a, b) => a === null || distance(b[1]) < distance(a[1]) ? b : a, null);
    if (best === null || distance(best[1]) >= distance(kf)) return "";
    return ` No single change makes KF consistent. Best re-run: ${format(best)}.`;
  }

  return { formatNumber, formatMetres, verdict, sentence, remedy };
})();
