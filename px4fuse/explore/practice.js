/* Practice: current flight, given answers and score. The address contains them, so a reload keeps them.
   The solution of a flight is decoded only after the student's answer. */
const Practice = (() => {
  const count = Number($("quiz").dataset.flights), address = new URLSearchParams(location.hash.slice(1));
  const savedAnswers = (address.get("answers") ?? "").split("~").slice(0, count);
  const answers = Array.from({ length: count }, (_, i) => savedAnswers[i] ?? "");
  const requested = Math.trunc(Number(address.get("flight") ?? 1)) - 1;
  const current = requested >= 0 && requested < count ? requested : 0;
  const hidden = answers[current] === "";

  async function readSolution(number) {
    const bytes = Uint8Array.from(atob($(`key-${number}`).textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return JSON.parse(await new Response(stream).text());
  }
  /* 1 point for all mistakes and no wrong choice, 0.5 for one of two and no wrong choice */
  function points(answer, { right }) {
    const chosen = answer.split(" ");
    if (chosen.some((one) => !right.includes(one))) return 0;
    return chosen.length === right.length ? 1 : 0.5;
  }
  const toAddress = () => ({ flight: current + 1, answers: answers.join("~") });
  function goTo(number) {
    history.replaceState(null, "", `#${new URLSearchParams({ ...toAddress(), flight: number + 1 })}`);
    location.reload();
  }

  async function start(page) {
    $("quiz-title").textContent = `Flight ${current + 1} of ${count}`;
    $("tour-start").hidden = true;
    $("as-report").hidden = true; // the flight is not a log file
    const boxes = [...document.querySelectorAll("[name=choice]")];
    for (const box of boxes) {
      box.disabled = !hidden;
      box.checked = answers[current].split(" ").includes(box.value);
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
      if (!chosen.length) { $("quiz-result").textContent = "Select at least one."; return; }
      answers[current] = chosen.sort().join(" ");
      goTo(current);
    });
    const nextOpen = answers.findIndex((answer, i) => answer === "" && i !== current);
    $("quiz-next").hidden = hidden || nextOpen < 0;
    $("quiz-next").addEventListener("click", () => goTo(nextOpen));
    $("quiz-again").hidden = answers.every((answer) => answer === "");
    $("quiz-again").addEventListener("click", () => { answers.fill(""); goTo(0); });
    await score();
    if (!hidden) await showSolution(page);
  }
  async function score() {
    let sum = 0, done = 0;
    for (const [number, answer] of answers.entries()) {
      if (answer === "") continue;
      sum += points(answer, await readSolution(number));
      done++;
    }
    $("quiz-score").textContent = done === 0 ? "" : `${sum} of ${done} correct${done === count
      ? ", set finished" : " so far"}`;
  }
  async function showSolution(page) {
    const solution = await readSolution(current), score = points(answers[current], solution);
    const grade = { 1: "Correct.", 0.5: "Half correct.", 0: "Wrong." }[score];
    $("quiz-result").textContent = score === 1 ? grade : `${grade} Correct answer: ${solution.right.join(" and ")}.`;
    const box = $("quiz-solution");
    if (!solution.mistakes.length) {
      box.append(make("p", "No mistake: about 5 % of the innovations are outside ±2√S, and they are white."));
    }
    for (const { description, symptom, view, span } of solution.mistakes) {
      const line = make("p", `${description} Symptom: ${symptom} `);
      const when = span === null ? "whole flight" : `at ${span[0].toFixed(1)} s`;
      const button = make("button", `show (${when})`, { type: "button", className: "jump" });
      button.addEventListener("click", () => {
        page.open(view);
        if (span !== null) page.look(span[0] - 3, span[1] + 3);
      });
      line.append(button);
      box.append(line);
    }
    page.recorded(solution);
    page.open(solution.mistakes[0]?.view ?? "error");
  }

  return { suffix: `-${current}`, hidden, toAddress, start, points };
})();
