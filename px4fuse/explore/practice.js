// Practice: current flight, answers of the student and score. The page address contains them, so a reload keeps them.
// The solution of a flight is decoded only after the student's answer.
const Practice = (() => {
  const count = Number($("quiz").dataset.flights), address = new URLSearchParams(location.hash.slice(1));
  const savedAnswers = (address.get("answers") ?? "").split("~").slice(0, count);
  // answer to each flight: faults, separated by blanks
  const answers = Array.from({ length: count }, (_, i) => savedAnswers[i] ?? "");
  const requested = Math.trunc(Number(address.get("flight") ?? 1)) - 1;
  const current = requested >= 0 && requested < count ? requested : 0;
  const isOpen = answers[current] === "";

  const readSolution = (number) => inflate($(`key-${number}`).textContent).json();
  /* Points of an answer: 1 for all faults of the flight, 0.5 for one of two, 0 with a wrong fault */
  function points(answer, { right }) {
    const chosen = answer.split(" ");
    if (chosen.some((fault) => !right.includes(fault))) return 0;
    return chosen.length === right.length ? 1 : 0.5;
  }
  const toAddress = () => ({ flight: current + 1, answers: answers.join("~") });
  function goTo(number) {
    history.replaceState(null, "", `#${new URLSearchParams({ ...toAddress(), flight: number + 1 })}`);
    location.reload();
  }

  async function start(page) {
    $("quiz-title").textContent = `Flight ${current + 1} of ${count}: find the fault`;
    // commands need a log file, which a simulated flight does not have
    for (const id of ["as-report", "task"]) $(id).hidden = true;
    const boxes = queryAll("[name=choice]"), chosen = answers[current].split(" ");
    for (const box of boxes) {
      box.disabled = !isOpen;
      box.checked = chosen.includes(box.value);
      box.addEventListener("change", () => {
        if (!box.checked) return;
        for (const other of boxes) {
          if (other !== box && (box.value === "nothing" || other.value === "nothing")) other.checked = false;
        }
      });
    }
    $("quiz-check").hidden = !isOpen;
    onClick("quiz-check", () => {
      const chosen = boxes.filter(({ checked }) => checked).map(({ value }) => value);
      if (!chosen.length) { $("quiz-message").textContent = "Select at least one fault, or “no fault”."; return; }
      answers[current] = chosen.sort().join(" ");
      goTo(current);
    });
    const nextOpen = answers.findIndex((answer, i) => answer === "" && i !== current);
    $("quiz-next").hidden = isOpen || nextOpen < 0;
    onClick("quiz-next", () => goTo(nextOpen));
    $("quiz-again").hidden = answers.every((answer) => answer === "");
    onClick("quiz-again", () => { answers.fill(""); goTo(0); });
    await score();
    if (!isOpen) showSolution(page, await readSolution(current));
  }
  async function score() {
    let sum = 0, done = 0;
    for (const [number, answer] of answers.entries()) {
      if (answer === "") continue;
      sum += points(answer, await readSolution(number));
      done++;
    }
    $("quiz-score").textContent = done === 0 ? "" : `Score: ${sum} of ${done} answered flights${done === count ? ", all answered" : ""}`;
  }
  /* Show the solution and the card of the flight */
  function showSolution(page, solution) {
    const score = points(answers[current], solution), box = $("quiz-solution");
    box.classList.toggle("right", score === 1);
    box.replaceChildren(make("h2", { 1: "✓ Correct", 0.5: "Half correct", 0: "✕ Wrong" }[score]));
    if (!solution.mistakes.length) box.append(make("p", "The flight contains no fault."));
    for (const { fault, size, time, symptom, view, span } of solution.mistakes) {
      const button = make("button", "Show the fault in the plots");
      button.addEventListener("click", () => {
        page.open(view);
        if (span !== null) page.setSpan(span[0] - 3, span[1] + 3);
      });
      box.append(make("p", `${fault}: ${size}, ${time}. ${symptom}`), button);
    }
    box.hidden = false;
    // px4fuse has escaped its texts
    $("card").innerHTML = solution.card;
    // without the log file in the command
    for (const button of queryAll("[data-apply]")) {
      button.previousElementSibling.textContent = button.dataset.apply.replace(/^.*? (?=--)/, "");
    }
    page.open(solution.mistakes[0]?.view ?? "errors");
  }

  return { suffix: `-${current}`, toAddress, start, points };
})();
