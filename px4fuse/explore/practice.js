// Practice: current flight, answers of the student and score. The page address contains them, so a reload keeps them.
// The solution of a flight is decoded only after the student's answer.
const Practice = (() => {
  const count = Number($("quiz").dataset.flights), address = new URLSearchParams(location.hash.slice(1));
  const savedAnswers = (address.get("answers") ?? "").split("~");
  // answer to each flight: faults, separated by blanks
  const answers = Array.from({ length: count }, (_, i) => savedAnswers[i] ?? "");
  const current = clamp(Math.trunc(Number(address.get("flight") ?? 1)) - 1 || 0, 0, count - 1);
  const isOpen = answers[current] === "";

  const readSolution = (number) => inflate($(`key-${number}`).textContent).json();
  /* Points of an answer: 1 for all faults of the flight, 0.5 for one of two, 0 with a wrong fault */
  function points(answer, { right }) {
    const chosen = answer.split(" ");
    if (chosen.some((fault) => !right.includes(fault))) return 0;
    return chosen.length === right.length ? 1 : 0.5;
  }
  function goTo(number) {
    location.hash = new URLSearchParams({ flight: number + 1, answers: answers.join("~") });
    location.reload();
  }

  async function start(page) {
    $("quiz-title").textContent = `Flight ${current + 1} of ${count}: find the fault`;
    const boxes = queryAll("[name=choice]"), chosen = answers[current].split(" ");
    for (const box of boxes) {
      box.disabled = !isOpen;
      box.checked = chosen.includes(box.value);
    }
    $("quiz-check").hidden = !isOpen;
    onClick("quiz-check", () => {
      answers[current] = boxes.filter(({ checked }) => checked).map(({ value }) => value).join(" ");
      if (answers[current]) goTo(current);
      else $("quiz-message").textContent = "Select at least one fault, or “no fault”.";
    });
    const nextOpen = answers.findIndex((answer, i) => answer === "" && i !== current);
    $("quiz-next").hidden = isOpen || nextOpen < 0;
    onClick("quiz-next", () => goTo(nextOpen));
    await showScore();
    if (!isOpen) showSolution(page, await readSolution(current));
  }
  async function showScore() {
    let sum = 0, done = 0;
    for (const [number, answer] of answers.entries()) {
      if (answer === "") continue;
      sum += points(answer, await readSolution(number));
      done++;
    }
    $("quiz-score").textContent = done ? `Score: ${sum} of ${done} answered flights${done === count ? ", all answered" : ""}` : "";
  }
  /* Show the solution and the card of the flight */
  function showSolution(page, solution) {
    const score = points(answers[current], solution), box = $("quiz-solution");
    box.replaceChildren(make("h2", { 1: "✓ Correct", 0.5: "Half correct", 0: "✕ Wrong" }[score]));
    if (!solution.mistakes.length) box.append(make("p", "The flight contains no fault."));
    for (const { fault, size, time, symptom } of solution.mistakes) {
      box.append(make("p", `${fault}: ${size}, ${time}. ${symptom}`));
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

  return { suffix: `-${current}`, start, points };
})();
