/* Script of a page with one table: sorts, searches, filters and unfolds its rows. */
(() => {
  const { columns, rows, size, axis } = JSON.parse($("content").textContent);
  const collator = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });
  const fold = (text) => text.normalize("NFD").replace(/\p{M}/gu, "").toLowerCase();
  const selects = queryAll(".controls select");

  /* Node with a text of unknown writing direction */
  const makeIsolated = (tag, text, className = "") => make(tag, text, { className, dir: "auto" });
  const fill = (node, children) => {
    node.append(...children);
    return node;
  };
  const makeSvg = (tag, attributes, children = []) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    return fill(node, children);
  };

  const isNumeric = columns.map(([, kind]) => ["number", "rank", "ratio"].includes(kind));
  const entries = rows.map(([cells, tags, details, beside]) => ({
    cells, tags, details, beside, isOpen: false, row: null, detailRow: null,
    searchText: fold(cells.map(([text, , below]) => `${text}\n${below}`).join("\n")),
    values: cells.map(([text, value], column) => isNumeric[column] ? value : text || null),
  }));
  let order = entries, matches = entries, shownCount = size;

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
  const boxes = (owner, rows) => {
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
    return node;
  };
  for (const [kind, , owner, rows, otherRows] of entries.flatMap(({ details }) => details)) {
    if (kind !== "boxes") continue;
    for (const [item, points, comment] of [...rows.map(([item, , ...row]) => [item, ...row]), ...otherRows]) {
      if (points !== null || comment) setOverride(owner, item, points ?? "", comment);
    }
  }
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

  const section = (contents) => fill(make("section"), contents.flatMap(
    ([kind, title, ...rest]) => [make("h2", title), makers[kind](...rest)]));
  const makeDetailRow = ({ details, beside }) => {
    const sections = [details, beside].filter((contents) => contents.length).map(section);
    const cell = fill(make("td", "", { colSpan: columns.length }), [fill(make("div", "", "detail"), sections)]);
    return fill(make("tr", "", "more"), [cell]);
  };

  // ------------------------------------------------------------ the table

  /* Mark of a σ ratio on a logarithmic axis with the consistent band; a triangle marks a ratio beyond its ends */
  const ratioMark = (ratio, against) => {
    const width = 70, place = axisFraction(ratio, axis.ends);
    const [from, to] = axis.bands[against].map((end) => width * axisFraction(end, axis.ends));
    return makeSvg("svg", { width: width + 14, height: 20, viewBox: `-7 -10 ${width + 14} 20`, "aria-hidden": "true" }, [
      makeSvg("rect", { x: from, y: -8, width: to - from, height: 16, class: "band" }),
      makeSvg("line", { x2: width, class: "track" }),
      makeSvg("path", { d: axis.marks[place < 0 ? "below" : place > 1 ? "above" : against],
        transform: `translate(${width * Math.min(Math.max(place, 0), 1)} 0)` })]);
  };

  const nameColumn = Math.max(columns.findIndex(([, kind]) => kind === "name"), 0);
  const classes = ([, kind, group, isOnPhones]) =>
    `k-${kind} ${group && `g-${group}`} ${isOnPhones ? "" : "large"}`;
  const makeCell = ([text, value, below, style], column) => {
    const kind = columns[column][1], hasStyle = style === "flags" || ["ratio", "full"].includes(kind);
    const node = make(column === nameColumn ? "th" : "td", "", `${classes(columns[column])} ${hasStyle ? style : ""}`);
    if (style === "flags") node.append(list(text.split("\n").filter(Boolean)));
    else if (kind === "ratio" && text) node.append(ratioMark(value, style.split(" ")[1]), make("span", text));
    else if (text) node.append(makeIsolated("span", text, style && !hasStyle ? `chip ${style}` : ""));
    if (below) node.append(makeIsolated("span", below, "file"));
    return node;
  };
  const makeRow = (entry) => {
    const row = fill(make("tr"), entry.cells.map(makeCell)), head = row.cells[nameColumn], name = head.firstChild;
    head.scope = "row";
    name.className = "name";
    const button = fill(make("button", "", { className: "unfold", ariaExpanded: "false" }), [name]);
    button.addEventListener("click", () => {
      entry.isOpen = !entry.isOpen;
      entry.detailRow ??= makeDetailRow(entry);
      if (entry.isOpen) row.after(entry.detailRow);
      else entry.detailRow.remove();
      button.ariaExpanded = String(entry.isOpen);
    });
    head.prepend(button);
    return row;
  };

  const listTable = make("table", "", "list"), headRow = listTable.createTHead().insertRow();
  const body = listTable.createTBody();
  const heads = columns.map((column, index) => {
    const button = make("button", column[0]);
    button.addEventListener("click", () => sort(index));
    return fill(make("th", "", { className: classes(column), scope: "col", ariaSort: "none" }), [button]);
  });
  headRow.append(...heads);

  const draw = () => {
    body.replaceChildren(...matches.slice(0, shownCount).flatMap((entry) => {
      entry.row ??= makeRow(entry);
      return entry.isOpen ? [entry.row, entry.detailRow] : [entry.row];
    }));
    $("more").hidden = shownCount >= matches.length;
  };

  const sort = (column) => {
    const isAscending = heads[column].ariaSort !== "ascending", sign = isAscending ? 1 : -1;
    for (const head of heads) head.ariaSort = "none";
    heads[column].ariaSort = isAscending ? "ascending" : "descending";
    order = order.toSorted((one, other) => {
      const a = one.values[column], b = other.values[column];
      // rows without a value are last in both sort directions
      if (a === null || b === null) return (a === null) - (b === null);
      return sign * (isNumeric[column] ? a - b : collator.compare(a, b));
    });
    filter();
  };

  const filter = () => {
    const searched = fold($("text").value).split(/\s+/);
    const tags = selects.map((select) => select.value).filter(Boolean);
    matches = order.filter((entry) => tags.every((tag) => entry.tags.includes(tag))
      && searched.every((word) => entry.searchText.includes(word)));
    shownCount = size;
    query(".count").textContent = `Showing ${matches.length} of ${entries.length}`;
    draw();
  };

  query(".controls").addEventListener("submit", (event) => event.preventDefault());
  addEventListener("beforeunload", (event) => hasUnsavedInput && event.preventDefault());
  $("text").addEventListener("input", filter);
  onClick("all", () => {
    for (const field of [$("text"), ...selects]) field.value = "";
    filter();
  });
  onClick("more", () => {
    shownCount += size;
    draw();
  });
  onClick("save", () => {
    const link = make("a", "", { download: "overrides.csv",
      href: URL.createObjectURL(new Blob([overridesText()], { type: "text/csv" })) });
    link.click();
    hasUnsavedInput = false;
    URL.revokeObjectURL(link.href);
  });
  for (const select of selects) select.addEventListener("change", filter);
  for (const box of queryAll("[data-group]")) {
    box.addEventListener("change", () => listTable.classList.toggle(`with-${box.dataset.group}`, box.checked));
  }
  query(".frame").prepend(listTable);
  filter();
})();
