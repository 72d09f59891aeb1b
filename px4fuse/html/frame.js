/* Script of a page with one table: sorts, searches, filters and unfolds its rows. */
(() => {
  const { columns, rows, size, nouns, axis } = JSON.parse($("content").textContent);
  const collator = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });
  const fold = (text) => text.normalize("NFD").replace(/\p{M}/gu, "").toLowerCase();
  const frame = query(".frame");
  const selects = queryAll(".controls select");
  const shownGroups = queryAll("[data-group]");

  /* Node with a text of unknown writing direction */
  const makeIsolated = (tag, text, className = "") => make(tag, text, { className, dir: "auto" });
  const fill = (node, children) => {
    node.append(...children);
    return node;
  };
  const makeSvg = (tag, attributes) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    return node;
  };

  const isNumeric = columns.map(([, kind]) => ["number", "rank", "ratio"].includes(kind));
  const entries = rows.map(([cells, tags, details, beside], index) => ({
    index, cells, tags: new Set(tags), details, beside, open: false,
    searchText: fold(cells.map(([text, , below]) => [text, below]).join("\n")),
    values: cells.map(([text, value], column) => isNumeric[column] ? value : text || null),
  }));
  let order = entries, matches = entries, firstShown = 0, current = null;

  // ------------------------------------------------------------ sections of an unfolded row

  const list = (texts, isWarning) => fill(make("ul", "", isWarning ? "warn" : ""),
    texts.map((text) => makeIsolated("li", text)));
  const prose = (text) => makeIsolated("p", text, "notes");
  const pairs = (rows) => fill(make("dl"),
    rows.flatMap(([title, value]) => [make("dt", title), makeIsolated("dd", value)]));
  const table = (rows, heads, numeric) => {
    const node = make("table"), alignment = (column) => numeric.includes(column) ? "n" : "";
    fill(node.createTHead().insertRow(), heads.map((title, column) =>
      make("th", title, { className: alignment(column), scope: "col" })));
    const body = node.createTBody();
    for (const texts of rows) {
      fill(body.insertRow(), texts.map((text, column) => makeIsolated("td", text, alignment(column))));
    }
    return fill(make("div", "", "scroll"), [node]);
  };
  const links = (rows) => fill(make("ul"), rows.map(([text, href]) =>
    fill(make("li"), [make("a", text, { href, rel: "noreferrer" })])));
  // rows of overrides.csv by student and item, changed by what the teacher types; only the download stores them
  const overrides = new Map();
  let hasUnsavedInput = false;
  const setOverride = (...row) => overrides.set(row.slice(0, 2).join("\0"), row);
  for (const [kind, , owner, rows, otherRows] of entries.flatMap(({ details }) => details)) {
    if (kind !== "boxes") continue;
    for (const [item, points, comment] of [...rows.map(([item, , ...row]) => [item, ...row]), ...otherRows]) {
      if (points !== null || comment) setOverride(owner, item, points ?? "", comment);
    }
  }
  const boxes = (owner, rows, otherRows) => {
    const node = make("div", "", "boxes");
    for (const [item, max, points, comment] of rows) {
      const number = make("input", "", { inputMode: "decimal", size: 6, value: points ?? "" });
      const text = make("textarea", comment, { rows: 2, dir: "auto" });
      for (const [title, field] of [[`Points for ${item} (maximum ${max})`, number], ["Comment", text]]) {
        node.append(fill(makeIsolated("label", title), [field]));
        field.addEventListener("input", () => {
          setOverride(owner, item, number.value, text.value);
          $("save").hidden = false;
          hasUnsavedInput = true;
        });
      }
    }
    if (otherRows.length) node.append(make("small", `${otherRows.length} other rows of overrides.csv (corrected points) stay unchanged.`));
    return node;
  };
  const overridesText = () => {
    const quoted = (cell) => {
      const text = String(cell);
      // an apostrophe prevents that spreadsheets read the text as a formula
      return '"' + (/^[=+\-@\t\r]/.test(text) ? "'" : "") + text.replaceAll('"', '""') + '"';
    };
    const all = [["id", "item", "points", "comment"], ...overrides.values()];
    return "\ufeff" + all.map((row) => row.map(quoted).join(",") + "\r\n").join("");
  };
  const makers = { list, prose, pairs, table, links, boxes };

  const section = (contents, className) => fill(make("section", "", className), contents.flatMap(
    ([kind, title, ...rest]) => [...title ? [make("h2", title)] : [], makers[kind](...rest)]));
  const detail = ({ details, beside }) => fill(make("div", "", beside.length ? "detail" : "detail bare"),
    [section(details, ""), ...beside.length ? [section(beside, "beside")] : []]);

  // ------------------------------------------------------------ the table

  /* Mark of a σ ratio on a logarithmic axis with the consistent band; a triangle marks a ratio beyond its ends */
  const ratioMark = (ratio, against) => {
    const width = 70, place = axisFraction(ratio, axis.ends);
    const [from, to] = axis.bands[against].map((end) => width * axisFraction(end, axis.ends));
    return fill(makeSvg("svg", { width: width + 14, height: 20, viewBox: `-7 -10 ${width + 14} 20`, "aria-hidden": "true" }), [
      makeSvg("rect", { x: from, y: -8, width: to - from, height: 16, class: "band" }),
      makeSvg("line", { x2: width, class: "track" }),
      makeSvg("path", { d: axis.marks[place < 0 ? "below" : place > 1 ? "above" : against],
        transform: `translate(${width * Math.min(Math.max(place, 0), 1)} 0)` })]);
  };

  const nameColumn = Math.max(columns.findIndex(([, kind]) => kind === "name"), 0);
  const classes = (kind, minScreenSize, group) =>
    `${{ number: "n", line: "line", full: "full", ratio: "ratio" }[kind] ?? ""} ${minScreenSize} ${group && `g-${group}`}`;
  const cell = ([text, value, below, style], column) => {
    const [, kind, group, minScreenSize] = columns[column];
    const hasStyle = style === "flags" || ["ratio", "full"].includes(kind);
    const node = make(column === nameColumn ? "th" : "td", "",
      `${classes(kind, minScreenSize, group)} ${hasStyle ? style : ""}`);
    if (style === "flags") node.append(list(text ? text.split("\n") : []));
    else if (text) {
      node.append(...kind === "ratio" ? [ratioMark(value, style.split(" ")[1]), make("span", text)]
        : [style && kind !== "full" ? make("span", text, `chip ${style}`) : makeIsolated("span", text)]);
    }
    if (below) node.append(makeIsolated("span", below, "file"));
    return node;
  };

  const unfold = (entry, open) => {
    entry.open = open;
    if (!entry.row) return;
    if (open && !entry.more) {
      entry.more = fill(make("tr", "", { className: "more", id: `more-${entry.index}` }),
        [fill(make("td", "", { colSpan: columns.length }), [detail(entry)])]);
      entry.button.setAttribute("aria-controls", entry.more.id);
    }
    if (open) entry.row.after(entry.more);
    else entry.more?.remove();
    entry.row.classList.toggle("open", open);
    entry.button.setAttribute("aria-expanded", String(open));
  };

  const makeRow = (entry) => {
    entry.row = fill(make("tr"), entry.cells.map(cell));
    entry.row.dataset.row = entry.index;
    entry.more = null;
    const head = entry.row.cells[nameColumn], name = head.firstChild;
    head.scope = "row";
    name.className = "name";
    entry.button = fill(make("button", "", "unfold"), [name]);
    entry.button.addEventListener("click", () => {
      current = entry;
      unfold(entry, !entry.open);
    });
    head.prepend(entry.button);
    return entry.row;
  };

  const listTable = make("table", "", "list"), headRow = listTable.createTHead().insertRow();
  const body = listTable.createTBody();
  const heads = columns.map(([title, kind, group, minScreenSize], column) => {
    const button = make("button", title);
    button.addEventListener("click", () => sort(column));
    return fill(make("th", "", { className: classes(kind, minScreenSize, group), scope: "col", ariaSort: "none" }), [button]);
  });
  headRow.append(...heads);

  const draw = () => {
    for (const entry of entries) entry.row = null;
    const shown = matches.slice(firstShown, firstShown + size);
    body.replaceChildren(...shown.map(makeRow));
    for (const entry of shown) unfold(entry, entry.open);
    const last = Math.ceil(matches.length / size);
    query(".pager").hidden = last < 2;
    $("place").textContent = `${nouns[1][0].toUpperCase()}${nouns[1].slice(1)} ${firstShown + 1} to ${firstShown + shown.length} of ${matches.length}`;
    $("back").disabled = firstShown === 0;
    $("on").disabled = firstShown + size >= matches.length;
    fit();
  };

  const fit = () => {
    frame.classList.remove("wide");
    const isWide = listTable.scrollWidth > frame.clientWidth;
    frame.classList.toggle("wide", isWide);
    // the keyboard must reach a region that scrolls
    frame.tabIndex = isWide ? 0 : -1;
    frame.style.setProperty("--width", `${frame.clientWidth}px`);
  };

  const sort = (column) => {
    const isAscending = heads[column].ariaSort !== "ascending", sign = isAscending ? 1 : -1;
    for (const head of heads) head.ariaSort = "none";
    heads[column].ariaSort = isAscending ? "ascending" : "descending";
    order = order.slice().sort((one, other) => {
      const a = one.values[column], b = other.values[column];
      // rows without a value are last in both sort directions
      if (a === null || b === null) return (a === null) - (b === null);
      return sign * (isNumeric[column] ? a - b : collator.compare(a, b));
    });
    filter();
  };

  const filter = () => {
    const searched = fold($("text").value).split(/\s+/).filter(Boolean);
    const tags = selects.map((select) => select.value).filter(Boolean);
    matches = order.filter((entry) => tags.every((tag) => entry.tags.has(tag))
      && searched.every((word) => entry.searchText.includes(word)));
    firstShown = 0;
    query(".count").textContent = `Showing ${matches.length} of ${entries.length}`;
    query(".none").hidden = matches.length > 0;
    $("all").hidden = matches.length === entries.length;
    draw();
  };

  const groups = () => {
    for (const box of shownGroups) listTable.classList.toggle(`with-${box.dataset.group}`, box.checked);
    fit();
  };

  const goTo = (to) => {
    firstShown = to;
    draw();
    frame.scrollIntoView({ block: "start" });
  };

  /* Turn to the page of a row and unfold its details, and fold those of the previous row */
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
    n: () => step(1), p: () => step(-1),
    "/": () => $("text").focus(),
    Escape: () => {
      if (current) unfold(current, false);
      if (current?.row) current.button.focus();
    },
  };

  document.addEventListener("keydown", (event) => {
    const busy = event.target.closest("input, select, textarea") && event.key !== "Escape";
    if (busy || event.ctrlKey || event.metaKey || event.altKey || !KEYS[event.key]) return;
    event.preventDefault();
    KEYS[event.key]();
  });
  query(".controls").addEventListener("submit", (event) => event.preventDefault());
  addEventListener("beforeunload", (event) => hasUnsavedInput && event.preventDefault());
  $("text").addEventListener("input", filter);
  onClick("all", () => {
    for (const field of [$("text"), ...selects]) field.value = "";
    filter();
  });
  onClick("save", () => {
    const link = make("a", "", { download: "overrides.csv",
      href: URL.createObjectURL(new Blob([overridesText()], { type: "text/csv" })) });
    link.click();
    hasUnsavedInput = false;
    URL.revokeObjectURL(link.href);
  });
  onClick("back", () => goTo(Math.max(firstShown - size, 0)));
  onClick("on", () => goTo(firstShown + size));
  for (const select of selects) select.addEventListener("change", filter);
  for (const box of shownGroups) {
    box.checked = false;
    box.addEventListener("change", groups);
  }
  addEventListener("resize", fit);
  for (const node of queryAll(".controls, .keys")) node.hidden = false;
  frame.prepend(listTable);
  filter();
  groups();
})();
