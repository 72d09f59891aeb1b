/* Which flight of the set is shown, what was answered, and what was right. All of it is kept in the
   address, so that a reload shows the same; the answers are decoded only after a choice. */
const Practice = (() => {
  const count = Number($("quiz").dataset.rounds), parts = new URLSearchParams(location.hash.slice(1));
  const given = (parts.get("answers") ?? "").split("~").slice(0, count);
  const answers = Array.from({ length: count }, (_, i) => given[i] ?? "");
  const wanted = Math.trunc(Number(parts.get("flight") ?? 1)) - 1;
  const at = wanted >= 0 && wanted < count ? wanted : 0;
  const hidden = answers[at] === "";

  async function keyOf(number) {
    const bytes = Uint8Array.from(atob($(`key-${number}`).textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return JSON.parse(await new Response(stream).text());
  }
  /* 1 for all that is wrong and nothing else, half for one of two and nothing else */
  function points(answer, { right }) {
    const chosen = answer.split(" ");
    if (chosen.some((one) => !right.includes(one))) return 0;
    return chosen.length === right.length ? 1 : 0.5;
  }
  const toAddress = () => ({ flight: at + 1, answers: answers.join("~") });
  function to(number) {
    history.replaceState(null, "", `#${new URLSearchParams({ ...toAddress(), flight: number + 1 })}`);
    location.reload();
  }

  async function start(page) {
    $("quiz-title").textContent = `Flight ${at + 1} of ${count}`;
    $("tour-start").hidden = true;
    $("as-report").hidden = true; // there is no such log
    const boxes = [...document.querySelectorAll("[name=choice]")];
    for (const box of boxes) {
      box.disabled = !hidden;
      box.checked = answers[at].split(" ").includes(box.value);
      box.addEventListener("change", () => {
        if (!box.checked) return;
        for (const other of boxes) {
          if (other !== box && (box.value === "nothing" || other.value === "nothing")) other.checked = false;
        }
      });
    }
    $("quiz-check").hidden = !hidden;
    $("quiz-check").addEventListener("click", () => {
      const chosen = boxes.filter((box) => box.checked).map((box) => box.value);
      if (!chosen.length) { $("quiz-said").textContent = "Choose at least one."; return; }
      answers[at] = chosen.sort().join(" ");
      to(at);
    });
    const open = answers.findIndex((answer, i) => answer === "" && i !== at);
    $("quiz-next").hidden = hidden || open < 0;
    $("quiz-next").addEventListener("click", () => to(open));
    $("quiz-again").hidden = answers.every((answer) => answer === "");
    $("quiz-again").addEventListener("click", () => { answers.fill(""); to(0); });
    await score();
    if (!hidden) await told(page);
  }
  async function score() {
    let sum = 0, done = 0;
    for (const [number, answer] of answers.entries()) {
      if (answer === "") continue;
      sum += points(answer, await keyOf(number));
      done++;
    }
    $("quiz-score").textContent = done === 0 ? "" : `${sum} of ${done} right${done === count
      ? ": the set is done" : " so far"}`;
  }
  async function told(page) {
    const key = await keyOf(at), won = points(answers[at], key);
    $("quiz-said").textContent = won === 1 ? "Right." : `${won === 0 ? "Not so." : "Half of it."} It was: ${key.right.join(" and ")}.`;
    const box = $("quiz-told");
    if (!key.made.length) {
      box.append(make("p", "Nothing was wrong: the innovations lie within ±2√S, one in twenty outside, and follow no order."));
    }
    for (const { what, tell, view, span } of key.made) {
      const line = make("p", `${what} The tell-tale: ${tell} `);
      const when = span === null ? "all along" : `at ${span[0].toFixed(1)} s`;
      const button = make("button", `show me (${when})`, { type: "button", className: "jump" });
      button.addEventListener("click", () => {
        page.open(view);
        if (span !== null) page.look(span[0] - 3, span[1] + 3);
      });
      line.append(button);
      box.append(line);
    }
    page.recorded(key);
    page.open(key.made[0]?.view ?? "error");
  }

  return { suffix: `-${at}`, hidden, toAddress, start, points };
})();
