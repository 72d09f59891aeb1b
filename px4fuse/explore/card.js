// Diagnosis card for the settings of the page: axis of σ ratios, headline and effect. Numbers and words
// as in px4fuse.card.
const Card = (() => {
  const NAMES = { source: "the source", truth: "ground truth" };
  // format_ratio and format_metres of core/text.py
  const formatRatio = (x) => x.toFixed(x >= 9.95 ? 0 : x >= 1.995 ? 1 : x >= 0.00995 ? 2 : 3);
  const formatMetres = (m) => `${m.toFixed(m >= 99.95 ? 0 : m >= 9.995 ? 1 : m >= 0.0995 ? 2 : 3)} m`;
  const factor = (ratio) => Math.max(ratio, 1 / ratio);

  function start({ bands, ends, marks }, suffix) {
    const figures = new Map([...$(`figures${suffix}`).content.children].map((figure) => [figure.dataset.axis, figure]));
    // texts of the card with the settings of the analysis
    let analysed = null;

    /* Verdict on a ratio (verdicts.py): consistent in its band, or if its 95 % interval contains 1 */
    function wordOf(ratio, against, interval) {
      const [low, high] = bands[against];
      if ((ratio >= low && ratio <= high) || (interval?.[0] <= 1 && interval[1] >= 1)) return "consistent";
      return ratio > 1 ? "overconfident" : "underconfident";
    }
    /* Verdicts of KF against source and truth from its numbers; null if not evaluated */
    const verdicts = (kf) => Object.keys(NAMES).map((against) => {
      const ratio = kf?.[against];
      return ratio ? { against, ratio, word: wordOf(ratio, against, against === "source" ? kf.interval : null) } : null;
    });

    /* Show the σ ratios of an axis; with changed settings, hollow symbols keep the analysed ratios */
    function showRatios(now, axis, main, isChanged) {
      const shown = query("#card figure");
      // the figure in the card also marks explained verdicts, so it is kept for the main axis
      if (shown.hasChildNodes() && shown.dataset.axis === undefined) figures.set(main, shown);
      const figure = figures.get(axis).cloneNode(true);
      figure.dataset.axis = axis;
      shown.replaceWith(figure);
      if (!isChanged) return;
      for (const { against, ratio, word } of now.filter(Boolean)) {
        const row = figure.querySelector(`[data-filter=kf][data-against=${against}]`);
        const [mark, was, ratioNode, wordNode] = ["mark", "was", "ratio", "word"].map((name) => row?.querySelector(`.${name}`));
        if (!mark) continue;
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
    function headline(now) {
      const evaluated = now.filter(Boolean), wrong = evaluated.filter(({ word }) => word !== "consistent");
      if (!evaluated.length) return "KF is not evaluated with these settings: too few measurements";
      if (!wrong.length) return "KF is consistent with these settings";
      const { word, ratio, against } = wrong.reduce((a, b) => factor(b.ratio) > factor(a.ratio) ? b : a);
      return `KF is ${word} with these settings: σ is ${formatRatio(factor(ratio))} times too ${ratio > 1 ? "small" : "large"} against ${NAMES[against]}`;
    }
    /* Show headline and effect with the changed settings, or those of the analysis */
    function showTexts(now, effect, isChanged) {
      const [sign, headlineNode, effectNode, recorded] = ["sign", "headline", "effect", "recorded"]
        .map((name) => query(`#card [data-part=${name}]`));
      // practice hides them before the answer
      if (headlineNode === null) return;
      analysed ??= { sign: sign.textContent, headline: headlineNode.textContent, effect: effectNode.textContent,
        className: sign.className };
      const shown = isChanged ? { sign: "SETTINGS CHANGED", headline: headline(now), effect, className: "sign note" } : analysed;
      Object.assign(sign, { textContent: shown.sign, className: shown.className });
      headlineNode.textContent = shown.headline;
      effectNode.textContent = shown.effect;
      recorded.hidden = !isChanged;
      // its advice is for the analysed settings
      query("#card .do")?.toggleAttribute("hidden", isChanged);
      recorded.textContent = `Diagnosis before your changes of the settings: ${analysed.sign} ${analysed.headline}`;
    }
    return { showRatios, showTexts, verdicts };
  }

  return { start, formatRatio, formatMetres };
})();
