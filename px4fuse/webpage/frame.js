"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const { columns, rows, size, nouns, axis } = JSON.parse(byId("content").textContent);
  const collator = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });
  const fold = (text) => text.normalize("NFD").replace(/\p{M}/gu, "").toLowerCase();
  const frame = document.querySelector(".frame");
  const selects = [...document.querySelectorAll(".controls select")];
  const shownGroups = [...document.querySelectorAll("[data-group]")];

  // text from data becomes text nodes only, never HTML
  const make = (tag, text = "", kind = "") => {
    const node = document.createElement(tag);
    if (text) node.textContent = text;
    if (kind) node.className = kind;
    return node;
  };
  const makeIsolated = (tag, text, kind = "") => {
    const node = make(tag, text, kind);
    node.dir = "auto";
    return node;
  };
  const makeButton = (kind, ...content) => {
    const button = make("button", "", kind);
    button.type = "button";
    button.append(...content);
    return button;
  };
  const makeSvg = (tag, attributes) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    return node;
  };

  const entries = rows.map(([cells, tags, details, beside], index) => ({
    index, cells, tags: new Set(tags), details, beside, open: false,
    searchText: fold(cells.map(([text = "", , below = ""]) => text + "\n" + below).join("\n")),
    values: cells.map(([text = "", value = ""]) =>
      (value === "" ? null : value === true ? text : value)),
  }));
  let order = entries;
  let matches = entries;
  let firstShown = 0;
  let current = null;

  // ------------------------------------------------------------ sections of an unfolded row

  const list = (texts, warn) => {
    const made = make("ul", "", warn ? "warn" : "");
    made.append(...texts.map((text) => makeIsolated("li", text)));
    return made;
  };
  const prose = (text) => makeIsolated("p", text, "notes");
  const pairs = (lines) => {
    const made = make("dl");
    for (const [title, value] of lines) made.append(make("dt", title), makeIsolated("dd", value));
    return made;
  };
  const table = (heads, lines, numeric) => {
    const made = make("table");
    const head = made.createTHead().insertRow();
    heads.forEach((title, column) => {
      const cell = make("th", title, numeric.includes(column) ? "n" : "");
      cell.scope = "col";
      head.append(cell);
    });
    const rest = made.createTBody();
    for (const texts of lines) {
      rest.insertRow().append(...texts.map((text, column) =>
        makeIsolated("td", text, numeric.includes(column) ? "n" : "")));
    }
    const box = make("div", "", "scroll");
    box.append(made);
    return box;
  };
  const links = (lines) => {
    const made = make("ul");
    for (const [text, to] of lines) {
      const link = make("a", text);
      link.href = to;
      link.rel = "noreferrer";
      made.append(make("li"));
      made.lastChild.append(link);
    }
    return made;
  };
  // points and comments typed into boxes, by owner and name; only the download stores them
  const enteredRows = new Map();
  let hasUnsavedInput = false;
  const boxes = (owner, lines, kept) => {
    const made = make("div", "", "boxes");
    for (const [name, maximum, points, comment] of lines) {
      const number = make("input");
      const text = make("textarea");
      Object.assign(number, { type: "number", min: 0, max: maximum, step: "any", value: points ?? "" });
      Object.assign(text, { rows: 2, value: comment, dir: "auto" });
      for (const [title, field] of [["Points of " + maximum + " for " + name, number],
        ["Comment", text]]) {
        const label = makeIsolated("label", title);
        label.append(field);
        made.append(label);
        field.addEventListener("input", () => {
          enteredRows.set(owner + "\u0000" + name, [owner, name, number.value, text.value]);
          byId("save").hidden = false;
          hasUnsavedInput = true;
        });
      }
    }
    made.append(make("small", kept.length ? kept.length + " other entries in overrides.csv are kept" : ""));
    return made;
  };
  const tableOfBoxes = () => {
    const lines = new Map();
    for (const { details } of entries) {
      for (const [kind, , owner, rows, kept] of details) {
        if (kind !== "boxes") continue;
        for (const [name, , points, comment] of rows) {
          if (points === null && !comment) continue;
          lines.set(owner + "\u0000" + name, [owner, name, points ?? "", comment]);
        }
        for (const [name, points, comment] of kept) {
          lines.set(owner + "\u0000" + name, [owner, name, points ?? "", comment]);
        }
      }
    }
    for (const [key, line] of enteredRows) lines.set(key, line);
    const quoted = (cell) => {
      const text = String(cell);
      // prevent formulas in spreadsheets
      return '"' + (/^[=+\-@\t\r]/.test(text) ? "'" : "") + text.replaceAll('"', '""') + '"';
    };
    const all = [["id", "item", "points", "comment"], ...lines.values()];
    return "\ufeff" + all.map((line) => line.map(quoted).join(",") + "\r\n").join("");
  };
  const makers = { list, prose, pairs, table, links, boxes };

  const section = (parts, name) => {
    const made = make("section", "", name);
    for (const [kind, title, ...rest] of parts) {
      if (title) made.append(make("h2", title));
      made.append(makers[kind](...rest));
    }
    return made;
  };
  const detail = (entry) => {
    const box = make("div", "", "detail");
    box.append(section(entry.details, ""));
    if (entry.beside.length) box.append(section(entry.beside, "beside"));
    else box.classList.add("bare");
    return box;
  };

  // ------------------------------------------------------------ the table

  const bar = (share) => {
    const made = makeSvg("svg", { width: 72, height: 10, "aria-hidden": "true", class: "bar" });
    made.append(makeSvg("rect", { x: 2, y: 3, width: 68, height: 4, class: "all" }),
      makeSvg("rect", { x: 2, y: 3, width: 68 * share, height: 4 }));
    return made;
  };

  /* Ratio on a logarithmic axis with its band; a triangle stands for a ratio beyond the ends */
  const ratioMark = (ratio, against) => {
    const [low, high] = axis.ends.map(Math.log), width = 70;
    const at = (value) => (Math.log(value) - low) / (high - low), place = at(ratio);
    const band = axis.bands[against].map((end) => width * at(end));
    const made = makeSvg("svg", { width: width + 14, height: 20, viewBox: `-7 -10 ${width + 14} 20`, "aria-hidden": "true" });
    const path = makeSvg("path", { d: axis.marks[place < 0 ? "below" : place > 1 ? "above" : against],
      transform: `translate(${width * Math.min(Math.max(place, 0), 1)} 0)` });
    made.append(makeSvg("rect", { x: band[0], y: -8, width: band[1] - band[0], height: 16, class: "band" }),
      makeSvg("line", { x1: 0, x2: width, y1: 0, y2: 0, class: "track" }), path);
    return made;
  };

  const nameColumn = Math.max(columns.findIndex(([, kind]) => kind === "name"), 0);
  const classes = (kind, visibleFrom, group) =>
    [{ number: "n", line: "line", full: "full", ratio: "ratio" }[kind], visibleFrom, group && "g-" + group].filter(Boolean);
  const cell = ([text = "", cellValue = "", below = "", style = "", share = ""], column) => {
    const [, kind, group, visibleFrom] = columns[column];
    const made = make(column === nameColumn ? "th" : "td", "",
      [...classes(kind, visibleFrom, group), style === "flags" || ["ratio", "full"].includes(kind) ? style : ""].join(" "));
    if (kind === "ratio") {
      if (text) made.append(ratioMark(Number(cellValue), style.split(" ")[1]), make("span", text));
    } else if (style === "flags") {
      made.append(list(text ? text.split("\n") : [], false));
    } else if (style && kind !== "full") made.append(make("span", text, "chip " + style));
    else if (text) made.append(makeIsolated("span", text));
    if (share !== "") made.append(bar(share));
    if (below) made.append(makeIsolated("span", below, "file"));
    return made;
  };

  const unfold = (entry, open) => {
    entry.open = open;
    if (!entry.row) return;
    if (open && !entry.more) {
      entry.more = make("tr", "", "more");
      entry.more.id = "more-" + entry.index;
      const detailCell = entry.more.insertCell();
      detailCell.colSpan = columns.length;
      detailCell.append(detail(entry));
      entry.button.setAttribute("aria-controls", entry.more.id);
    }
    if (open) entry.row.after(entry.more);
    else if (entry.more) entry.more.remove();
    entry.row.classList.toggle("open", open);
    entry.button.setAttribute("aria-expanded", String(open));
  };

  const makeRow = (entry) => {
    const row = make("tr");
    row.dataset.row = entry.index;
    row.append(...entry.cells.map(cell));
    const head = row.cells[nameColumn];
    head.scope = "row";
    const name = head.firstChild;
    name.className = "name";
    entry.button = makeButton("unfold", name);
    entry.button.addEventListener("click", () => {
      current = entry;
      unfold(entry, !entry.open);
    });
    head.prepend(entry.button);
    entry.row = row;
    entry.more = null;
    return row;
  };

  const listTable = make("table", "", "list");
  const headRow = listTable.createTHead().insertRow();
  const body = listTable.createTBody();
  const heads = columns.map(([title, kind, group, visibleFrom], column) => {
    const head = make("th", "", classes(kind, visibleFrom, group).join(" "));
    head.scope = "col";
    head.setAttribute("aria-sort", "none");
    const button = makeButton("", title);
    button.addEventListener("click", () => sort(column));
    head.append(button);
    return head;
  });
  headRow.append(...heads);

  const draw = (count = size) => {
    for (const entry of entries) entry.row = null;
    const shown = matches.slice(firstShown, firstShown + count);
    body.replaceChildren(...shown.map(makeRow));
    for (const entry of shown) unfold(entry, entry.open);
    const last = Math.ceil(matches.length / size);
    document.querySelector(".pager").hidden = last < 2;
    byId("place").textContent = nouns[1][0].toUpperCase() + nouns[1].slice(1) + " " + (firstShown + 1)
      + " to " + (firstShown + shown.length) + " of " + matches.length;
    byId("back").disabled = firstShown === 0;
    byId("on").disabled = firstShown + size >= matches.length;
    fit();
  };

  const fit = () => {
    frame.classList.remove("wide");
    const wide = listTable.scrollWidth > frame.clientWidth;
    frame.classList.toggle("wide", wide);
    // a scrolling region must be reachable with the keyboard
    frame.tabIndex = wide ? 0 : -1;
    frame.style.setProperty("--width", frame.clientWidth + "px");
  };

  const sort = (column) => {
    const up = heads[column].getAttribute("aria-sort") !== "ascending";
    for (const head of heads) head.setAttribute("aria-sort", "none");
    heads[column].setAttribute("aria-sort", up ? "ascending" : "descending");
    const numeric = ["number", "rank", "ratio"].includes(columns[column][1]);
    const sign = up ? 1 : -1;
    order = order.slice().sort((one, other) => {
      const a = one.values[column];
      const b = other.values[column];
      // missing values are last in both directions
      if (a === null || b === null) return (a === null) - (b === null);
      return sign * (numeric ? a - b : collator.compare(a, b));
    });
    filter();
  };

  const filter = () => {
    const searched = fold(byId("text").value).split(/\s+/).filter(Boolean);
    const tags = selects.map((select) => select.value).filter(Boolean);
    matches = order.filter((entry) => tags.every((tag) => entry.tags.has(tag))
      && searched.every((word) => entry.searchText.includes(word)));
    firstShown = 0;
    document.querySelector(".count").textContent =
      "Showing " + matches.length + " of " + entries.length;
    document.querySelector(".none").hidden = matches.length > 0;
    byId("all").hidden = matches.length === entries.length;
    draw();
  };

  const clear = () => {
    byId("text").value = "";
    for (const select of selects) select.value = "";
    filter();
  };

  const groups = () => {
    for (const box of shownGroups) listTable.classList.toggle("with-" + box.dataset.group, box.checked);
    fit();
  };

  const goTo = (to) => {
    firstShown = to;
    draw();
    frame.scrollIntoView({ block: "start" });
  };

  const show = (entry) => {
    const place = matches.indexOf(entry);
    if (current && current !== entry) unfold(current, false);
    current = entry;
    entry.open = true;
    const start = place - place % size;
    if (start !== firstShown) {
      firstShown = start;
      draw();
    } else unfold(entry, true);
    entry.button.focus({ preventScroll: true });
    entry.row.scrollIntoView({ block: "start" });
  };

  const step = (by) => {
    const place = matches.indexOf(current);
    const next = matches[place < 0 ? (by > 0 ? firstShown : firstShown - 1) : place + by];
    if (next) show(next);
  };

  const KEYS = {
    j: () => step(1), n: () => step(1), k: () => step(-1), p: () => step(-1),
    "/": () => byId("text").focus(),
    Escape: () => {
      if (current) unfold(current, false);
      if (current && current.row) current.button.focus();
    },
  };

  document.addEventListener("keydown", (event) => {
    const busy = event.target.closest("input, select, textarea") && event.key !== "Escape";
    if (busy || event.ctrlKey || event.metaKey || event.altKey || !KEYS[event.key]) return;
    event.preventDefault();
    KEYS[event.key]();
  });
  document.querySelector(".controls").addEventListener("submit", (event) => event.preventDefault());
  window.addEventListener("beforeunload", (event) => hasUnsavedInput && event.preventDefault());
  byId("text").addEventListener("input", filter);
  byId("all").addEventListener("click", clear);
  byId("save").addEventListener("click", () => {
    const link = make("a");
    link.href = URL.createObjectURL(new Blob([tableOfBoxes()], { type: "text/csv" }));
    link.download = "overrides.csv";
    link.click();
    hasUnsavedInput = false;
    URL.revokeObjectURL(link.href);
  });
  byId("back").addEventListener("click", () => goTo(Math.max(firstShown - size, 0)));
  byId("on").addEventListener("click", () => goTo(firstShown + size));
  for (const select of selects) select.addEventListener("change", filter);
  for (const box of shownGroups) {
    box.checked = false;
    box.addEventListener("change", groups);
  }
  window.addEventListener("resize", fit);
  window.addEventListener("beforeprint", () => {
    firstShown = 0;
    draw(matches.length);
  });
  window.addEventListener("afterprint", () => draw());
  document.documentElement.classList.add("live");
  document.querySelector(".controls").hidden = false;
  document.querySelector(".keys").hidden = false;
  frame.prepend(listTable);
  filter();
  groups();
})();
