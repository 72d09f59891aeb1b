/* Practice: current flight, given answers and score. The address contains them, so a reload keeps them.
   The solution of a flight is decoded only after the student's answer. */
const Practice = (() => {
  const count = Number($("quiz").dataset.flights), address = new URLSearchParams(location.hash.slice(1));
  const savedAnswers = (address.get("answers") ?? "").split("~").slice(0, count);
  // each answer: faults, size and time, separated by "|"
  const answers = Array.from({ length: count }, (_, i) => savedAnswers[i] ?? "");
  const requested = Math.trunc(Number(address.get("flight") ?? 1)) - 1;
  const current = requested >= 0 && requested < count ? requested : 0;
  const isOpen = answers[current] === "";

  async function readSolution(number) {
    const bytes = Uint8Array.from(atob($(`key-${number}`).textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return JSON.parse(await new Response(stream).text());
  }
  const faultsOf = (answer) => answer.split("|")[0].split(" ");
  /* 1 point for all mistakes and no wrong choice, 0.5 for one of two and no wrong choice */
  function points(answer, { right }) {
    const chosen = faultsOf(answer);
    if (chosen.some((one) => !right.includes(one))) return 0;
    return chosen.length === right.length ? 1 : 0.5;
  }
  const toAddress = () => ({ flight: current + 1, answers: answers.join("~") });
  function goTo(number) {
    history.replaceState(null, "", `#${new URLSearchParams({ ...toAddress(), flight: number + 1 })}`);
    location.reload();
  }

  async function start(page) {
    $("quiz-title").textContent = `Flight ${current + 1} of ${count}: find the fault`;
    // the flight is not a log file
    for (const id of ["as-report", "whatif", "task"]) $(id).hidden = true;
    for (const one of document.querySelectorAll(".tour-start")) one.hidden = true;
    const boxes = [...document.querySelectorAll("[name=choice]")];
    const [, size = "", time = ""] = answers[current].split("|");
    $("quiz-size").value = size;
    $("quiz-time").value = time;
    for (const input of [...boxes, $("quiz-size"), $("quiz-time")]) input.disabled = !isOpen;
    for (const box of boxes) {
      box.checked = faultsOf(answers[current]).includes(box.value);
      box.addEventListener("change", () => {
        if (!box.checked) return;
        for (const other of boxes) {
          if (other !== box && (box.value === "nothing" || other.value === "nothing")) other.checked = false;
        }
      });
    }
    $("quiz-check").hidden = !isOpen;
    $("quiz-check").addEventListener("click", () => {
      const chosen = boxes.filter((box) => box.checked).map((box) => box.value);
      if (!chosen.length) { $("quiz-message").textContent = "Select at least one."; return; }
      const typed = ["quiz-size", "quiz-time"].map((id) => $(id).value.replace(/[|~]/g, " ").trim());
      answers[current] = [chosen.sort().join(" "), ...typed].join("|");
      goTo(current);
    });
    const nextOpen = answers.findIndex((answer, i) => answer === "" && i !== current);
    $("quiz-next").hidden = isOpen || nextOpen < 0;
    $("quiz-next").addEventListener("click", () => goTo(nextOpen));
    $("quiz-again").hidden = answers.every((answer) => answer === "");
    $("quiz-again").addEventListener("click", () => { answers.fill(""); goTo(0); });
    await score();
    if (!isOpen) showSolution(page, await readSolution(current), boxes);
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
  /* Show the answer beside the solution, the re-run, and the card of the flight */
  function showSolution(page, solution, boxes) {
    const score = points(answers[current], solution), box = $("quiz-solution");
    const [faults, size, time] = answers[current].split("|"), column = (name) => solution.mistakes.map((one) => one[name]);
    const names = faults.split(" ").map((name) => boxes.find(({ value }) => value === name)?.parentElement.textContent.trim());
    const heading = make("h2", { 1: "✓ Correct", 0.5: "Half correct", 0: "✕ Wrong" }[score]);
    box.classList.toggle("right", score === 1);
    const table = make("table"), head = table.createTHead().insertRow();
    for (const text of ["", "you", "correct"]) head.append(make("th", text, { scope: "col" }));
    const body = table.createTBody();
    for (const [name, yours, right] of [["fault", names.join("; "), column("fault").join("; ") || "no mistake"],
      ["size", size, column("size").join("; ")], ["time", time, column("time").join("; ")]]) {
      body.insertRow().append(make("th", name, { scope: "row" }), make("td", yours || "–", { dir: "auto" }), make("td", right || "–"));
    }
    box.replaceChildren(heading, table, make("p", solution.rerun));
    for (const { symptom, view, span } of solution.mistakes) {
      const button = make("button", "show", { type: "button" });
      button.addEventListener("click", () => {
        page.open(view);
        if (span !== null) page.look(span[0] - 3, span[1] + 3);
      });
      box.append(make("p", `${symptom} `, { className: "note" }), button);
    }
    box.hidden = false;
    $("card").innerHTML = solution.card; // escaped by px4fuse; the policy of the page allows no other script
    for (const button of document.querySelectorAll("[data-apply]")) { // the flight is not a log file
      button.previousElementSibling.textContent = button.dataset.apply.replace(/^.*? (?=--)/, "");
    }
    page.open(solution.mistakes[0]?.view ?? "errors");
  }

  return { suffix: `-${current}`, toAddress, start, points };
})();
