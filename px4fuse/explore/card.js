/* Axis of ratios and headline of the diagnosis card with the settings of the page. Numbers and words
   as in px4fuse.card. */
const Card = (() => {
  const NAMES = { source: "the source", truth: "ground truth" };
  // format_ratio and format_metres of card/numbers.py
  const formatRatio = (x) => x.toFixed(x >= 9.95 ? 0 : x >= 1.995 ? 1 : x >= 0.00995 ? 2 : 3);
  const formatMetres = (m) => `${m.toFixed(m >= 99.95 ? 0 : m >= 9.995 ? 1 : m >= 0.0995 ? 2 : 3)} m`;
  const size = (ratio) => Math.max(ratio, 1 / ratio);

  function start({ bands, ends, marks }, suffix) {
    const figures = new Map([...$(`figures${suffix}`).content.children].map((one) => [one.dataset.axis, one]));
    const part = (name) => document.querySelector(`#card [data-part=${name}]`);
    const analysed = {};

    const fraction = (ratio) => Math.log(ratio / ends[0]) / Math.log(ends[1] / ends[0]);
    const percent = (ratio) => `${100 * Math.min(Math.max(fraction(ratio), 0), 1)}%`;
    /* Verdict on a ratio (verdicts.py): consistent in its band, or if its 95 % interval contains 1 */
    function wordOf(ratio, against, interval) {
      const [low, high] = bands[against];
      if ((ratio >= low && ratio <= high) || (interval && interval[0] <= 1 && interval[1] >= 1)) return "consistent";
      return ratio > 1 ? "overconfident" : "underconfident";
    }
    /* Verdicts of KF against source and truth from its numbers; null if not evaluated */
    const verdicts = (kf) => ["source", "truth"].map((against) => {
      const ratio = kf?.[against];
      if (!ratio) return null;
      const interval = against === "source" ? kf.interval : null;
      return { against, ratio, interval, word: wordOf(ratio, against, interval) };
    });

    /* Call after the card or the axis has changed */
    function showAxis(axis, main) {
      const shown = document.querySelector("#card figure");
      // the figure of the card itself also states which verdicts are explained
      if (shown.hasChildNodes() && shown.dataset.axis === undefined) figures.set(main, shown);
      shown.replaceWith(figures.get(axis));
    }
    /* Move the marks of KF; the analysed ratios stay as hollow marks */
    function move(now, axis, isChanged) {
      const figure = document.querySelector("#card figure");
      now.forEach((verdict, i) => {
        const row = figure.querySelector(`[data-filter=kf][data-against=${["source", "truth"][i]}]`);
        const [mark, was, ratio, word] = [".mark", ".was", ".ratio", ".word"].map((name) => row?.querySelector(name));
        if (!mark || !verdict) return;
        row.analysed ??= { ratio: ratio.textContent, word: word.textContent, loud: word.classList.contains("loud"),
          label: figure.ariaLabel };
        was.setAttribute("display", isChanged ? "inline" : "none");
        for (const line of row.querySelectorAll(".interval")) line.setAttribute("display", isChanged ? "none" : "inline");
        const recorded = axis.verdicts[i].ratio, value = isChanged ? verdict.ratio : recorded, at = fraction(value);
        mark.setAttribute("x", percent(value));
        mark.firstChild.setAttribute("d", marks[at < 0 ? "below" : at > 1 ? "above" : verdict.against]);
        ratio.textContent = isChanged ? formatRatio(value) : row.analysed.ratio;
        word.textContent = isChanged ? verdict.word : row.analysed.word;
        const isLoud = isChanged ? verdict.word !== "consistent" : row.analysed.loud;
        for (const one of [ratio, word]) one.classList.toggle("loud", isLoud);
        figure.ariaLabel = isChanged ? [...figure.querySelectorAll("[data-filter]")].map((one) =>
          one.textContent.replace(/\s+/g, " ").trim()).join(". ") : row.analysed.label;
      });
    }
    function headline(now) {
      const known = now.filter(Boolean), off = known.filter((one) => one.word !== "consistent");
      if (!known.length) return "KF is not evaluated with these settings: too few measurements";
      if (!off.length) return "KF is consistent with these settings";
      const worst = off.reduce((a, b) => size(b.ratio) > size(a.ratio) ? b : a);
      return `KF ${worst.word} with these settings: σ ${formatRatio(size(worst.ratio))} times too `
        + `${worst.ratio > 1 ? "small" : "large"} against ${NAMES[worst.against]}`;
    }
    /* Headline and effect of the settings; without a change those of the analysis */
    function say(now, effect, isChanged) {
      const texts = Object.fromEntries(["sign", "headline", "effect"].map((name) => [name, part(name)]));
      if (texts.headline === null) return; // hidden in practice
      const recorded = part("recorded");
      for (const [name, node] of Object.entries(texts)) analysed[name] ??= node.textContent;
      analysed.style ??= texts.sign.className;
      texts.sign.textContent = isChanged ? "SETTINGS CHANGED" : analysed.sign;
      texts.sign.className = isChanged ? "sign note" : analysed.style;
      texts.headline.textContent = isChanged ? headline(now) : analysed.headline;
      texts.effect.textContent = isChanged ? effect : analysed.effect;
      recorded.hidden = !isChanged;
      recorded.textContent = `As analysed: ${analysed.sign} ${analysed.headline}`;
    }
    return { showAxis, move, say, verdicts };
  }

  return { start, formatRatio, formatMetres };
})();
