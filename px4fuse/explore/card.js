// Diagnosis card for the settings of the page: σ ratios and headline. Numbers and words as in px4fuse.card.
const Card = (() => {
  const NAMES = { source: "the source", truth: "ground truth" };
  // format_ratio and format_metres of core/text.py
  const formatRatio = (x) => x.toFixed(x >= 9.95 ? 0 : x >= 1.995 ? 1 : x >= 0.00995 ? 2 : 3);
  const formatMetres = (m) => `${m.toFixed(m >= 99.95 ? 0 : m >= 9.995 ? 1 : m >= 0.0995 ? 2 : 3)} m`;
  const factor = ({ ratio }) => Math.max(ratio, 1 / ratio);

  /* Verdicts on the σ ratios of KF against source and ground truth, as far as they are evaluated (verdicts.py) */
  function findVerdicts(kf, bands) {
    return Object.keys(NAMES).filter((against) => kf?.[against]).map((against) => {
      const ratio = kf[against], [low, high] = bands[against];
      const isConsistent = (ratio >= low && ratio <= high) || (against === "source" && kf.isNisInBand);
      return { against, ratio, word: isConsistent ? "consistent" : ratio > 1 ? "overconfident" : "underconfident" };
    });
  }
  /* Move the marks of KF to its σ ratios; hollow marks keep the ratios of the analysis */
  function moveMarks(figure, verdicts, { ends, marks }) {
    for (const { against, ratio, word } of verdicts) {
      const row = figure.querySelector(`[data-filter=kf][data-against=${against}]`);
      const [mark, was, ratioNode, wordNode] = ["mark", "was", "ratio", "word"].map((name) => row.querySelector(`.${name}`));
      // not evaluated with the settings of the analysis
      if (mark === null) continue;
      was.setAttribute("display", "inline");
      for (const line of row.querySelectorAll(".interval")) line.remove();
      const place = axisFraction(ratio, ends);
      mark.setAttribute("x", `${100 * clamp(place, 0, 1)}%`);
      mark.firstChild.setAttribute("d", marks[place < 0 ? "below" : place > 1 ? "above" : against]);
      ratioNode.textContent = formatRatio(ratio);
      wordNode.textContent = word;
      for (const node of [ratioNode, wordNode]) node.classList.toggle("loud", word !== "consistent");
    }
    figure.ariaLabel = [...figure.querySelectorAll("[data-filter]")].map(({ textContent }) =>
      textContent.replace(/\s+/g, " ").trim()).join(". ");
  }
  function headline(verdicts) {
    if (!verdicts.length) return "KF is not evaluated: too few measurements";
    const wrong = verdicts.filter(({ word }) => word !== "consistent").sort((a, b) => factor(b) - factor(a));
    if (!wrong.length) return "KF is consistent";
    const [{ word, ratio, against }] = wrong;
    return `KF is ${word}: σ is ${formatRatio(factor(wrong[0]))} times too ${ratio > 1 ? "small" : "large"} against ${NAMES[against]}`;
  }
  /* With changed settings, replace the diagnosis of the analysis by a headline about KF */
  function showHeadline(verdicts, isChanged) {
    const changed = query("#card [data-part=changed]");
    // practice hides the diagnosis before the answer
    if (changed === null) return;
    changed.textContent = `With these settings, ${headline(verdicts)}`;
    for (const node of changed.parentElement.children) node.hidden = (node === changed) !== isChanged;
  }

  return { findVerdicts, moveMarks, showHeadline, formatMetres };
})();
